"""PSNR and SSIM, against their definitions and scikit-image."""

import math
import sys

import numpy as np
import pytest

from snerg.core.errors import SnergError
from snerg.core.study.evaluate import Score
from snerg.core.study.metrics import IDENTICAL, flip, mean_psnr, mse, pooled_psnr, psnr, ssim


def pictures(seed: int, size=(40, 57, 3)) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    a = (0.5 + 0.5 * np.sin(0.2 * x + 0.13 * y))[..., None] * random.uniform(0.2, 1, size[2])
    return a.astype(np.float32), np.clip(a + random.normal(0, 0.08, size), 0, 1).astype(np.float32)


def test_psnr_of_a_known_error():
    a = np.full((4, 5, 3), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert mse(a, a - 0.1) == pytest.approx(0.01)


@pytest.mark.hard_case(30)
def test_identical_pictures():
    a, b = pictures(0)
    assert psnr(a, a) == math.inf and ssim(a, a) == pytest.approx(1)
    # One perfect view among three does not make either mean infinite.
    assert pooled_psnr([0.0, 0.01, 0.02]) == pytest.approx(20)
    assert mean_psnr([0.0, 0.01, 0.1]) == pytest.approx((IDENTICAL + 20 + 10) / 3)
    assert mean_psnr([0.0, 0.0]) == pooled_psnr([0.0]) == math.inf
    assert mean_psnr([mse(a, b)]) == pooled_psnr([mse(a, b)]) == psnr(a, b)


@pytest.mark.parametrize("seed", range(4))
def test_ssim_equals_scikit_images(seed):
    metrics = pytest.importorskip("skimage.metrics")
    a, b = pictures(seed)
    expected = metrics.structural_similarity(
        a.astype(np.float64),
        b.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
    )
    assert ssim(a, b) == pytest.approx(expected, abs=4e-5)


def test_ssim_is_symmetric_and_falls_with_noise():
    a, b = pictures(5)
    worse = np.clip(b + np.random.default_rng(6).normal(0, 0.2, b.shape), 0, 1)
    assert ssim(a, b) == pytest.approx(ssim(b, a))
    assert ssim(a, worse) < ssim(a, b) < 1


def test_what_cannot_be_compared():
    a, b = pictures(1)
    with pytest.raises(SnergError, match="cannot be compared"):
        psnr(a, b[:-1])
    with pytest.raises(SnergError, match="finite"):
        psnr(a, np.full_like(b, np.nan))
    with pytest.raises(SnergError, match="11"):
        ssim(a[:10], b[:10])
    with pytest.raises(SnergError, match="no views"):
        mean_psnr([])
    with pytest.raises(SnergError, match="no views"):
        pooled_psnr([])


def test_flip_grows_with_the_difference_and_masked_pixels_do_not_count():
    pytest.importorskip("flip_evaluator")
    draw = np.random.default_rng(5)
    truth = draw.random((40, 50, 3))
    noise = draw.normal(size=truth.shape)
    faint, strong = (np.clip(truth + scale * noise, 0, 1) for scale in (0.02, 0.2))
    assert flip(truth, truth) == 0 < flip(faint, truth) < flip(strong, truth) < 1
    assert flip(np.zeros_like(truth), np.ones_like(truth)) == pytest.approx(0.968, abs=2e-3)
    mask = np.ones((40, 50), bool)
    mask[:, 25:] = False
    halved = np.where(mask[..., None], truth, strong)
    assert flip(halved, truth, mask) == 0 < flip(halved, truth) < flip(strong, truth)


def test_flip_is_left_out_where_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    picture = np.random.default_rng(6).random((20, 20, 3))
    assert flip(picture, picture) is None
    score = Score()
    score.add(picture, picture)
    assert "flip" not in score.result() and score.result()["ssim"] == 1
