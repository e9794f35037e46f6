"""Real captures, where SNERG_DATA names them: two photographs must agree on where things are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snerg.core.data.dataset import Dataset, DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.geometry.camera import Camera


def matches(dataset: Dataset, one: int, other: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates [N, 2] in two views of corners that look the same."""
    features = pytest.importorskip("skimage.feature")
    found = []
    for index in (one, other):
        orb = features.ORB(n_keypoints=800, fast_threshold=0.05)
        orb.detect_and_extract(np.asarray(Image.fromarray(dataset.read(index)).convert("L")) / 255)
        found.append((orb.keypoints[:, ::-1], orb.descriptors))
    pairs = features.match_descriptors(found[0][1], found[1][1], cross_check=True, max_ratio=0.8)
    return found[0][0][pairs[:, 0]], found[1][0][pairs[:, 1]]


def agreement(first: Camera, second: Camera, here: np.ndarray, there: np.ndarray) -> float:
    """Share of matches whose rays meet in front of both cameras, at a point that projects within 1.5 pixels of either."""
    (o1, d1), (o2, d2) = first.rays(here), second.rays(there)
    across = (d1 * d2).sum(axis=-1)
    between = o2 - o1
    along = ((between * d1).sum(axis=-1) - (between * d2).sum(axis=-1) * across) / np.maximum(1 - across**2, 1e-12)
    back = along * across - (between * d2).sum(axis=-1)
    meet = (o1 + along[:, None] * d1 + o2 + back[:, None] * d2) / 2
    errors = [np.linalg.norm(camera.project(meet)[0] - pixels - 0.5, axis=-1) for camera, pixels in ((first, here), (second, there))]
    return float(((along > 0) & (back > 0) & (np.maximum(*errors) < 1.5)).mean())


@pytest.mark.parametrize(("name", "downscale", "pair"), [("fern", 1, (2, 5)), ("fox", 3, (20, 23))])
def test_photographs_agree_and_are_not_mirrored(data, name, downscale, pair):
    dataset = read_dataset(data / name, "train", DatasetOptions(downscale=downscale))
    first, second = (dataset.cameras[i] for i in pair)
    here, there = matches(dataset, *pair)
    assert len(here) > 40
    assert agreement(first, second, here, there) > 0.75
    flips = (np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1]), np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    for flip in flips:  # the same poses with other axes, as a wrong convention would have them
        wrong = [Camera(c.width, c.height, c.focal, c.centre, c.camera_to_world @ flip, distortion=c.distortion) for c in (first, second)]
        assert agreement(*wrong, here, there) < 0.4
    mirrored = [Image.fromarray(dataset.read(i)).transpose(Image.Transpose.FLIP_LEFT_RIGHT).size for i in pair]
    flipped = [np.stack([size[0] - 1 - p[:, 0], p[:, 1]], axis=-1) for size, p in zip(mirrored, (here, there), strict=True)]
    assert agreement(first, second, *flipped) < 0.4


def test_real_captures_open_upright(data: Path):
    for name, views, held in (("fern", 17, 3), ("fox", 43, 7)):
        dataset = read_dataset(data / name)
        assert (len(dataset.views), len(read_dataset(data / name, "val").views)) == (views, held)
        up = np.mean([c.camera_to_world[:3, 1] for c in dataset.cameras], axis=0)
        assert up[2] > 0.9 and np.linalg.norm(up[:2]) < 0.1
        assert np.median([np.linalg.norm(c.position) for c in dataset.cameras]) == pytest.approx(4, rel=0.05)
        assert dataset.box.contains(np.zeros((1, 3))).all()
