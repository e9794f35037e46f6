"""Sheets a voxel thick, behind much and little that is skipped: the light that they stop has a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import looking, snerg_from_volume
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import MarchSettings, render_scene
from snerg.core.scene.scene import Scene

ALPHA, VOXEL = 200 / 255, 0.05
COUNT, WIDTH = 24, 5  # sheets, and voxels that one is wide
SHAPE = (200, COUNT * WIDTH, 10)
DEPTHS = [int(x) for x in np.linspace(3, SHAPE[0] - 4, COUNT)]  # of the sheets along x: at each place in bricks and blocks, and at borders
DEPTHS[5:9] = [29, 30, 59, 60]
PHASES = (0.0, 0.25, 0.5, 0.8)  # voxels from a voxel's centre to the first sample behind it


def sheets() -> Scene:
    """One sheet beside the other along y, each at a depth of its own along x; the rest is empty."""
    values = np.zeros((*SHAPE, 4), np.uint8)
    for number, depth in enumerate(DEPTHS):
        values[depth, WIDTH * number : WIDTH * (number + 1)] = (200, 150, 100, 200)
    return snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)


def camera(phase: float) -> Camera:
    """Parallel rays along x, one through the middle of each sheet; a near plane puts their samples that far behind voxels' centres."""
    middle = np.array([0, SHAPE[1] / 2, SHAPE[2] / 2]) * VOXEL
    pose = looking(tuple(middle - [2, 0, 0]), tuple(middle))
    scale = 1 / (WIDTH * VOXEL)
    return Camera(COUNT, 1, (scale, scale), (COUNT / 2, 0.5), pose, "orthographic", near=2 + phase * VOXEL)


def stopped(phase: float) -> float:
    """Of a sheet between two samples, one `phase` behind its middle and one 1 - phase before it: their weights add up to 1."""
    return 1 - (1 - ALPHA * (1 - phase)) * (1 - ALPHA * phase)


def order(values: NDArray) -> NDArray:
    """Of a picture's row, the sheets in order of y: a camera that looks along x with z up has y to the left."""
    return values[::-1]


@pytest.mark.hard_case(33)
@pytest.mark.parametrize("skip", [True, False])
@pytest.mark.parametrize("phase", PHASES)
def test_a_thin_sheet_stops_as_much_light_wherever_it_is(phase: float, skip: bool) -> None:
    """Half a step of another phase would let 0.22 pass in place of 0.37."""
    frame = render_scene(sheets(), camera(phase), MarchSettings(skip=skip))
    assert frame.alpha[0] == pytest.approx(np.full(COUNT, stopped(phase)), abs=2e-5)
    assert order(frame.depth[0] - frame.depth[0].min()).argsort().tolist() == np.argsort(DEPTHS, kind="stable").tolist()
