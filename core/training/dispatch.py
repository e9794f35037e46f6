"""Several training steps in one dispatch, for a device that would otherwise wait for the host between two steps. Needs JAX."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .config import TrainSettings
from .device_sampler import DeviceSampler, step_of, steps_at_once
from .optimizer import Loss, learning_rate, train_step
from .parallel import Devices
from .sampler import Batch, Sampler
from .state import StepReport, TrainState, TrainStep
from .weight_average import EVERY


def compiled_step(settings: TrainSettings, devices: Devices, sampler: Sampler) -> TrainStep:
    """The training step for a sampler: several steps in one dispatch where the device packs the samples."""
    if not isinstance(sampler, DeviceSampler):
        return TrainStep(settings, devices, devices.step(settings, sampler.loss))
    compiled = jax.jit(partial(train_steps, settings, sampler.loss), donate_argnums=(0, 1))
    return Dispatch(settings, devices, compiled, sampler, steps_at_once(settings.samples, jax.devices()[0].platform))


def train_steps(
    settings: TrainSettings, loss_of: Loss, params: Any, moments: Any, batch: dict[str, Any], rates: Any, first: Any, count: Any
) -> tuple[Any, Any, Any]:
    """`count` steps of `train_step`, of which the first is step `first`. Returns (params, moments, (loss, aux, whether finite)), the last
    with an axis of steps: the arrays of the batch and rates [places] have it too, and what is past `count` is 0.

    The count is not compiled in, so that the last dispatch of a training may have fewer steps than the others.
    """

    def one(i: Any, params: Any, moments: Any) -> tuple[Any, Any, Any]:
        return train_step(settings, loss_of, params, moments, step_of(batch, i), rates[i], first + i)

    def advance(i: Any, carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        params, moments, results = carry
        params, moments, result = one(i, params, moments)
        return params, moments, jax.tree.map(lambda all_of, a: all_of.at[i].set(a), results, result)

    shapes = jax.eval_shape(one, 0, params, moments)[2]
    results = jax.tree.map(lambda a: jnp.zeros((len(rates), *a.shape), a.dtype), shapes)
    after: tuple[Any, Any, Any] = jax.lax.fori_loop(0, count, advance, (params, moments, results))
    return after


@dataclass(frozen=True)
class Dispatch(TrainStep):
    """A `TrainStep` of up to `places` steps. How many depends on the step and the settings alone, not on the clock: a training that
    is resumed goes on as one that was not interrupted."""

    sampler: DeviceSampler
    places: int

    def draw(self, sampler: Sampler, state: TrainState) -> Batch:
        """The batch of the next steps."""
        return self.sampler.batches(state.fraction(self.settings), self.count(state), self.places)

    def last(self, batch: Batch) -> dict[str, Any]:
        """The arrays of the last step of a batch."""
        return step_of(batch.arrays, batch.steps - 1)

    def count(self, state: TrainState) -> int:
        """The number of steps in the next dispatch. It ends at a multiple of `places`, and where parameters are averaged, after each step
        whose parameters are."""
        every = self.places
        if self.fraction(state, self.places) >= 1 - self.settings.average:
            every = min(every, EVERY)
        left = every if self.settings.steps is None else self.settings.steps - state.step
        return min(every - state.step % every, left)

    def fraction(self, state: TrainState, steps: int) -> float:
        """How much of the training is done `steps` after a state, in [0, 1]; within a dispatch a training by the clock stands still."""
        return replace(state, step=state.step + steps).fraction(self.settings)

    def __call__(self, state: TrainState, batch: Batch) -> tuple[TrainState, StepReport]:
        """(state after all steps of the batch, report). Does not wait for the device. See `TrainStep`."""
        fractions = [self.fraction(state, i) for i in range(self.places)]
        rates = [learning_rate(self.settings, state.step + i, fraction) for i, fraction in enumerate(fractions)]
        inputs = batch.arrays, np.array(rates, np.float32), state.step + 1, batch.steps
        params, moments, (loss, aux, finite) = self.compiled(state.params, state.moments, *inputs)
        after, last = replace(state, params=params, moments=moments, step=state.step + batch.steps), batch.steps - 1
        sizes = aux["samples"][last], aux["rays"][last]
        return after, StepReport(fractions[last], rates[last], *sizes, loss, aux, finite, batch.steps)

    def recorded(self, state: TrainState, report: StepReport) -> TrainState:
        """The state after a dispatch with each of its steps in its means, or counted as not finite. See `TrainStep`."""
        loss, error, finite = (np.asarray(array) for array in (report.loss, report.aux["error"], report.finite))
        first = replace(state, step=state.step - report.steps)
        for i in range(report.steps):
            one = replace(report, fraction=self.fraction(first, i), loss=loss[i], aux={"error": error[i]}, finite=finite[i])
            state = super().recorded(replace(state, step=first.step + i + 1), one)
        return state
