"""Fitting and pruning the voxels of a scene whose pictures are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes import empty_snerg, make_dataset, make_snerg
from snerg.core.baking.finish import Finishing, finish
from snerg.core.baking.fit_batches import Voxels, batches
from snerg.core.baking.fit_voxels import FitSettings, fit_voxels, pixel_errors
from snerg.core.baking.prune import prune, shares, without
from snerg.core.baking.ray_samples import RaySamples, sampled_views
from snerg.core.data.dataset import Dataset
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.io.images import over
from snerg.core.rendering.render import render_scene
from snerg.core.scene.blocks import fill_aprons
from snerg.core.scene.scene import Scene

SETTINGS = FitSettings(pixels=3000, passes=3, batch=128, rate=0.02, evaluations=3)
WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("data"), train=6, test=2, size=32)


@pytest.fixture(scope="module")
def views(folder) -> Dataset:
    return read_dataset(folder)


@pytest.fixture(scope="module")
def fitted(views) -> tuple[Scene, Scene, dict[str, Any]]:
    """A scene, the same one fitted, and the report."""
    scene = noisy()
    return scene, *fit_voxels(scene, views, SETTINGS)


def noisy(diffuse: bool = False, amount: float = 0.15) -> Scene:
    """The scene of the pictures with an error in every colour and feature."""
    scene = make_snerg((40, 36, 44), fog=False, diffuse=diffuse)
    draw, cells = np.random.default_rng(5), scene.cells.astype(np.float32)
    cells[..., :-1] *= draw.uniform(1 - 2 * amount, 1, cells[..., :-1].shape)
    spoilt = replace(scene, cells=np.rint(cells).astype(np.uint8))
    for _ in fill_aprons(spoilt.cells, spoilt.indirection):
        pass
    return spoilt


def decibels(scene: Scene, folder: Path) -> float:
    held_out = read_dataset(folder, "test")
    errors = [((render_scene(scene, camera).over() - over(held_out.read(i))) ** 2).mean() for i, camera in enumerate(held_out.cameras)]
    return float(-10 * np.log10(np.mean(errors)))


def check_stored(scene: Scene) -> None:
    """No colour or feature is above its alpha by more than rounding, and the aprons are those of the neighbours."""
    cells = scene.cells.astype(int)
    assert (cells[..., :-1] <= cells[..., -1:] + 1).all() and not cells[cells[..., -1] == 0].any()
    again = scene.cells.copy()
    for _ in fill_aprons(again, scene.indirection):
        pass
    assert np.array_equal(again, scene.cells)


def test_fitted_voxels_are_closer_to_views_that_nothing_saw(folder, fitted):
    scene, better, report = fitted
    assert report["gain_db"] > 0.5 and decibels(better, folder) > decibels(scene, folder) + 0.5
    assert report["psnr_after"] == pytest.approx(report["psnr_before"] + report["gain_db"]) and report["steps"] > 10
    assert better.cells.shape == scene.cells.shape and not better.cells[scene.cells[..., -1] == 0].any()
    assert better.about["fit"] == report and not np.array_equal(better.network.weights_0, scene.network.weights_0)
    check_stored(better)


@pytest.mark.hard_case(75)
def test_the_same_seed_gives_the_same_bytes(views, fitted):
    again, _ = fit_voxels(noisy(), views, SETTINGS)
    assert np.array_equal(again.cells, fitted[1].cells) and all(map(np.array_equal, again.network, fitted[1].network))


@pytest.mark.hard_case(75)
def test_a_fit_that_goes_wrong_changes_nothing(views):
    """At such rates every step makes it worse: the views kept out say so, the fit ends early, and the scene stays."""
    scene = make_snerg((40, 36, 44), fog=False)
    same, report = fit_voxels(scene, views, replace(SETTINGS, rate=0.5, network_rate=0.5))
    assert report["gain_db"] == 0 and report["psnr_after"] == report["psnr_before"]
    assert np.array_equal(same.cells, scene.cells) and all(map(np.array_equal, same.network, scene.network))


def test_opacity_of_a_diffuse_scene_is_fitted(views):
    scene = make_snerg((40, 36, 44), fog=False, diffuse=True)
    thin = replace(scene, cells=(scene.cells * 0.6).astype(np.uint8))
    better, report = fit_voxels(thin, views, SETTINGS)
    assert report["gain_db"] > 1 and better.network is None and not np.array_equal(better.cells[..., -1], thin.cells[..., -1])
    check_stored(better)


def test_scenes_that_cannot_be_fitted_are_left(views):
    scene = empty_snerg()
    assert fit_voxels(scene, views) == (scene, {"skipped": "the scene is empty"})
    one = replace(views, views=views.views[:1])
    scene = noisy()
    assert fit_voxels(scene, one)[0] is scene


def test_a_cancelled_fit_stops_and_says_how_far_it_is(views):
    told = []

    def stop(fraction: float, text: str) -> None:
        told.append((fraction, text))
        if fraction > 0.5:
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        fit_voxels(noisy(), views, SETTINGS, stop)
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions) and "Marching view 1" in told[0][1] and "dB, was" in told[-1][1]


def test_shares_are_those_of_the_march(views):
    """The shares of a ray's samples add up to the opacity that the marcher composites."""
    scene = noisy()
    samples = next(sampled_views(scene, views, np.arange(1), 400, 0, lambda f, t: None))
    alpha = scene.cells.reshape(-1, 8)[:, -1] / np.float32(255)
    opacity = np.add.reduceat(shares(samples, alpha).sum(axis=1), samples.first[:-1])
    frame = render_scene(scene, views.cameras[0])
    colours = {tuple(pixel) for pixel in samples.pixels.tolist()}
    assert len(samples) > 50 and len(colours) > 20 and (opacity <= 1 + 1e-5).all()
    assert abs(opacity.mean() - frame.alpha[frame.alpha > 0].mean()) < 0.05


