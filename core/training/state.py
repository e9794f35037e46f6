"""The state of a training, and the step from one state to the next (needs JAX)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .config import TrainSettings
from .decisions import Decision
from .losses import mse_to_psnr
from .non_finite import not_finite
from .optimizer import learning_rate, zero_moments
from .parallel import Devices
from .prepare import Prepared
from .sampler import Batch, Sampler
from .view_dependence_test import EFFECT
from .weight_average import EVERY, WeightAverage

SMOOTHING = 0.98  # weight of the running means' past in each step: they average about 50 steps


@dataclass(frozen=True, eq=False)
class TrainState:
    """The state of a training after some steps. It is immutable: a step returns a new one.

    It does not contain the random state, which is `Prepared.rng`'s, and the sampler's state.
    """

    params: Any  # the network's parameters, a tree of arrays on all devices
    moments: tuple[Any, Any]  # Adam's first and second moment, trees as params
    average: WeightAverage  # of the parameters over the last steps
    decisions: tuple[Decision, ...]
    view: str  # view dependence of the field: one of nerf.model.VIEWS
    undecided: bool  # whether the view-dependence test is still to come
    step: int = 0  # steps done
    elapsed: float = 0.0  # seconds trained
    loss: float = 0.0  # running mean
    error: float = 0.0  # running mean of the squared colour error of the training rays
    non_finite_steps: int = 0  # in a row, up to now

    @property
    def psnr(self) -> float:
        """PSNR of the training rays in dB, from the running mean of their squared error."""
        return mse_to_psnr(self.error)

    def fraction(self, settings: TrainSettings) -> float:
        """How much of the training is done, in [0, 1]: of its steps where they are set, else of its seconds."""
        if settings.steps is not None:
            return min(self.step / settings.steps, 1.0)
        return min(self.elapsed / float(settings.seconds or 1), 1.0)

    def decided(self, decision: Decision) -> TrainState:
        """The state after the view-dependence test."""
        return replace(self, decisions=(*self.decisions, decision), view=str(decision.chosen), undecided=False)

    def best(self, devices: Devices) -> Any:
        """The parameters that a field gets: their mean over the last steps, once there is one. Arrays on this process's device."""
        return devices.local(self.params) if self.average.mean is None else self.average.mean


@dataclass(frozen=True)
class StepReport:
    """The results of a step, or of several, other than the next parameters. loss, aux and finite are on the device, perhaps still being
    computed; of several steps they have an axis of steps. So may be samples and rays, those of the last step."""

    fraction: float  # of the training that was done before the step
    rate: float  # the step's learning rate
    samples: Any
    rays: Any
    loss: Any = 0.0
    aux: Any = None  # of the loss, for `Sampler.learn`
    finite: Any = True  # whether the loss and the gradient are
    steps: int = 1


@dataclass(frozen=True)
class TrainStep:
    """A training step, compiled: functions of the state and a batch alone.

    The new parameters and moments take the place of the old state's arrays in memory: do not read those after a step.
    """

    settings: TrainSettings
    devices: Devices
    compiled: Any  # what `Devices.step` returns

    def draw(self, sampler: Sampler, state: TrainState) -> Batch:
        """The batch of the next step."""
        return sampler.batch(self.devices.local(state.params), state.fraction(self.settings))

    def last(self, batch: Batch) -> dict[str, Any]:
        """The arrays of a batch, those of its last step, as `Sampler.loss` takes them."""
        return batch.arrays

    def __call__(self, state: TrainState, batch: Batch) -> tuple[TrainState, StepReport]:
        """(state with the next parameters, report). Does not wait for the device, so that Ctrl-C never falls between the old
        parameters, which are gone, and the new ones. A step that is not finite leaves parameters and moments as they are."""
        fraction = state.fraction(self.settings)
        rate = learning_rate(self.settings, state.step, fraction)
        arrays = self.devices.feed(self.settings, batch.arrays)
        params, moments, result = self.compiled(state.params, state.moments, arrays, rate, state.step + 1)
        after = replace(state, params=params, moments=moments, step=state.step + 1)
        return after, StepReport(fraction, rate, batch.samples, batch.rays, *self.devices.local(result))

    def recorded(self, state: TrainState, report: StepReport) -> TrainState:
        """The state after a step with the step in its means, or counted as not finite."""
        if not bool(report.finite):
            return replace(state, non_finite_steps=state.non_finite_steps + 1)
        average, old = state.average, SMOOTHING if state.loss else 0.0
        if report.fraction >= 1 - self.settings.average and state.step % EVERY == 0:
            average = average.add(self.devices.local(state.params))
        loss = old * state.loss + (1 - old) * float(report.loss)
        error = old * state.error + (1 - old) * float(report.aux["error"])
        return replace(state, non_finite_steps=0, average=average, loss=loss, error=error)


def initial_state(prepared: Prepared, devices: Devices) -> TrainState:
    """The state before the first step."""
    undecided = prepared.settings.view_dependence == "auto"
    params = devices.place(prepared.params)
    return TrainState(
        params=params,
        moments=devices.place(zero_moments(devices.local(params))),
        average=WeightAverage(),
        decisions=prepared.decisions,
        view="deferred" if undecided else prepared.settings.view_dependence,
        undecided=undecided,
    )


def state_arrays(state: TrainState, devices: Devices) -> dict[str, NDArray[Any]]:
    """What `restored_state` reads: named arrays of any shape, copied to the host.

    Raises SnergError when the parameters or moments hold values that are not finite (hard case 27).
    """
    optimized = devices.local((state.params, state.moments))
    if broken := not_finite(optimized):
        raise SnergError(
            f"Training went wrong by step {state.step}: {broken} is not finite; go on with a lower learning rate (setting rate)."
        )
    arrays = {f"leaf_{i:03d}": np.array(leaf) for i, leaf in enumerate(jax.tree.leaves(optimized))}
    arrays["clock"] = np.array([state.step, state.elapsed, state.loss, state.error, state.non_finite_steps], np.float64)
    arrays["decided"] = np.frombuffer(b"" if state.undecided else state.view.encode(), np.uint8)
    return arrays | state.average.arrays()


def restored_state(initial: TrainState, arrays: dict[str, NDArray[Any]], devices: Devices, settings: TrainSettings) -> TrainState:
    """The state whose `state_arrays` (named, of any shape) these are, for the settings of `initial`.

    Raises SnergError when it is another network's, and ValueError or KeyError when the arrays are damaged.
    """
    leaves, tree = jax.tree.flatten((initial.params, initial.moments))
    saved = [arrays.get(f"leaf_{i:03d}") for i in range(len(leaves))]
    same = all(s is not None and s.shape == leaf.shape for s, leaf in zip(saved, leaves, strict=True))
    if not same or len(arrays.get("clock", ())) != 5:
        raise SnergError("The field to go on with has another network than these settings; train into a new folder.")
    params, moments = devices.place(jax.tree.unflatten(tree, saved))
    step, elapsed, loss, error, non_finite_steps = (float(x) for x in arrays["clock"])
    state = replace(
        initial,
        params=params,
        moments=moments,
        average=WeightAverage.from_arrays(arrays, devices.local(params)),
        decisions=tuple(d for d in initial.decisions if d.effect != EFFECT),
        step=int(step),
        elapsed=elapsed,
        loss=loss,
        error=error,
        non_finite_steps=int(non_finite_steps),
    )
    if settings.view_dependence != "auto":
        return state
    undecided = not len(arrays["decided"])
    return replace(state, undecided=undecided, view="deferred" if undecided else arrays["decided"].tobytes().decode())
