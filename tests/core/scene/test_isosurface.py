"""The isosurface of alpha: closed, facing outwards, where the surface is, seamless over blocks."""

from __future__ import annotations

import numpy as np
import pytest

from scenes import snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.scene.isosurface import isosurface

VOXEL = 0.1


def baked(alpha: np.ndarray):
    values = np.zeros((*alpha.shape, 4), np.uint8)
    values[..., 3] = np.round(255 * alpha)
    return snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)


def centres(shape: tuple[int, int, int]) -> np.ndarray:
    """[X, Y, Z, 3]: voxel centres, from the box's centre."""
    return (np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1) + 0.5 - np.array(shape) / 2) * VOXEL


def volume(vertices: np.ndarray, quads: np.ndarray) -> float:
    """Of a closed mesh that faces outwards."""
    a, b, c, d = np.moveaxis(vertices[quads], 1, 0)
    return float(((a * np.cross(b, c)).sum() + (a * np.cross(c, d)).sum()) / 6)


def test_a_sphere_over_several_blocks_is_closed_and_where_it_is():
    shape, radius = (70, 64, 61), 2.2
    distance = np.linalg.norm(centres(shape), axis=-1)
    vertices, quads = isosurface(baked(np.clip(0.5 + (radius - distance) / (3 * VOXEL), 0, 1)))
    assert np.abs(np.linalg.norm(vertices, axis=1) - radius).max() < 0.1 * VOXEL
    assert volume(vertices, quads) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    edges = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    forward, backward = (sorted(map(tuple, pairs)) for pairs in (edges, edges[:, ::-1]))
    assert forward == backward and len(set(forward)) == len(forward)  # each edge once in each direction: closed, and no seam
    assert len(vertices) - len(edges) // 2 + len(quads) == 2  # Euler


def test_what_reaches_the_borders_of_the_grid_is_closed_too():
    vertices, quads = isosurface(baked(np.ones((31, 30, 4))))
    assert volume(vertices, quads) == pytest.approx(31 * 30 * 4 * VOXEL**3, rel=0.02)


def test_nothing_opaque_enough_is_said():
    with pytest.raises(SnergError, match="as opaque as"):
        isosurface(baked(np.full((30, 30, 30), 0.4)))
