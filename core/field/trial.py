"""Whether a scene calls for view dependence, measured while it trains: the same steps without it and with it (JAX).

Training begins with the view-dependence network silent. After a while it forks: some steps go on so, the same steps are
taken again from the same state with the network awake, and rays of views that were set aside say whether it helps. The
steps of the better one count. In both the learning rate falls to nothing, because what a step at the full rate happens to do
to the one and not to the other is more than what there is to measure.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from .decide import Decision
from .held_out import Rays

if TYPE_CHECKING:
    from .train import Trainer

AT = 0.12  # of the training: the shape is there, roughly
SHARE = 0.04  # of the training's steps are those of each side
LEAST, MOST = 40, 2000  # steps of each side; of fewer nothing can be told
SILENT, AWAKE = -100.0, -3.0  # the network's last bias: a residual of 1e-13 with gradients of exactly 0; and as it is drawn
VIEWS = 12  # from how many views on some can be set aside
RAYS = 8192
GAIN = 0.03  # dB that view dependence must bring, beyond twice the standard error
EFFECT = "View dependence"


def with_bias(params: dict[str, Any], bias: float) -> dict[str, Any]:
    """Parameters whose view-dependence networks are silent or awake."""
    changed = dict(params)
    if "view" in params:
        *rest, last = params["view"]
        changed["view"] = (*rest, jnp.full_like(last, bias))
    if "coarse" in params:
        changed["coarse"] = with_bias(params["coarse"], bias)
    return changed


def set_aside(views: int) -> np.ndarray:
    """bool [views]: 2 to 4 of them, spread evenly; none where there are few."""
    aside = np.zeros(views, bool)
    if views >= VIEWS:
        count = min(max(views // 12, 2), 4)
        aside[np.linspace(0, views - 1, count + 2).round().astype(int)[1:-1]] = True
    return aside


def length(step: int, fraction: float) -> int:
    """Steps of each side, of a training that took `step` steps for `fraction` of itself; 0 where that would be too few."""
    steps = int(SHARE * step / max(fraction, 1e-6))
    return min(steps, MOST) if steps >= LEAST else 0


def run(trainer: Trainer) -> Generator[str, None, None]:
    """Decide, and leave the trainer where the better side stands, telling what it does after each step.

    Closed in between, it leaves the trainer where it stood before.
    """
    steps = length(trainer.step, trainer.fraction())
    if not steps:
        trainer.decide(Decision(EFFECT, "deferred", "The training is too short to try without; a longer one measures it."))
        trainer.params = trainer.devices.place(with_bias(trainer.devices.local(trainer.params), AWAKE))
        return
    rays = Rays(trainer.pool, trainer.aside if trainer.aside.any() else None, RAYS, trainer.settings)
    before, fraction = trainer.state(), trainer.fraction()
    done = False
    try:
        without = yield from _side(trainer, rays, SILENT, steps, fraction)
        kept = trainer.state()
        trainer.restore(before)
        gained = yield from _side(trainer, rays, AWAKE, steps, fraction)
        decision = judged(without, gained, int(trainer.aside.sum()), steps)
        if not trainer.devices.shared(decision.chosen == "deferred"):  # process 0 decides for all
            trainer.restore(kept)
        done = True
    finally:
        if not done:
            trainer.restore(before)
    trainer.decide(decision)


def _side(trainer: Trainer, rays: Rays, bias: float, steps: int, fraction: float) -> Generator[str, None, np.ndarray]:
    """Take the steps; returns squared errors [RAYS]."""
    trainer.params = trainer.devices.place(with_bias(trainer.devices.local(trainer.params), bias))
    what = "with" if bias == AWAKE else "without"
    for k in range(steps):
        trainer.advance(fraction, 1 - k / steps)
        yield f"trying {what} view dependence"
    return trainer.errors(rays)


def judged(without: np.ndarray, gained: np.ndarray, views: int, steps: int) -> Decision:
    """From squared errors [R] of the same rays without and with view dependence."""
    gain = 10 * np.log10(max(float(without.mean()), 1e-12) / max(float(gained.mean()), 1e-12))
    difference = without - gained
    error = float(difference.std() / np.sqrt(len(difference)))
    doubt = 2 * 10 / np.log(10) * error / max(float(without.mean()), 1e-12)  # dB
    threshold = GAIN + doubt
    where = f"rays of {views} views set aside" if views else "training rays, because there are too few views to set any aside"
    needed = f"needed: {threshold:.2f} dB, of which twice the standard error is {doubt:.2f}"
    evidence = f"{steps} steps with it gain {gain:+.2f} dB on {where} ({needed})."
    return Decision(EFFECT, "deferred" if gain > threshold else "diffuse", evidence, gain, threshold)
