"""Training on packed samples: those of an occupied cell only, the rays of a step one after another (JAX)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import SnergError
from .losses import backgrounds, cauchy, over
from .networks import density_of, field_inputs, field_outputs, raw_outputs
from .pixels import PixelPool
from .sampling import Domain, Occupancy, pack_samples
from .settings import TrainSettings
from .shading import ray_colour, sample_values
from .volume import composite, optical_depth

MOST_RAYS = 8192  # in a step
UPDATE_CELLS = 2**18  # of the occupancy grid, looked at in one update
UPDATE_EVERY = 64  # steps
WARM_UP = 256  # steps before an occupancy cell may be given up
SPACINGS = ((0.1, 8), (0.25, 4), (0.6, 2), (2.0, 1))  # (until this fraction, times the final spacing)


@dataclass(frozen=True, eq=False)
class Batch:
    """What the loss of one step needs, arrays always of the same shapes; and how many samples and rays are real."""

    arrays: dict[str, Any]
    samples: int
    rays: int


class PackedScheme:
    """Draws rays, packs samples of what may hold something, and learns where that is."""

    def __init__(self, settings: TrainSettings, pool: PixelPool, domain: Domain, alive: np.ndarray, rng: np.random.Generator) -> None:
        self.settings, self.pool, self.domain, self.rng = settings, pool, domain, rng
        self.occupancy = Occupancy.of_hull(alive)
        self.occupied = self.occupancy.occupied
        self.samples_per_ray = 32.0
        self._inputs = jax.jit(partial(field_inputs, jnp, settings.family))
        self._density = jax.jit(lambda params, inputs: field_outputs(jnp, settings.family, params, inputs)[0])

    def spacing(self, fraction: float) -> float:
        """Distance between samples: coarse first, so that a step sees many rays while the shape is still rough."""
        return self.settings.spacing * next(factor for until, factor in SPACINGS if fraction < until)

    def learn(self, params: Any, step: int) -> None:
        """Now and then ask the field where something is, and give up cells with an opacity under 0.01 over one final interval."""
        if step % UPDATE_EVERY and step not in (16, 32):
            return
        self.occupancy.update(partial(self.density, params), UPDATE_CELLS, self.rng)
        if step >= WARM_UP:
            self.occupancy.prune(0.01 / self.settings.spacing)
        self.occupied = self.occupancy.occupied

    def density(self, params: Any, x: np.ndarray) -> np.ndarray:
        """Density [N] at field coordinates [N, 3], in chunks of one shape."""
        size = self.settings.samples
        found = np.empty(len(x), np.float32)
        for start in range(0, len(x), size):
            part = x[start : start + size]
            padded = np.zeros((size, 3), np.float32)
            padded[: len(part)] = part
            found[start : start + len(part)] = np.asarray(self._density(params["field"], self._inputs(padded)))[: len(part)]
        return found

    def batch(self, fraction: float) -> Batch:
        """A step's rays and packed samples."""
        size = self.settings.samples
        draw = int(min(size / self.samples_per_ray, MOST_RAYS - 1))
        index = self.pool.draw(draw, self.rng)
        origin, direction, near, *_ = self.pool.rays(index)
        got = pack_samples(self.domain, self.occupied, origin, direction, self.spacing(fraction), self.rng.random(draw), near)
        self.samples_per_ray = 0.7 * self.samples_per_ray + 0.3 * max(len(got.ray), 1) / draw
        # Whole rays only. None is cut short where the occupancy grid takes it to be opaque: such guesses end a few rays in
        # front of surfaces, what shines through is made up for by more density there, and that feeds on itself.
        count = len(got.ray) if len(got.ray) <= size else int(np.searchsorted(got.ray, got.ray[size]))
        points = np.zeros((size, 3), np.float32)
        points[:count] = got.points[:count]
        ray = np.full(size, MOST_RAYS - 1, np.int32)
        ray[:count] = got.ray[:count]
        directions = np.zeros((MOST_RAYS, 3), np.float32)
        directions[:, 2] = 1
        directions[:draw] = direction
        target = np.zeros((MOST_RAYS, 4), np.uint8)
        target[:draw] = self.pool.pixels[index]
        used = np.zeros(MOST_RAYS, bool)
        used[ray[:count]] = True
        if not count and not self.occupied.any():
            raise SnergError("The field has become empty everywhere; check that the images show something inside the box.")
        arrays = {
            "inputs": self._inputs(points),
            "ray": ray,
            "valid": np.arange(size) < count,
            "directions": directions,
            "target": target,
            "used": used,
            "length": np.float32(got.length),
        }
        if self.settings.background != "white":
            arrays["background"] = backgrounds(self.settings.background, MOST_RAYS, self.rng)
        if self.settings.density_noise:
            arrays["noise"] = self.rng.standard_normal(size, np.float32) * np.float32(self.settings.density_noise)
        return Batch(arrays, count, int(used.sum()))

    def loss(self, params: Any, batch: dict[str, Any]) -> tuple[Any, Any]:
        """Squared error (eq. 3), sparsity (eq. 8) and alpha; and the squared error alone."""
        return batch_loss(self.settings, self.pool.alpha, params, batch)

    def state(self) -> dict[str, np.ndarray]:
        """All that `restore` needs beside the parameters."""
        return {"most": self.occupancy.most, "samples_per_ray": np.float64(self.samples_per_ray)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Undo `state`."""
        self.occupancy = Occupancy(state["most"].copy())
        self.occupied = self.occupancy.occupied
        self.samples_per_ray = float(state["samples_per_ray"])


def batch_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, Any]:
    """Squared error (eq. 3), sparsity (eq. 8) and alpha; and the squared error alone."""
    view, directions = settings.view_dependence, batch["directions"]
    raw, values = raw_outputs(jnp, settings.family, params["field"], batch["inputs"])
    density = density_of(jnp, settings.family, raw + batch["noise"] if "noise" in batch else raw)
    values = sample_values(jnp, view, settings.family, params, values, directions[batch["ray"]])
    depth = optical_depth(jnp, jnp.where(batch["valid"], density, 0), batch["length"])
    gathered, through, _ = composite(jnp, depth, values, batch["ray"], MOST_RAYS)
    background = batch.get("background", 1.0)
    colour = ray_colour(jnp, view, params, gathered, through, directions, background)
    wanted, alpha = over(batch["target"].astype(jnp.float32) / 255, background)
    used = batch["used"].astype(jnp.float32)
    rays = jnp.maximum(used.sum(), 1)
    error = (((colour - wanted) ** 2).mean(axis=-1) * used).sum() / rays
    loss = error + settings.sparsity * (cauchy(jnp, density) * batch["valid"]).sum() / jnp.maximum(batch["valid"].sum(), 1)
    if has_alpha:
        loss = loss + settings.alpha * ((1 - through - alpha) ** 2 * used).sum() / rays
    return loss, error
