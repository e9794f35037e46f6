"""Measures and thresholds against their definitions, written out plainly in float64; each threshold at its own edge."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from scenes import looking, make_snerg
from snerg.core.baking.supersampling import MIN_GAIN
from snerg.core.errors import SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion
from snerg.core.scene.scene import Scene
from snerg.core.study.effects import TRANSPARENT, intrinsics, lens, of_scene
from snerg.core.study.metrics import IDENTICAL, blur, mean_psnr, mse, pooled_psnr, psnr_of, ssim
from snerg.core.study.pareto import SAME_TIME_RATIO, StudyTarget, choose
from snerg.core.training.decisions import Decision


def plain_ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Wang et al. 2004, section III.B, window by window."""
    taps = np.array([[math.exp(-((x - 5) ** 2 + (y - 5) ** 2) / (2 * 1.5**2)) for x in range(11)] for y in range(11)])
    taps /= taps.sum()
    found = []
    for y in range(a.shape[0] - 10):
        for x in range(a.shape[1] - 10):
            if mask is not None and not mask[y + 5, x + 5]:
                continue
            for channel in range(a.shape[2]):
                p, q = (image[y : y + 11, x : x + 11, channel].astype(np.float64) for image in (a, b))
                mean_p, mean_q = (taps * p).sum(), (taps * q).sum()
                spread_p, spread_q = (taps * (p - mean_p) ** 2).sum(), (taps * (q - mean_q) ** 2).sum()
                both = (taps * (p - mean_p) * (q - mean_q)).sum()
                c1, c2 = 0.01**2, 0.03**2
                found.append((2 * mean_p * mean_q + c1) * (2 * both + c2) / ((mean_p**2 + mean_q**2 + c1) * (spread_p + spread_q + c2)))
    return float(np.mean(found))


def pictures(seed: int, height: int = 17, width: int = 14) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    a = draw.random((height, width, 3)) * draw.uniform(0.02, 1)
    return a.astype(np.float32), np.clip(a + draw.normal(0, 0.1, a.shape), 0, 1).astype(np.float32)


@pytest.mark.hard_case(30)
@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_that_of_its_definition(seed: int) -> None:
    a, b = pictures(seed)
    assert ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)
    mask = np.random.default_rng(seed).random(a.shape[:2]) < 0.6
    assert ssim(a, b, mask) == pytest.approx(plain_ssim(np.where(mask[..., None], a, b), b, mask), abs=1e-9)
    border = np.zeros(a.shape[:2], bool)
    border[0] = True  # nothing that counts lies in a window's middle
    assert ssim(a, b, border) == pytest.approx(plain_ssim(np.where(border[..., None], a, b), b), abs=1e-9)


def test_the_smallest_picture_of_ssim_is_a_window() -> None:
    a, b = pictures(3, 11, 11)
    assert blur(a).shape == (1, 1, 3) and ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)
    for height, width in ((10, 11), (11, 10)):
        with pytest.raises(SnergError, match="11 x 11"):
            ssim(*pictures(4, height, width))
    assert blur(np.ones((12, 13, 1))) == pytest.approx(np.ones((2, 3, 1)), abs=1e-12), "weights add up to 1"


@pytest.mark.hard_case(30, 59)
def test_errors_are_means_of_the_pixels_that_count() -> None:
    """In float64: differences whose squares float32 would round away add up."""
    a = np.full((1000, 1000, 1), 0.5, np.float32)
    b = a.copy()
    b[0, 0] += np.float32(0.25)
    assert mse(a, b) == pytest.approx(0.0625e-6, rel=1e-12)
    mask = np.zeros((1000, 1000), bool)
    mask[0, :4] = True
    assert mse(a, b, mask) == pytest.approx(0.0625 / 4, rel=1e-12)
    with pytest.raises(SnergError, match="hides all"):
        mse(a, b, np.zeros((1000, 1000), bool))
    bytes_ = np.uint8([[[200]], [[10]]]), np.uint8([[[10]], [[200]]])
    assert mse(*bytes_) == 190.0**2, "bytes are no numbers that wrap"
    for bad in (np.nan, np.inf):
        with pytest.raises(SnergError, match="not finite"):
            mse(a, np.where(np.arange(1000)[:, None, None] == 7, bad, a))


@pytest.mark.hard_case(30)
def test_golden_decibels() -> None:
    assert [psnr_of(10.0**-k) for k in (0, 1, 2.5, 4)] == pytest.approx([0, 10, 25, 40])
    assert psnr_of(0.0) == math.inf and psnr_of(2.0) == pytest.approx(-3.0103, abs=1e-4)
    assert mean_psnr([1e-2, 1e-4]) == pytest.approx(30) and pooled_psnr([1e-2, 1e-4]) == pytest.approx(-10 * math.log10(0.00505))
    assert IDENTICAL == 100.0 and mean_psnr([0.0, 1e-2]) == pytest.approx(60) and mean_psnr([1e-12, 1e-2]) == pytest.approx(60)
    assert mean_psnr([0.0]) == math.inf and pooled_psnr([0.0, 0.0]) == math.inf


