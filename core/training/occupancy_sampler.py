"""Training on packed samples (Mueller et al. 2022, section 5): samples in occupied cells only, in one list, ray after ray. Needs JAX."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.schema import positive
from ..nerf.field import in_chunks
from ..nerf.model import ModelConfig, density_of, field_inputs, field_outputs, raw_outputs
from ..nerf.sampling import CELLS, Domain, Occupancy, estimates, pack_samples
from ..nerf.shading import ray_colour, sample_values
from ..nerf.volume_rendering import composite, depth_before, optical_depth
from .config import TrainSettings
from .losses import backgrounds, cauchy, diffuse_error, over, softness
from .ray_dataset import RayDataset
from .sampler import Batch, BatchLoss, of_any_length
from .termination_depth import DARK, LEFT, TerminationDepths
from .validation import ValidationRays, packed_colours

MARGIN = 2  # samples that a ray takes past the termination depth of its tile
UPDATE_CELLS = 2**18  # cells of the occupancy grid that are measured in one update
UPDATE_EVERY = 64  # steps
WARM_UP = 256  # steps before an occupancy cell may become empty
SPACINGS = ((0.1, 8), (0.25, 4), (0.6, 2), (math.inf, 1))  # (until this fraction of a minute's training, times the final spacing)
STEPS_A_MINUTE = 1200  # of a training that has steps and no time, about


@dataclass(frozen=True, eq=False)
class DrawnRays:
    """The R rays and N samples of the last batch, as `learn` needs them."""

    tile: NDArray[Any]  # [R] tiles of the rays
    skipped: NDArray[Any]  # bool [R], cut by the termination depth before their first sample
    ray: NDArray[Any]  # [N] the samples' rays
    distance: NDArray[Any]  # [N] the samples' distances along them


class OccupancySampler:
    """Draws rays and packs the samples in occupied cells; updates the occupancy grid and the termination depths from each step."""

    def __init__(
        self, settings: TrainSettings, ray_dataset: RayDataset, domain: Domain, alive: NDArray[Any], rng: np.random.Generator
    ) -> None:
        self.settings, self.ray_dataset, self.domain, self.rng = settings, ray_dataset, domain, rng
        self.occupancy = Occupancy.of_hull(alive)
        self.occupied = self.occupancy.occupied
        self.termination = TerminationDepths(ray_dataset)
        self.coarse_share = coarse_share(settings)
        self.most_rays = max(settings.samples // 4, 64)
        self.samples_per_ray = 32.0
        self._inputs, self._outputs = compiled(settings.family)
        self.loss = BatchLoss(batch_loss, of_any_length(settings), ray_dataset.alpha)

    def spacing(self, fraction: float) -> float:
        """The sample spacing in field coordinates at a fraction of the training in [0, 1]. It is large at first (see SPACINGS), so that a
        step covers many rays while the geometry is still rough."""
        return self.settings.spacing * next(factor for until, factor in SPACINGS if fraction < until * self.coarse_share)

    def learn(self, params: Any, step: int, aux: dict[str, Any]) -> None:
        """Update the termination depths; every UPDATE_EVERY steps, the occupancy grid too: cells with an opacity under 0.01 over one
        final interval become empty after WARM_UP steps."""
        self._learn_termination(aux)
        if self.is_due(step):
            self.update_occupancy(params, step)

    @staticmethod
    def is_due(step: int) -> bool:
        """Whether the occupancy grid is updated after a step."""
        return step % UPDATE_EVERY == 0 or step in (16, 32)

    def update_occupancy(self, params: Any, step: int) -> None:
        """Measure cells of the occupancy grid; from WARM_UP on, some become empty."""
        self.occupancy.update(partial(self.density, params), UPDATE_CELLS, self.rng)
        if step >= WARM_UP:
            self.occupancy.prune(0.01 / self.settings.spacing)
        self.occupied = self.occupancy.occupied

    def density(self, params: Any, x: NDArray[Any]) -> NDArray[Any]:
        """Density [N] at field coordinates [N, 3]."""
        field = params["field"]
        return in_chunks(lambda part: self._outputs(field, self._inputs(part))[:1], x, self.settings.samples)[0]

    def colours(self, params: Any, rays: ValidationRays, fraction: float) -> NDArray[Any]:
        """Colours [R, 3] of rays over their background, at the present spacing."""
        field = params["field"]

        def evaluate(x: NDArray[Any]) -> tuple[NDArray[Any], ...]:
            return in_chunks(lambda part: self._outputs(field, self._inputs(part)), x, self.settings.samples)

        return packed_colours(self.settings, self.domain, self.occupied, self.spacing(fraction), evaluate, params, rays)

    def batch(self, params: Any, fraction: float) -> Batch:
        """A step's rays and packed samples. Rays are whole: from where they enter the domain to their tile's termination depth."""
        size, most, length = self.settings.samples, self.most_rays, self.spacing(fraction)
        draw = int(min(size / self.samples_per_ray, most - 1))
        index = self.ray_dataset.draw(draw, self.rng)
        origin, direction, near, far, view_directions = self.ray_dataset.rays(index)
        tile = self.termination.tile(index)
        until = self.termination.depths[tile] + MARGIN * length
        got = pack_samples(self.domain, self.occupied, origin, direction, length, self.rng.random(draw), near, far, until)
        self.samples_per_ray = 0.7 * self.samples_per_ray + 0.3 * max(len(got.ray), 1) / draw
        count = len(got.ray) if len(got.ray) <= size else int(np.searchsorted(got.ray, got.ray[size]))
        if not count and not self.occupied.any():
            raise SnergError("The field has become empty everywhere; check that the images show something inside the box.")
        ray = filled(size, got.ray[:count], most - 1)
        used = np.zeros(most, bool)
        used[ray[:count]] = True
        skipped = got.cut & (np.bincount(got.ray, minlength=draw) == 0)
        self.drawn = DrawnRays(tile, skipped, got.ray[:count], got.distance[:count])
        arrays = {
            "inputs": self._inputs(filled(size, got.points[:count])),
            "ray": ray,
            "valid": np.arange(size) < count,
            "directions": filled(most, view_directions.astype(np.float32), [0, 0, 1]),
            "target": filled(most, self.ray_dataset.pixels[index]),
            "used": used,
            "cut": filled(most, got.cut),
            "length": np.float32(got.length),
            "count": np.float32(max(count, 1)),
            "rays": np.float32(max(used.sum(), 1)),
        }
        if self.settings.background != "white":
            arrays["background"] = backgrounds(self.settings.background, most, self.rng)
        if self.ray_dataset.diffuse is not None:
            arrays["diffuse"] = filled(most, self.ray_dataset.diffuse[index])
        if self.settings.density_noise:
            arrays["noise"] = self.rng.standard_normal(size, np.float32) * np.float32(self.settings.density_noise)
        return Batch(arrays, count, int(used.sum()))

    def _learn_termination(self, aux: dict[str, Any]) -> None:
        """Update the termination depths of the last batch's tiles; a ray that had no sample because it was cut resets its tile to
        infinity."""
        ray, lit, depth = self.drawn.ray, np.asarray(aux["lit_samples"]), np.asarray(aux["depth"])
        first = np.flatnonzero(np.diff(ray, prepend=-1))
        rays = ray[first]
        last = first + lit[rays].astype(np.int64).clip(1) - 1
        end = np.where(depth[rays] > -np.log(DARK), self.drawn.distance[last], np.float32(np.inf))
        skipped = self.drawn.tile[self.drawn.skipped]
        never = np.full(len(skipped), np.inf, np.float32)
        self.termination.learn(np.concatenate([self.drawn.tile[rays], skipped]), np.concatenate([end, never]))

    def state(self) -> dict[str, NDArray[Any]]:
        """What `restore` reads, named arrays of any shape."""
        return {"most": self.occupancy.most, "reach": self.termination.depths, "samples_per_ray": np.array(self.samples_per_ray)}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Continue from the named arrays of any shape that `state` returned. Raises ValueError or KeyError on another sampler's."""
        self.occupancy = Occupancy(estimates(state["most"], "most", (CELLS**3,)))
        self.occupied = self.occupancy.occupied
        self.termination.depths = estimates(state["reach"], "reach", self.termination.depths.shape)
        self.samples_per_ray = positive(float(state["samples_per_ray"]), "samples_per_ray")


