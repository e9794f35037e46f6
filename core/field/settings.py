"""How to train: every choice that a training has, with its default and where that comes from. No JAX here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import SnergError
from .networks import Family, HashFamily, MlpFamily


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    family: the network. view_dependence: without, the field is diffuse. samples: packed into one step.
    spacing: final distance between samples on [-1, 1]; training starts with 4 times that, then twice.
    rate, final_rate: of Adam, falling log-linearly (section 6); network_rate: factor on the networks beside the table.
    sparsity: weight of the Cauchy loss (eq. 8), averaged over samples. alpha: weight of the alpha loss, for images with alpha.
    seconds, steps: how long to train; the schedule spans it. seed: of everything random.
    """

    family: Family = HashFamily()
    view_dependence: bool = True
    samples: int = 32768
    spacing: float = 2 / 256
    rate: float = 4e-2
    final_rate: float = 8e-4
    network_rate: float = 1.0
    beta_2: float = 0.99
    warm_up: int = 64
    sparsity: float = 1e-5
    alpha: float = 0.1
    seconds: float | None = 300.0
    steps: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 < self.final_rate <= self.rate and math.isfinite(self.rate)):
            raise SnergError(f"The learning rate falls from {self.rate} to {self.final_rate}; both must be above 0, and it must not rise.")
        if self.steps is not None and self.steps < 1:
            raise SnergError(f"Training for {self.steps} steps is no training; give 1 or more.")
        if self.steps is None and not (self.seconds is not None and self.seconds > 0):
            raise SnergError(f"Training for {self.seconds} seconds is no training; give a time above 0, or steps.")


PRESETS = {
    "fast": TrainSettings(),
    # Section 6: 8 layers of 512, learning rate 2e-3 to 2e-5, warm-up over 2500 steps; without clipping, which Adam makes idle.
    "paper": TrainSettings(family=MlpFamily(), rate=2e-3, final_rate=2e-5, network_rate=1.0, beta_2=0.999, warm_up=2500, samples=16384),
}
