"""What is measured before the first step: the box to train in, by poses and by pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import ring

from snerg.core.data.dataset import Dataset, View
from snerg.core.geometry.box import Box
from snerg.core.io.images import write_png
from snerg.core.training.config import TrainSettings
from snerg.core.training.prepare import find_domain, masks_of, read_pixels, training_box

SETTINGS = TrainSettings(steps=10, seconds=None, ndc="off")
CUBE, WIDE = Box.axis_aligned([-1.5] * 3, [1.5] * 3), Box.axis_aligned([-6] * 3, [6] * 3)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """A coarse hull, which takes a fraction of the time."""
    monkeypatch.setattr("snerg.core.nerf.sampling.CELLS", 32)
    monkeypatch.setattr("snerg.core.nerf.sampling.COARSE_CELLS", 16)


def renders(folder: Path, kind: str) -> Dataset:
    """Views of noise; with alpha or a white backdrop round a square in the middle, or neither."""
    draw, views = np.random.default_rng(0), []
    for index, camera in enumerate(ring(8)):
        pixels = draw.integers(0, 200, (camera.height, camera.width, 4 if kind == "alpha" else 3)).astype(np.uint8)
        around = np.ones(pixels.shape[:2], bool)
        around[6:13, 8:17] = False
        if kind == "alpha":
            pixels[..., 3] = np.where(around, 0, 255)
        elif kind == "backdrop":
            pixels[around] = 255
        write_png(folder / f"{index}.png", pixels)
        views.append(View(camera, folder / f"{index}.png"))
    return Dataset(folder, "train", tuple(views), CUBE, "It is a cube.", WIDE)


@pytest.mark.parametrize(("kind", "half"), [("alpha", 1.5), ("backdrop", 1.5), ("neither", 6.0)])
def test_surroundings_are_in_the_box_where_pictures_show_them(tmp_path, kind, half):
    dataset = renders(tmp_path, kind)
    masks = masks_of(dataset)
    rays, _ = read_pixels(dataset, SETTINGS, masks, lambda *_: None)
    rays.domain, _, occupied, _ = find_domain(dataset, SETTINGS, rays, masks, lambda *_: None)
    assert occupied.any() and rays.domain.world_box().size.max() / 2 <= half * 1.1
    assert (rays.domain.world_box().size.max() / 2 > 3) == (kind == "neither")
    decision = training_box(dataset, rays, 0)
    assert decision.effect == "Training box" and decision.evidence.startswith("It is a cube. ")
    assert decision.measured > 0.99 if kind == "neither" else decision.measured > 0


def test_the_share_of_crossing_rays_is_measured_on_training_rays(tmp_path):
    dataset = renders(tmp_path, "neither")
    rays, _ = read_pixels(dataset, SETTINGS, masks_of(dataset), lambda *_: None)
    few = replace(dataset, box=Box.axis_aligned([-0.2] * 3, [0.2] * 3), opaque_box=None)
    rays.domain = find_domain(few, SETTINGS, rays, masks_of(few), lambda *_: None)[0]
    decision = training_box(few, rays, 0)
    assert 0.005 < decision.measured < 0.1 and f"{100 * decision.measured:.0f} % of the rays cross it" in decision.evidence
