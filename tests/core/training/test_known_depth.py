"""Depth in a dataset empties the cells that views look through, and no others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import looking
from snerg.core.data.dataset import Dataset
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.images import write_png
from snerg.core.nerf.sampling import CELLS, Domain, cell_centres
from snerg.core.training.decisions import Decision
from snerg.core.training.known_depth import smallest, without_open
from snerg.core.training.prepare import carve_by_depth
from snerg.core.training.ray_dataset import RayDataset

RADIUS, SIZE = 0.5, 48  # of a ball in the origin; pixels a side
DOMAIN = Domain.around(np.full(3, -1.0), np.full(3, 1.0))


def ball(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(alpha bool [H, W], depth along the axis [H, W], 0 beside the ball) of the ball as a camera sees it."""
    origins, directions = camera.rays()
    middle = -(origins * directions).sum(axis=-1)
    square = RADIUS**2 - ((origins + middle[:, None] * directions) ** 2).sum(axis=-1)
    depth = (middle - np.sqrt(square.clip(0))) * (directions @ -camera.camera_to_world[:3, 2])
    shape = camera.height, camera.width
    return (square > 0).reshape(shape), np.where(square > 0, depth, 0).reshape(shape).astype(np.float32)


def dataset(folder: Path, alpha: bool = True, missing: float = 0.0) -> Dataset:
    """Ten views of the ball with depth, of which a share of rows is missing."""
    cameras = [
        Camera(
            SIZE, SIZE, (1.2 * SIZE,) * 2, (SIZE / 2,) * 2, looking((3 * np.cos(a), 3 * np.sin(a), np.cos(3 * a)), (0, 0, 0)), name=f"{i}"
        )
        for i, a in enumerate(np.linspace(0, 5.6, 10))
    ]
    for index, camera in enumerate(cameras):
        shown, depth = ball(camera)
        image = np.dstack([np.full((SIZE, SIZE, 3), 90, np.uint8), np.where(shown, 255, 0).astype(np.uint8)])
        write_png(folder / f"train/{index}.png", image if alpha else image[..., :3])
        depth[: int(missing * SIZE)] = 0
        (folder / "depth").mkdir(exist_ok=True)
        np.save(folder / f"depth/{index}.npy", depth)
    extras = [{"depth_file_path": f"./depth/{index}.npy"} for index in range(10)]
    box = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
    write_transforms(folder / "transforms_train.json", cameras, [f"./train/{i}" for i in range(10)], box, {}, extras)
    return read_dataset(folder)


def carved(views: Dataset) -> tuple[NDArray[Any], NDArray[Any], Decision]:
    """(some cells [CELLS^3] bool before and after, the decision)"""
    rays = RayDataset([views.read(i) for i in range(len(views.views))], views.cameras, DOMAIN)
    before = np.zeros(CELLS**3, bool)
    before[np.random.default_rng(2).choice(CELLS**3, 20_000, replace=False)] = True
    after, decision = carve_by_depth(views, rays, DOMAIN, before)
    return before, after, decision


@pytest.mark.parametrize("alpha", [True, False])
def test_cells_that_views_look_through_are_empty_and_no_others(tmp_path, alpha):
    before, after, decision = carved(dataset(tmp_path, alpha))
    assert decision.chosen is True and decision.measured == pytest.approx(1 - after.sum() / before.sum())
    distance = np.linalg.norm(cell_centres(CELLS), axis=-1)
    held = before & (distance < RADIUS + np.sqrt(3) / CELLS)
    assert held.sum() > 1000 and after[held].all(), "what holds the surface, or lies behind it, stays"
    assert after.sum() < (2 * held.sum() if alpha else 0.95 * before.sum())


def test_where_depth_is_missing_nothing_is_emptied_by_it(tmp_path):
    """The upper half of each view has no depth: the upper half of the ball stays whole."""
    before, after, _ = carved(dataset(tmp_path, missing=0.5))
    held = before & (np.linalg.norm(cell_centres(CELLS), axis=-1) < RADIUS)
    assert after[held].all()


def test_depth_that_is_missing_or_cannot_be_read_is_a_sentence(tmp_path):
    views = dataset(tmp_path)
    (tmp_path / "depth/3.npy").write_bytes(b"broken")
    with pytest.raises(SnergError, match=r"3\.npy"):
        carved(views)
    with pytest.raises(SnergError, match="has no depth"):
        carved(replace(views, views=tuple(replace(view, depth=None) for view in views.views)))


@pytest.mark.hard_case(42)
def test_a_view_looks_through_nothing_behind_its_clip_planes():
    """Where a picture shows nothing at all: only cells between both planes are empty."""
    camera = Camera(30, 30, (20.0, 20.0), (15, 15), looking((0, -4, 0), (0, 0, 0)), near=3.5, far=4.5)
    cells = np.random.default_rng(0).random(CELLS**3) < 0.01
    left = without_open(DOMAIN, cells, [camera], iter([np.full((30, 30), np.inf, np.float32)]))
    depth = DOMAIN.to_world(cell_centres(CELLS))[:, 1] + 4
    assert np.array_equal(left, cells & ((depth <= 3.5) | (depth >= 4.5)))


def test_the_smallest_of_a_square():
    depth = np.random.default_rng(1).random((7, 9), np.float32)
    padded = np.pad(depth, 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    assert (smallest(depth, 2) == windows.min(axis=(2, 3))).all()
