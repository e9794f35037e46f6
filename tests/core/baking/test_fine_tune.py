"""Fine-tuning: the network that is best on the validation pixels is kept, and its errors are those of float64."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import golden
from scenes import random_network
from snerg.core.baking import fine_tune
from snerg.core.baking.fine_tune import RefineSettings, TrainingPixels, fit
from snerg.core.errors import SnergError
from snerg.core.nerf.model import ViewNetwork

TRUE = random_network(5)


def between(share: float) -> ViewNetwork:
    """A network between a wrong one (0) and the true one (1)."""
    return ViewNetwork(*(a + np.float32(share) * (b - a) for a, b in zip(random_network(1), TRUE, strict=True)))


def pixels(count: int = 60, validation: int = 20) -> TrainingPixels:
    draw = np.random.default_rng(0)
    colour, features = draw.random((count, 3), np.float32), draw.random((count, 4), np.float32)
    directions = draw.normal(size=(count, 3))
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    target = colour + [golden.residual(TRUE, *row) for row in zip(colour, features, directions, strict=True)]
    return TrainingPixels(colour, features, directions, target.astype(np.float32), validation)


def decibels(network: ViewNetwork, of: TrainingPixels) -> float:
    """PSNR on the validation pixels in float64."""
    rows = list(zip(of.colour, of.features, of.view_directions, of.target, strict=True))[: of.validation]
    return float(-10 * np.log10(np.mean([(c + golden.residual(network, c, f, d) - t) ** 2 for c, f, d, t in rows])))


def run(monkeypatch, shares: list[float], **settings) -> tuple[ViewNetwork, dict]:
    """A fit whose epochs end at these networks."""
    networks = iter([ViewNetwork(*(jnp.asarray(a) for a in between(share))) for share in shares])
    monkeypatch.setattr(fine_tune, "_epochs", lambda *of: lambda: next(networks))
    return fit(between(0.2), pixels(), RefineSettings(**settings), lambda fraction, text: None)


def test_the_best_network_is_kept_and_not_the_last(monkeypatch):
    network, report = run(monkeypatch, [0.4, 0.9, 0.5, 0.3, 0.0, 0.6, 0.95], patience=4, epochs=7)
    assert all(map(np.array_equal, network, between(0.9))), "0.95 comes after four epochs without a gain"
    assert report["epochs"] == 6
    assert report["psnr_before"] == pytest.approx(decibels(between(0.2), pixels()), abs=1e-3)
    assert report["psnr_after"] == pytest.approx(decibels(between(0.9), pixels()), abs=1e-3)
    assert report["gain_db"] == pytest.approx(report["psnr_after"] - report["psnr_before"])


def test_the_old_network_is_kept_where_none_is_better(monkeypatch):
    network, report = run(monkeypatch, [0.1, 0.0, 0.1], epochs=3)
    assert all(map(np.array_equal, network, between(0.2))) and report["gain_db"] == 0 and report["epochs"] == 3


def test_a_small_gain_is_kept_and_is_no_gain(monkeypatch):
    """Less than a two-thousandth of the error: four of them end the fit, and the last is the best."""
    network, report = run(monkeypatch, [0.2 + 1e-5 * k for k in range(1, 9)], patience=4, epochs=8)
    assert report["epochs"] == 4 and all(map(np.array_equal, network, between(0.2 + 4e-5)))


def test_an_error_that_is_not_finite_is_a_sentence(monkeypatch):
    with pytest.raises(SnergError, match="not finite"):
        run(monkeypatch, [np.nan])


def test_fitting_comes_nearer_and_repeats_itself():
    data = pixels(400, 100)
    settings = RefineSettings(batch=100, epochs=6, rate=1e-2)
    first, report = fit(between(0.5), data, settings, lambda fraction, text: None)
    again, _ = fit(between(0.5), data, settings, lambda fraction, text: None)
    assert report["gain_db"] > 1 and all(map(np.array_equal, first, again))
    other, _ = fit(between(0.5), data, RefineSettings(batch=100, epochs=6, rate=1e-2, seed=1), lambda fraction, text: None)
    assert not np.array_equal(first.weights_0, other.weights_0), "the seed changes nothing"


def test_epochs_without_a_gain_count_in_a_row(monkeypatch):
    _, report = run(monkeypatch, [0.1, 0.1, 0.3, 0.1, 0.1, 0.4, 0.1, 0.5], patience=3, epochs=8)
    assert report["epochs"] == 8
