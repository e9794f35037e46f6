"""The schedule, the clipping and the skipping of steps."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snerg.core.training.config import PRESETS, TrainSettings
from snerg.core.training.optimizer import clipped, learning_rate, train_step, zero_moments

PAPER = PRESETS["paper"]


@pytest.mark.hard_case(28)
def test_the_papers_learning_rate():
    """Section 6: log-linear from 2e-3 to 2e-5 over 250000 steps, from 2e-4 over the first 2500."""

    def at(step):
        return learning_rate(PAPER, step, step / PAPER.steps)

    assert at(0) == pytest.approx(2e-4) and at(250_000) == pytest.approx(2e-5)
    assert at(125_000) == pytest.approx(2e-4) and at(2500) == pytest.approx(2e-3 * 0.01**0.01)
    rates = [at(step) for step in range(0, 2401, 100)]
    assert (np.diff(rates) > 0).all()
    assert learning_rate(replace(PAPER, warm_up=0), 0, 0.0) == pytest.approx(2e-4)  # its first step is still a small one


def test_gradients_are_clipped_by_value_and_then_by_norm():
    gradient = {"a": jnp.array([3.0, -0.004]), "b": [jnp.array([[0.5], [0.0]])]}
    got = clipped(PAPER, gradient)
    by_value = np.array([0.01, -0.004, 0.01, 0])
    by_norm = by_value * 0.01 / np.linalg.norm(by_value)
    assert np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(got)]) == pytest.approx(by_norm, rel=1e-6)
    assert np.asarray(clipped(PAPER, {"a": jnp.array([3e-3, -4e-3])})["a"]) == pytest.approx([3e-3, -4e-3])
    assert clipped(TrainSettings(), gradient) is gradient


@pytest.mark.hard_case(26)
@pytest.mark.parametrize("largest", [1e25, 3e38])
def test_a_norm_does_not_overflow(largest):
    settings = replace(PAPER, clip_value=None)
    got = np.asarray(jax.jit(partial(clipped, settings))({"a": jnp.array([largest, -largest, 1], jnp.float32)})["a"], np.float64)
    assert got == pytest.approx([0.01 / np.sqrt(2), -0.01 / np.sqrt(2), 0], rel=1e-5)


@pytest.mark.hard_case(22)
@pytest.mark.parametrize("largest", [0.0, 1e-30, 1e-12])
def test_a_gradient_of_nearly_nothing_stays_as_it_is(largest):
    gradient = jnp.array([largest, -largest / 2, 0], jnp.float32)
    assert np.array_equal(clipped(PAPER, {"a": gradient})["a"], gradient)


def slope_loss(params, batch):
    """A loss whose gradient is the batch."""
    total = sum((p * g).sum() for p, g in zip(jax.tree.leaves(params), jax.tree.leaves(batch["slope"]), strict=True))
    return total, {"error": total}


@pytest.mark.hard_case(26)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", ["kernel", "bias"])
def test_a_step_that_is_not_finite_changes_no_bit(bad, place):
    """Also where only a kernel too large to be called small has one bad number."""
    params = {"kernel": jnp.zeros((300, 300)), "bias": jnp.zeros(3)}
    slope = {"kernel": jnp.full((300, 300), 1e-3), "bias": jnp.full(3, -1e-3)}
    step = jax.jit(partial(train_step, PAPER, slope_loss))
    params, moments, report = step(params, zero_moments(params), {"slope": slope}, 1e-3, 1)
    assert report[2]
    broken = {**slope, place: slope[place].at[(1,) * slope[place].ndim].set(bad)}
    again, kept, report = step(params, moments, {"slope": broken}, 1e-3, 2)
    assert not report[2]
    for a, b in zip(jax.tree.leaves((params, moments)), jax.tree.leaves((again, kept)), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.hard_case(26)
def test_a_gradient_of_1e25_still_makes_a_step():
    params = {"bias": jnp.zeros(3)}
    stepped, _, report = train_step(
        PAPER, slope_loss, params, zero_moments(params), {"slope": {"bias": jnp.array([1e25, -1e25, 1e-4])}}, 1e-3, 1
    )
    assert report[2] and np.asarray(stepped["bias"]) == pytest.approx([-1e-3, 1e-3, -1e-3], rel=1e-3)


def float64_adam(settings, slopes, steps, rate, factor, table):
    """Kingma and Ba 2015, algorithm 1, one number at a time, and a table's entries that are not touched left alone."""
    p = m = v = 0.0
    for step in range(1, steps + 1):
        g = float(np.float32(slopes[step - 1]))
        if table and abs(g) <= 1e-9:
            continue
        m, v = 0.9 * m + 0.1 * g, settings.beta_2 * v + (1 - settings.beta_2) * g * g
        p -= rate * factor * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - settings.beta_2**step)) + 1e-9 / np.sqrt(1 - settings.beta_2**step))
    return p, m, v