def told(scene: Scene, name: str) -> Decision:
    return next(effect.decision for effect in of_scene(scene, CodecSettings()) if effect.decision.effect == name)


def baked(**report: object) -> Scene:
    bake = {"settings": {"visibility_threshold": 0.01}, "seconds": {"visibility": 1.0, "prefilter": 8.0}, **report}
    return replace(make_snerg((20, 20, 20)), about={"bake": bake})


@pytest.mark.parametrize(("passes", "clear"), [(TRANSPARENT - 1e-6, False), (TRANSPARENT, True), (0.7, True), (0.0, False)])
def test_a_scene_is_transparent_from_the_threshold_on(passes: float, clear: bool) -> None:
    found = told(baked(light={"rays": 5, "passes": passes, "voxels": 3.0}), "Transparency")
    assert (found.chosen, found.measured, found.threshold) == (clear, passes, 0.1)


def test_culling_tells_the_share_that_none_sees() -> None:
    for held, seen, share in ((200, 50, 0.75), (200, 200, 0.0), (0, 0, 1.0)):
        found = told(baked(voxels={"held": held, "seen": seen}), "Visibility culling")
        assert found.chosen is True and found.measured == pytest.approx(share)
    assert told(baked(voxels={"held": 9, "seen": None}), "Visibility culling").chosen is False
    effect = next(e for e in of_scene(baked(voxels={"held": 200, "seen": 50})) if e.decision.effect == "Visibility culling")
    assert "about 4.0 times as many voxels" in effect.saves


def test_samples_tell_the_gain_of_the_last_doubling() -> None:
    measured = [{"samples": n, "error": e} for n, e in ((1, 0.08), (2, 0.04), (4, 0.03), (8, 0.0297))]
    scene = baked(samples=4, samples_measured=measured)
    effect = next(e for e in of_scene(scene) if e.decision.effect == "Samples a voxel")
    assert effect.decision.measured == pytest.approx(0.01) and effect.decision.threshold == MIN_GAIN == 0.02
    assert effect.saves == "About 6 s of that, with 1 sample in place of 4."
    assert told(baked(samples=4, samples_measured=[]), "Samples a voxel").overridden


@pytest.mark.parametrize(("gain", "kept"), [(-0.1, False), (0.0, False), (1e-9, True)])
def test_any_gain_of_refining_is_kept(gain: float, kept: bool) -> None:
    report = {"psnr_before": 30.0, "psnr_after": 30.0 + gain, "gain_db": gain, "seconds": {"march": 1.0, "fit": 2.0}}
    for name in ("refine", "fit"):
        scene = replace(make_snerg((20, 20, 20)), about={name: report})
        assert told(scene, "Refining").chosen is kept and told(scene, "Refining").measured == gain


def test_cameras_differ_by_more_than_their_poses() -> None:
    one = Camera(40, 30, (50.0, 50.0), (20, 15), looking((0, -3, 0), (0, 0, 0)))
    moved = replace(one, camera_to_world=looking((1, -3, 0), (0, 0, 0)), name="B", near=0.5)
    assert intrinsics([one, moved]).chosen is False and intrinsics([one, moved]).measured == 1
    for other in (replace(one, focal=(50.0, 51.0)), replace(one, centre=(20.5, 15)), replace(one, distortion=Distortion("opencv", (0.1,)))):
        assert intrinsics([one, other]).chosen is True and intrinsics([one, other]).threshold == 2.0
    assert lens([one]).chosen is False


def test_a_lens_is_told_by_its_largest_shift_at_the_edges() -> None:
    """Of a plain radial lens by its closed form, at the corner, where r is largest; in pixels of the uneven focal lengths."""
    k1 = 0.05
    camera = Camera(80, 60, (100.0, 90.0), (30.0, 25.0), np.eye(4), distortion=Distortion("opencv", (k1,)))
    corners = np.array([[x, y] for x in (0, 80) for y in (0, 60)])
    flat = (corners - camera.centre) / camera.focal
    moved = []
    for x, y in flat:
        distorted = math.hypot(x, y)
        ideal = next(r for r in np.linspace(0.9 * distorted, distorted, 200001) if r * (1 + k1 * r * r) >= distorted)
        shift = np.array([x, y]) * (ideal / distorted - 1) * camera.focal
        moved.append(float(np.linalg.norm(shift)))
    found = lens([camera, replace(camera, distortion=None)])
    assert found.chosen is True and found.measured == pytest.approx(max(moved), rel=1e-3)


def test_rows_are_as_quick_up_to_a_twentieth() -> None:
    rows = [{"psnr": 31.0, "ms": 100.0, "megabytes": 9.0}, {"psnr": 31.0, "ms": 105.0, "megabytes": 5.0}]
    rows += [{"psnr": 31.0, "ms": 105.1, "megabytes": 1.0}]
    assert SAME_TIME_RATIO == 1.05 and choose(rows, StudyTarget(db=30))[0] == rows[1]
    assert StudyTarget(db=32, mb=2, ms=50).misses(rows[0]) == pytest.approx(0.1 + 3.5 + 1.0)
    assert StudyTarget(db=31, mb=9, ms=100).misses(rows[0]) == 0