def test_pruning_drops_what_no_picture_needs(views):
    scene = make_snerg((40, 36, 44), fog=False)
    kept, report = prune(scene, views, 0.01)
    before, after = report["voxels_before"], report["voxels_after"]
    inside = (slice(None), *(slice(1, -1),) * 3, -1)
    assert before == np.count_nonzero(scene.cells[inside]) and after == np.count_nonzero(kept.cells[inside]) and 0 < after < 0.95 * before
    check_stored(kept)
    for index, camera in enumerate(views.cameras[:3]):
        change = np.abs(render_scene(kept, camera).over() - render_scene(scene, camera).over())
        assert change.max() < 0.05 and change.mean() < 0.002, f"view {index}: {change.max()}"


def test_blocks_without_voxels_lose_their_cells(views):
    scene = make_snerg((74, 65, 95), fog=False)
    first = np.zeros(scene.cells.shape[:4], bool)
    gone = scene.indirection[:2]  # all blocks but those on the +x side; the aprons of the middle ones keep their cells
    first[gone[gone >= 0]] = True
    left = without(scene, first.reshape(-1))
    assert len(left.cells) < len(scene.cells) and (left.indirection[scene.indirection < 0] < 0).all()
    check_stored(left)
    for index in np.argwhere(left.indirection >= 0):
        old, new = scene.cells[scene.indirection[tuple(index)]], left.cells[left.indirection[tuple(index)]]
        assert np.array_equal(new[1:-1, 1:-1, 1:-1], 0 * old[1:-1, 1:-1, 1:-1] if index[0] < 2 else old[1:-1, 1:-1, 1:-1])


def test_stages_run_in_their_order_and_report(views):
    scene, seconds = finish(noisy(), views, Finishing(refine=False, prune=0.01), WHITE)
    assert list(seconds) == ["prune"] and scene.about["prune"]["threshold"] == 0.01
    told: list[str] = []
    empty, _ = finish(empty_snerg(), views, Finishing(fit=True), WHITE, lambda fraction, text: told.append(text))
    assert empty.about["fit"] == {"skipped": "the scene is empty"} and told == ["The voxels are not fitted: the scene is empty."]
    assert Finishing(refine=True, fit=True, prune=0.01).stages(True) == ("prune", "fit")
    assert Finishing(refine=True).stages(False) == ()
    with pytest.raises(SnergError, match="below 1"):
        Finishing(prune=1.0)


def test_rays_of_parts_are_those_of_the_whole():
    draw = np.random.default_rng(0)
    parts = []
    for rays, samples in ((2, [3, 1]), (1, [2])):
        first = np.concatenate([[0], np.cumsum(samples)])
        count = int(first[-1])
        columns = draw.integers(0, 99, count), draw.integers(0, 255, (count, 3)).astype(np.uint8)
        parts.append(RaySamples(first, *columns, np.zeros((rays, 3), np.float32), np.zeros((rays, 4), np.uint8)))
    whole = RaySamples.concatenate(parts)
    assert whole.first.tolist() == [0, 3, 4, 6]
    rows, ray, slot = whole.rows(np.array([2, 0]))
    assert rows.tolist() == [4, 5, 0, 1, 2] and ray.tolist() == [0, 0, 1, 1, 1] and slot.tolist() == [0, 1, 0, 1, 2]


def test_what_is_fitted_is_what_the_marcher_shows(views):
    """The squared error over a view is that of its picture, in a scene with thin fog too, whose rays have the most samples."""
    scene = make_snerg((110, 96, 120), fog=True)
    samples = next(sampled_views(scene, views, np.arange(1), 10**9, 0, lambda f, t: None))
    voxels, total = Voxels.of(scene, samples), 0.0
    for batch in batches(samples, np.arange(len(samples)), 256, voxels):
        corners = voxels.stored[batch.corners].astype(np.float32) / 255
        total += float((pixel_errors(corners, scene.network, batch, WHITE, scene.opacity_correction) ** 2).sum())
    frame, image = render_scene(scene, views.cameras[0]), over(views.read(0))
    shown = frame.colour + (1 - frame.alpha[..., None])
    assert np.diff(samples.first).max() > 32 and total == pytest.approx(float(((shown - image)[frame.alpha > 0] ** 2).sum()), rel=0.01)