@pytest.mark.parametrize("beta_2", [0.99, 0.999])
def test_adam_is_that_of_float64(beta_2):
    """The rates of a table, a network and a view-dependence network; a table's entry that a step does not touch keeps everything."""
    settings = replace(TrainSettings(), beta_2=beta_2, network_rate=0.25, view_rate=0.125, view_degrees=4)
    slopes = np.float32([[0.3, -2.0, 1e-3, 0.0, 0.7], [0.0, 0.5, 0.5, -0.1, 1e-10], [4.0, 4.0, 0.0, 4.0, -3.0]])  # of three values, 5 steps
    slopes = np.concatenate([slopes, slopes[:1] * np.float32(1e-6)])
    params = {"field": {"table_0": jnp.zeros(4), "weights_0": jnp.zeros(4)}, "view": (jnp.zeros((34, 4)),)}
    moments, step = zero_moments(params), jax.jit(partial(train_step, settings, slope_loss))
    for number in range(5):
        g = jnp.asarray(slopes[:, number])
        batch = {"slope": {"field": {"table_0": g, "weights_0": g}, "view": (jnp.broadcast_to(g, (34, 4)),)}}
        params, moments, report = step(params, moments, batch, 0.01, number + 1)
        assert report[2]
    arrays = (
        (lambda tree: tree["field"]["table_0"], 1.0, True),
        (lambda tree: tree["field"]["weights_0"], 0.25, False),
        (lambda tree: tree["view"][0][5], 0.125, False),
    )
    for of, factor, table in arrays:
        for i in range(4):
            p, m, v = float64_adam(settings, slopes[i], 5, 0.01, factor, table)
            assert float(of(params)[i]) == pytest.approx(p, rel=2e-5)
            assert float(of(moments[0])[i]) == pytest.approx(m, rel=1e-5) and float(of(moments[1])[i]) == pytest.approx(v, rel=1e-5)


def test_frequencies_that_are_not_trained_have_no_step():
    settings = replace(TrainSettings(), view_degrees=2)
    params = {"view": (jnp.zeros((34, 4)), jnp.zeros(4)), "coarse": {"view": (jnp.zeros((34, 4)), jnp.zeros(4))}}
    batch = {"slope": jax.tree.map(jnp.ones_like, params)}
    after, _, _ = train_step(settings, slope_loss, params, zero_moments(params), batch, 1e-2, 1)
    trained = [True] * 3 + [True] * 6 + [False] * 6 + [True] * 6 + [False] * 6 + [True] * 7  # d, sines, cosines, colour and features
    for first, bias in (after["view"], after["coarse"]["view"]):
        assert (np.asarray(first) != 0).all(axis=1).tolist() == trained == (np.asarray(first) != 0).any(axis=1).tolist() and (
            bias != 0
        ).all()


@pytest.mark.hard_case(26)
@pytest.mark.parametrize("clip", [{}, {"clip_value": 0.01, "clip_norm": 0.01}])
def test_a_finite_loss_with_a_gradient_that_is_none_changes_no_bit(clip):
    """The square root of 0 is 0, and its slope infinity times 0: one number that is none among three."""
    params = {"field": {"weights_0": jnp.zeros(3), "table_0": jnp.full(3, 0.5)}}
    slope = {"field": {"weights_0": jnp.full(3, 0.1), "table_0": jnp.full(3, 0.1)}}
    settings = replace(TrainSettings(), **clip)
    params, moments, _ = train_step(settings, slope_loss, params, zero_moments(params), {"slope": slope}, 1e-3, 1)
    params["field"]["weights_0"] = jnp.zeros(3)

    def loss(params, batch):
        total = jnp.sqrt(params["field"]["weights_0"][0] ** 2) + params["field"]["table_0"].sum()
        return total, {"error": total}

    after, kept, report = train_step(settings, loss, params, moments, {}, 1e-3, 2)
    assert np.isfinite(report[0]) and not report[2]
    for a, b in zip(jax.tree.leaves((params, moments)), jax.tree.leaves((after, kept)), strict=True):
        assert np.array_equal(a, b)


def test_an_infinite_loss_with_a_finite_gradient_changes_no_bit():
    params = {"bias": jnp.ones(3)}
    after, _, report = train_step(
        PAPER, lambda p, b: (p["bias"].sum() + jnp.inf, {"error": jnp.float32(0)}), params, zero_moments(params), {}, 1e-2, 1
    )
    assert not report[2] and np.array_equal(after["bias"], params["bias"])


def test_clipping_by_value_alone_and_by_norm_alone():
    gradient = {"a": jnp.array([3.0, -0.5, 0.1])}
    by_value = clipped(replace(PAPER, clip_value=0.25, clip_norm=None), gradient)["a"]
    assert np.asarray(by_value).tolist() == pytest.approx([0.25, -0.25, 0.1])
    by_norm = clipped(replace(PAPER, clip_value=None, clip_norm=0.5), gradient)["a"]
    assert np.asarray(by_norm) == pytest.approx(np.array([3, -0.5, 0.1]) * 0.5 / np.sqrt(9.26), rel=1e-6)


def test_the_warm_up_rises_like_a_sine_and_the_rate_falls_log_linearly():
    settings = replace(TrainSettings(), rate=1e-2, final_rate=1e-4, warm_up=100)
    assert learning_rate(settings, 50, 0.0) == pytest.approx(1e-2 * (0.1 + 0.9 * np.sin(np.pi / 4)))
    assert learning_rate(settings, 100, 0.0) == learning_rate(settings, 5000, 0.0) == pytest.approx(1e-2)
    assert learning_rate(settings, 5000, 0.25) == pytest.approx(1e-2 * 10**-0.5) and learning_rate(settings, 5000, 1.0) == pytest.approx(
        1e-4
    )