@cache
def compiled(family: ModelConfig) -> tuple[Any, Any]:
    """`field_inputs` and `field_outputs` of a model, compiled: once in a process, however many trainings it has."""
    return jax.jit(partial(field_inputs, jnp, family)), jax.jit(partial(field_outputs, jnp, family))


def batch_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """(loss, aux): squared error (eq. 3), sparsity (eq. 8), squared error of alpha, opacity regulariser (`losses.softness`),
    error of the diffuse colour (`losses.diffuse_error`).

    aux: "error", the squared error alone; "lit_samples" [R], how many samples of a ray have a transmittance above DARK before
    them; "depth" [R], the optical depth of a ray.
    """
    view, directions, ray = settings.view_dependence, batch["directions"], batch["ray"]
    raw, values = raw_outputs(jnp, settings.family, params["field"], batch["inputs"])
    density = density_of(jnp, settings.family, raw + batch["noise"] if "noise" in batch else raw)
    values = sample_values(jnp, view, settings.family, params, values, directions[ray])
    depth = optical_depth(jnp, jnp.where(batch["valid"], density, 0), batch["length"])
    gathered, transmittance, weights = composite(jnp, depth, values, ray, len(directions))
    background = batch.get("background", 1.0)
    colour = ray_colour(jnp, view, params, gathered, transmittance, directions, background)
    wanted, alpha = over(batch["target"].astype(jnp.float32) / 255, background)
    used = (batch["used"] & ~(batch["cut"] & (transmittance > LEFT))).astype(jnp.float32)
    error = (((colour - wanted) ** 2).mean(axis=-1) * used).sum() / batch["rays"]
    loss = error + settings.sparsity * (cauchy(jnp, density) * batch["valid"]).sum() / batch["count"]
    if settings.hardness:
        loss = loss + settings.hardness * (softness(weights) * used[ray]).sum() / batch["rays"]
    if has_alpha:
        loss = loss + settings.alpha * ((1 - transmittance - alpha) ** 2 * used).sum() / batch["rays"]
    if "diffuse" in batch:
        error_of_light = diffuse_error(jnp, gathered[:, :3], batch["diffuse"], batch["target"])
        loss = loss + settings.diffuse * (error_of_light * used).sum() / batch["rays"]
    lit = batch["valid"] & (depth_before(jnp, depth, ray) < -math.log(DARK))
    per_ray = jnp.zeros((len(directions), 2)).at[ray].add(jnp.stack([lit, depth], axis=-1), indices_are_sorted=True)
    return loss, {"error": error, "lit_samples": per_ray[:, 0], "depth": per_ray[:, 1]}


def coarse_share(settings: TrainSettings) -> float:
    """The factor in (0, 1] by which the fractions of SPACINGS, which hold for one minute's training, are multiplied for this training.

    A longer training spends more time at coarse spacings, but a smaller share of its time (measured: a factor of 0.5 gains 0.17 dB in
    a training of five minutes and loses 0.7 dB in one of one minute).
    """
    minutes = (settings.seconds or 0) / 60 if settings.steps is None else settings.steps / STEPS_A_MINUTE
    return float(min(1.0, minutes**-0.4))


def filled(size: int, values: NDArray[Any], rest: Any = 0) -> NDArray[Any]:
    """Pad the values [n, ...] with `rest` to [size, ...]."""
    result = np.empty((size, *values.shape[1:]), values.dtype)
    result[: len(values)] = values
    result[len(values) :] = rest
    return result
