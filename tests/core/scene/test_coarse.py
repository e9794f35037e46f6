"""The scene at a quarter of its resolution."""

from __future__ import annotations

import numpy as np
import pytest

from scenes import empty_snerg, make_snerg, snerg_from_volume
from snerg.core.scene.blocks import block_coordinates
from snerg.core.scene.coarse import coarse_scene
from snerg.core.scene.scene import Scene


def dense(scene: Scene) -> np.ndarray:
    """The voxels [x, y, z, C] of a scene."""
    values = np.zeros((*(30 * n for n in scene.indirection.shape), scene.cells.shape[-1]), np.uint8)
    for row, (x, y, z) in enumerate(30 * block_coordinates(scene.indirection)):
        values[x : x + 30, y : y + 30, z : z + 30] = scene.cells[row, 1:-1, 1:-1, 1:-1]
    return values


@pytest.mark.parametrize("diffuse", [False, True])
def test_each_voxel_is_the_mean_of_64_that_a_ray_crosses_four_at_a_time(diffuse: bool) -> None:
    """Also of blocks that cover less than four fine ones, against float64."""
    scene = make_snerg(shape=(131, 47, 62), diffuse=diffuse)
    coarse = coarse_scene(scene)
    fine = dense(scene).astype(float) / 255
    wide = np.zeros((*(120 * n for n in coarse.indirection.shape), fine.shape[-1]))
    wide[tuple(slice(0, n) for n in fine.shape)] = fine
    x, y, z, channels = wide.shape
    mean = wide.reshape(x // 4, 4, y // 4, 4, z // 4, 4, channels).mean(axis=(1, 3, 5))
    alpha = 1 - (1 - mean[..., -1:]) ** 4
    expected = np.concatenate([mean[..., :-1] * alpha / np.maximum(mean[..., -1:], 1e-9), alpha], axis=-1)
    assert coarse.shape == (33, 12, 16) and coarse.voxel_size == 4 * scene.voxel_size
    assert np.abs(dense(coarse) - 255 * expected).max() <= 0.501
    assert (coarse.cells[..., :-1] <= coarse.cells[..., -1:]).all(), "colours stay premultiplied"


def test_fog_stays_as_thick() -> None:
    fog = np.broadcast_to(np.uint8([1, 2, 3, 4]), (120, 60, 60, 4)).copy()
    values = dense(coarse_scene(snerg_from_volume(fog, None, grid_to_world=np.eye(4), voxel_size=0.01)))[:30, :15, :15, -1]
    assert (values == round(255 * (1 - (1 - 4 / 255) ** 4))).all()


def test_an_empty_scene_stays_empty() -> None:
    assert len(coarse_scene(empty_snerg()).cells) == 0


@pytest.mark.hard_case(34)
def test_aprons_hold_the_neighbours_voxels() -> None:
    coarse = coarse_scene(make_snerg(shape=(150, 131, 140), diffuse=True))
    wide = np.pad(dense(coarse), ((1, 1), (1, 1), (1, 1), (0, 0)))
    assert len(coarse.cells) > 4
    for cell, (x, y, z) in zip(coarse.cells, 30 * block_coordinates(coarse.indirection), strict=True):
        assert np.array_equal(cell, wide[x : x + 32, y : y + 32, z : z + 32])
