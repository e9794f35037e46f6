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
