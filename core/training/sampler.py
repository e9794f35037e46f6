"""What every sampler of training rays offers the training loop: batches, their loss, and its own state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from numpy.typing import NDArray

from .config import TrainSettings
from .validation import ValidationRays


@dataclass(frozen=True, eq=False)
class Batch:
    """The input of one step's loss, or of several steps' (see `dispatch`).

    arrays: by name, always of the same shapes, so that the step is compiled once. samples, rays: how many of them are real, not
    padding. steps: how many.
    """

    arrays: dict[str, Any]
    samples: int
    rays: int
    steps: int = 1


@dataclass(frozen=True)
class BatchLoss:
    """The loss of a sampler's batches; traced by JAX. Losses of trainings that differ in their length and seed alone are equal, and share
    what is compiled for them.

    of: (settings, alpha, params, batch) to (loss, aux). alpha: whether the images have it.
    """

    of: Callable[[TrainSettings, bool, Any, dict[str, Any]], tuple[Any, dict[str, Any]]]
    settings: TrainSettings
    alpha: bool

    def __call__(self, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return self.of(self.settings, self.alpha, params, batch)


def of_any_length(settings: TrainSettings) -> TrainSettings:
    """The settings without the length and the seed of a training: what a step depends on."""
    return replace(settings, steps=1, seconds=None, seed=0)


class Sampler(Protocol):
    """A way to sample rays: `occupancy_sampler` and `hierarchical_sampler` implement it. occupied: bool [CELLS^3]."""

    settings: TrainSettings
    """The training's settings, those that were 'auto' decided."""
    occupied: NDArray[Any]
    """Cells of the occupancy grid that may hold something, bool [CELLS ** 3]."""
    loss: BatchLoss
    """(params, batch) to (loss, aux). aux holds "error", the squared colour error, and what `learn` reads. Both are sums over the rays
    and samples of the batch, divided by counts that the batch holds, so that the parts of a batch that is split among devices add up."""

    def batch(self, params: Any, fraction: float) -> Batch:
        """The rays and samples of the next step; `fraction` in [0, 1] is how much of the training is done."""

    def learn(self, params: Any, step: int, aux: dict[str, Any]) -> None:
        """Update the sampler after a step from its parameters and from the loss's aux."""

    def colours(self, params: Any, rays: ValidationRays, fraction: float) -> NDArray[Any]:
        """Colours [R, 3] of validation rays over their background, sampled as training samples at this fraction."""

    def state(self) -> dict[str, NDArray[Any]]:
        """The named arrays of any shape that `restore` needs."""

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Continue from the named arrays of any shape of `state`. Raises KeyError or ValueError where they belong to another training."""
