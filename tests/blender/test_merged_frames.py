"""Frames of several objects over each other, against a loop over pixels in plain numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scenes import looking, make_snerg
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.frame import Frame
from snerg.snerg_addon.engine import NO_DEPTH, Placed, merged

CAMERA = Camera(13, 9, (9.0, 9.0), (6.5, 4.5), looking((0, -4, 1), (0, 0, 0)))


def drawn(draw: np.random.Generator, objects: int) -> tuple[list[Frame], list[Placed]]:
    """Frames with holes, veils, opaque pixels and equal depths; objects of unequal scale, one of them a holdout."""
    shape, scene = (CAMERA.height, CAMERA.width), make_snerg((4, 4, 4), diffuse=True)
    frames, things = [], []
    for number in range(objects):
        alpha = draw.choice([0.0, 1e-6, 0.2, 0.49, 0.51, 0.9, 1.0], shape).astype(np.float32)
        depth = np.where(alpha > 0, draw.choice([1.0, 2.0, 4.0, 8.0], shape), np.inf).astype(np.float32)
        frames.append(Frame((draw.random((*shape, 3)) * alpha[..., None]).astype(np.float32), alpha, depth))
        things.append(Placed(scene, CAMERA, (1.0, 0.5, 2.0, 0.25)[number], 10 + number, holdout=number == 2))
    return frames, things


@pytest.mark.hard_case(76)
@pytest.mark.parametrize("objects", [1, 2, 4])
def test_frames_are_put_over_each_other_by_depth(objects: int) -> None:
    frames, things = drawn(np.random.default_rng(objects), objects)
    got = merged(frames, things, CAMERA)
    axes = CAMERA.cosines(CAMERA.rays()[1]).reshape(CAMERA.height, CAMERA.width)
    for row, column in np.ndindex(CAMERA.height, CAMERA.width):
        layers = [(float(f.depth[row, column]) * t.scale, i) for i, (f, t) in enumerate(zip(frames, things, strict=True))]
        colour, alpha, behind, depth, weight, index = np.zeros(3), 0.0, 1.0, 0.0, 0.0, 0
        for distance, i in sorted(layers):
            own = float(frames[i].alpha[row, column])
            if not things[i].holdout:
                colour, alpha = colour + behind * frames[i].colour[row, column], alpha + behind * own
            if own > 0:
                depth, weight = depth + behind * own * distance, weight + behind * own
            index = things[i].index if own > 0.5 and not index else index
            behind *= 1 - own
        assert got.colour[row, column] == pytest.approx(colour, abs=1e-6) and got.alpha[row, column] == pytest.approx(alpha, abs=1e-6)
        assert got.behind[row, column] == pytest.approx(behind, abs=1e-6) and got.index[row, column] == index
        if weight > 2e-6 or not weight:
            assert got.depth[row, column] == pytest.approx(depth / weight * axes[row, column] if weight else NO_DEPTH, rel=1e-5)
    assert math.isfinite(got.depth.sum()) and (got.depth == NO_DEPTH).any() == (objects < 4 or (got.behind == 1).any())
