"""The diffuse pass of a dataset: read as it is shown, weighed by its share of the light, and what the diffuse colour is trained on."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from scenes import looking
from snerg.core.data.dataset import Dataset
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.exr import write_channels
from snerg.core.io.images import write_png
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig
from snerg.core.progress import silent
from snerg.core.training.config import TrainSettings
from snerg.core.training.losses import diffuse_error

SIZE, VIEWS = 12, 4
SMALL = HashModelConfig(HashGrid(levels=2, log2_size=8), width=8)
SETTINGS = TrainSettings(SMALL, "deferred", steps=3, samples=256, diffuse=1.0)


def dataset(folder: Path) -> Dataset:
    """Views of nothing but one colour, of which half the light is diffuse; alpha 0.5 on the right."""
    places = [(3 * np.cos(a), 3 * np.sin(a), 1.0) for a in np.linspace(0, 5, VIEWS)]
    cameras = [Camera(SIZE, SIZE, (1.2 * SIZE,) * 2, (SIZE / 2,) * 2, looking(p, (0, 0, 0)), name=str(i)) for i, p in enumerate(places)]
    alpha = np.where(np.arange(SIZE) < SIZE // 2, 1.0, 0.5).astype(np.float32) * np.ones((SIZE, 1), np.float32)
    for index in range(VIEWS):
        image = np.dstack([np.full((SIZE, SIZE, 3), 188, np.uint8), (255 * alpha).astype(np.uint8)])
        write_png(folder / f"train/{index}.png", image)
        light = {name: value * alpha for name, value in (("R", 0.25), ("G", 0.5), ("B", 0.0))}
        write_channels(folder / f"diffuse/{index}.exr", light | {"A": alpha})
    extras = [{"diffuse_file_path": f"./diffuse/{index}.exr"} for index in range(VIEWS)]
    box = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
    write_transforms(folder / "transforms_train.json", cameras, [f"./train/{i}" for i in range(VIEWS)], box, {}, extras)
    return read_dataset(folder)


def test_the_pass_is_read_as_it_is_shown(tmp_path):
    pytest.importorskip("OpenImageIO")
    from snerg.core.training.light import diffuse_pixels

    found = diffuse_pixels(dataset(tmp_path))
    assert found.shape == (VIEWS * SIZE * SIZE, 3) and found.dtype == np.uint8
    assert (abs(found.astype(int) - [137, 188, 0]) <= 1).all(), "sRGB of 0.25, 0.5 and 0, whatever alpha is"


class Passes:
    """A dataset of one view of two rows of three pixels whose pass is in memory."""

    cameras = (Camera(3, 2, (3.0, 3.0), (1.5, 1.0), np.eye(4)),)

    def __init__(self, light: np.ndarray) -> None:
        self.light = light

    def render_pass(self, index: int, name: str) -> np.ndarray:
        assert (index, name) == (0, "diffuse")
        return self.light


@pytest.mark.hard_case(8, 59)
def test_light_is_straight_srgb_in_eight_bits():
    """Row by row; where nothing is, where a pixel is hardly covered, and above white."""
    pytest.importorskip("jax")
    from snerg.core.training.light import diffuse_pixels

    alpha = np.array([[1.0, 0.5, 0.05], [0.25, 0.0, 1.0]])
    straight = np.array([[[0.25, 0.5, 0.0], [0.1, 0.2, 0.3], [0.4, 0.6, 0.8]], [[0.001, 0.01, 0.9], [0.0, 0.0, 0.0], [1.5, 40.0, 1.0]]])
    light = np.concatenate([straight * alpha[..., None], alpha[..., None]], axis=-1).astype(np.float32)
    shown = np.clip(straight, 0, 1)
    expected = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055).reshape(-1, 3) * 255
    assert np.abs(diffuse_pixels(Passes(light)) - expected).max() < 0.51
    assert np.abs(diffuse_pixels(Passes(straight.astype(np.float32))) - expected).max() < 0.51, "without alpha all is covered"


def test_the_error_is_weighed_by_the_passs_share_of_the_light():
    colour = np.array([[0.5, 0.25, 0.0], [0.5, 0.5, 0.5], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0]])
    diffuse = np.array([[51, 102, 0], [0, 0, 0], [255, 255, 255], [10, 20, 30]], np.uint8)
    target = np.array([[102, 102, 102, 255], [200, 200, 200, 255], [51, 51, 51, 255], [255, 255, 255, 0]], np.uint8)
    wanted = [0.5 * ((0.5 - 0.2) ** 2 + (0.25 - 0.4) ** 2) / 3, 0.0, ((0.9) ** 2 + 0.8**2 + 0.7**2) / 3, 0.0]
    assert diffuse_error(np, colour, diffuse, target) == pytest.approx(wanted, rel=1e-6)


def test_the_loss_adds_the_weighted_error(tmp_path):
    jax = pytest.importorskip("jax")
    pytest.importorskip("OpenImageIO")
    from snerg.core.training.occupancy_sampler import batch_loss
    from snerg.core.training.prepare import prepare

    prepared = prepare(dataset(tmp_path), SETTINGS, silent, None)
    batch = prepared.sampler.batch(prepared.params, 0.0).arrays
    params = jax.tree.map(jax.numpy.asarray, prepared.params)
    weighted = (jax.jit(partial(batch_loss, replace(SETTINGS, diffuse=weight), True)) for weight in (0.0, 1.0, 3.0))
    losses = [float(loss(params, batch)[0]) for loss in weighted]
    assert losses[1] > losses[0] + 1e-3
    assert losses[2] - losses[0] == pytest.approx(3 * (losses[1] - losses[0]), rel=1e-4)


def test_views_without_the_pass_are_a_sentence(tmp_path):
    pytest.importorskip("jax")
    pytest.importorskip("OpenImageIO")
    from snerg.core.training.prepare import prepare

    views = dataset(tmp_path)
    bare = replace(views, views=tuple(replace(view, passes={}) for view in views.views))
    with pytest.raises(SnergError, match="has no diffuse pass"):
        prepare(bare, SETTINGS, silent, None)
    with pytest.raises(SnergError, match="only for the packed sampler"):
        TrainSettings(sampler="hierarchical", diffuse=1.0)
