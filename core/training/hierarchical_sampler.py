"""Training with NeRF's hierarchical sampling (section 5.2): the weights of a coarse network place the samples of a fine one. Needs JAX."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..nerf.field import in_chunks
from ..nerf.model import density_of, field_inputs, field_outputs, raw_outputs
from ..nerf.sampling import CELLS, Domain, Occupancy, clip_rays, estimates
from ..nerf.shading import ray_colour, sample_values, unit
from ..nerf.volume_rendering import MAX_OPTICAL_DEPTH, composite_rows, optical_depth
from .config import TrainSettings
from .losses import backgrounds, cauchy, over
from .ray_dataset import RayDataset
from .sampler import Batch, BatchLoss, of_any_length
from .validation import ValidationRays

UPDATE_CELLS = 2**16  # cells of the occupancy grid that are measured in one update
UPDATE_EVERY = 256  # steps
QUERY = 8192  # points a call when the density alone is asked for
PADDING = 1e-5  # probability that a fine sample is drawn evenly over the ray


class HierarchicalSampler:
    """Draws rays; the loss samples them. It implements `sampler.Sampler`.

    The occupancy grid is not used for sampling; it is measured for the finished field.
    """

    def __init__(
        self, settings: TrainSettings, ray_dataset: RayDataset, domain: Domain, alive: NDArray[Any], rng: np.random.Generator
    ) -> None:
        self.settings, self.ray_dataset, self.domain, self.rng = settings, ray_dataset, domain, rng
        self.occupancy = Occupancy.of_hull(alive)
        self.occupied = alive
        self.loss = BatchLoss(rays_loss, of_any_length(settings), ray_dataset.alpha)
        family = settings.family
        plain = replace(settings, density_noise=0.0)
        self._render = jax.jit(lambda params, rays: render_rays(plain, params, rays)[-1].colour)
        self._density = jax.jit(lambda params, x: field_outputs(jnp, family, params, field_inputs(jnp, family, x))[0])

    def learn(self, params: Any, step: int, aux: dict[str, Any]) -> None:
        """Every UPDATE_EVERY steps, update the occupancy grid from the field's density."""
        if step % UPDATE_EVERY == 0:
            self.occupancy.update(partial(self.density, params), UPDATE_CELLS, self.rng)
            self.occupied = self._occupied()

    def density(self, params: Any, x: NDArray[Any]) -> NDArray[Any]:
        """Density [N] at field coordinates [N, 3]."""
        return in_chunks(lambda part: (self._density(params["field"], part),), x, QUERY)[0]

    def batch(self, params: Any, fraction: float) -> Batch:
        """The rays of a step. Raises SnergError when settings.distances is 'disparity' and a ray begins at distance 0."""
        count = self.settings.rays
        index = self.ray_dataset.draw(count, self.rng)
        arrays = self._arrays(*self.ray_dataset.rays(index))
        used = arrays["used"]
        arrays["target"] = self.ray_dataset.pixels[index]
        arrays["seed"] = self.rng.integers(0, 2**32, count, np.uint32)
        arrays["rays"] = np.float32(max(used.sum(), 1))
        if self.settings.background != "white":
            arrays["background"] = backgrounds(self.settings.background, count, self.rng)
        rays = int(used.sum())
        coarse, fine = self.settings.coarse, 0 if self.settings.hierarchy == "off" else self.settings.coarse + self.settings.fine
        return Batch(arrays, rays * (coarse + fine), rays)

    def colours(self, params: Any, rays: ValidationRays, fraction: float) -> NDArray[Any]:
        """Colours [R, 3] float32 of rays over their background; the same rays always get the same samples."""
        arrays = self._arrays(rays.origins, rays.directions, rays.near, rays.far, rays.view_directions)
        count, some = len(rays.near), self.settings.rays_at_once
        arrays |= {"seed": np.arange(count, dtype=np.uint32), "background": rays.background}
        seen = []
        for start in range(0, count, some):
            part = np.minimum(np.arange(start, start + some), count - 1)  # the last part is as long as the others
            seen.append(np.asarray(self._render(params, {name: value[part] for name, value in arrays.items()})))
        return np.where(arrays["used"][:, None], np.concatenate(seen)[:count], rays.background)

    def _arrays(
        self, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any], far: NDArray[Any], view_directions: NDArray[Any]
    ) -> dict[str, Any]:
        """The rays as the arrays that `render_rays` takes, and "used", bool [R]: whether a ray meets the domain."""
        near, leave = clip_rays(self.domain, origins, directions, near)
        far = np.minimum(leave, far)
        used = far > near
        if self.settings.distances == "disparity" and (near[used] <= 0).any():
            raise SnergError(
                "Sampling in disparity needs rays that begin in front of their cameras, and here a camera is inside the scene's box with "
                "nothing nearest set; give the cameras a near distance, or set distances=linear."
            )
        near, far = np.where(used, near, 1), np.where(used, far, 2)  # the others count nothing, and must be finite
        arrays = {"origins": origins, "directions": directions, "view_directions": unit(view_directions), "near": near, "far": far}
        return {name: value.astype(np.float32) for name, value in arrays.items()} | {"used": used}

    def state(self) -> dict[str, NDArray[Any]]:
        """What `restore` reads, named arrays of any shape."""
        return {"most": self.occupancy.most}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Continue from the named arrays of any shape that `state` returned. Raises ValueError or KeyError on another sampler's."""
        self.occupancy = Occupancy(estimates(state["most"], "most", (CELLS**3,)))
        self.occupied = self._occupied()

    def _occupied(self) -> NDArray[Any]:
        """Occupied cells, bool [CELLS^3]: not measured yet, or with an opacity above 0.01 over one interval of the final spacing."""
        return self.occupancy.most > 0.01 / self.settings.spacing


def rays_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Squared error of coarse and fine colours (eq. 3), sparsity (eq. 8) and alpha. aux: "error", the fine squared error alone.

    Rays are processed settings.rays_at_once at a time, and the backward pass recomputes their activations, so that memory does not grow
    with the batch. All results are sums over rays, divided by the number of rays in the whole batch.
    """
    whole = {name: value for name, value in batch.items() if jnp.ndim(value) == 0}
    each = {name: value for name, value in batch.items() if name not in whole}
    count = len(batch["near"])
    parts = next(n for n in range(-(-count // settings.rays_at_once), count + 1) if count % n == 0)
    loss = partial(_part_loss, settings, has_alpha)
    if parts == 1:
        return loss(params, batch)
    stacked = {name: jnp.moveaxis(value.reshape(-1, parts, *value.shape[1:]), 1, 0) for name, value in each.items()}
    # Without jax.checkpoint the scan would keep what all of its rays computed.
    some = jax.checkpoint(lambda params, part: loss(params, {**part, **whole}))
    totals = jax.lax.map(lambda part: some(params, part), stacked)
    summed: tuple[Any, dict[str, Any]] = jax.tree.map(lambda a: a.sum(axis=0), totals)
    return summed


def _part_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """`rays_loss` of one part of the rays, computed at once."""
    wanted, alpha = over(batch["target"].astype(jnp.float32) / 255, batch.get("background", 1.0))
    used = batch["used"].astype(jnp.float32) / batch["rays"]
    loss = error = jnp.float32(0)
    for seen in render_rays(settings, params, batch):
        error = (((seen.colour - wanted) ** 2).mean(axis=-1) * used).sum()
        loss = loss + error + settings.sparsity * (seen.sparsity * used).sum()
        if has_alpha and settings.alpha:
            loss = loss + settings.alpha * ((1 - seen.transmittance - alpha) ** 2 * used).sum()
    return loss, {"error": error}


class Seen(NamedTuple):
    """Rendered rays: colour [R, 3] over the background, transmittance [R], mean sparsity loss [R] (eq. 8) of the evenly spaced samples."""

    colour: Any
    transmittance: Any
    sparsity: Any


def render_rays(settings: TrainSettings, params: Any, batch: dict[str, Any]) -> tuple[Seen, ...]:
    """Render rays with the coarse and the fine network: (coarse, fine), or (the network,) where `params` has no "coarse" network.

    The coarse network, or the only one, has stratified samples; the fine one has these and samples drawn from the coarse weights (NeRF,
    section 5.2).

    batch: "origins", "directions" [R, 3] and "near", "far" [R] in the field's coordinates, "view_directions" [R, 3] unit, world axes,
    "seed" [R] uint32, each ray's own random numbers, and "background" [R, 3] unless it is white.
    """
    random = partial(_uniform, batch["seed"])
    along = stratified(jnp, batch["near"], batch["far"], random(0, settings.coarse), settings.distances == "disparity")
    everywhere = np.arange(settings.coarse)[None, :]
    if "coarse" not in params:
        return (_march(settings, params, batch, along, everywhere, 1)[0],)
    coarse, weights, borders = _march(settings, params["coarse"], batch, along, everywhere, 1)
    more = jax.lax.stop_gradient(resampled(borders, weights, spread(random(2, settings.fine))))
    both = jnp.concatenate([along, more], axis=-1)
    order = jnp.argsort(both, axis=-1)
    where = jnp.argsort(order, axis=-1)[:, : settings.coarse]  # of the coarse samples among all
    fine, _, _ = _march(settings, params, batch, jnp.take_along_axis(both, order, axis=-1), where, 3)
    return coarse, fine


def _march(settings: TrainSettings, params: Any, batch: dict[str, Any], along: Any, uniform: Any, noise: int) -> tuple[Seen, Any, Any]:
    """Render rays by their samples at distances `along` [R, K] (eqs. 2 to 7), with weights [R, K] and borders of intervals [R, K + 1].

    A sample's interval reaches to the next one (eq. 2); the first begins at near and the last ends at far, so that together
    they are the ray (hard case 19). uniform: which samples [R, C] are of equal spacing. noise: the stream of random numbers for
    density noise.
    """
    view, family = settings.view_dependence, settings.family
    rays, count = along.shape
    points = batch["origins"][:, None] + batch["directions"][:, None] * along[..., None]
    raw, values = raw_outputs(jnp, family, params["field"], field_inputs(jnp, family, points.reshape(-1, 3)))
    values = sample_values(jnp, view, family, params, values, jnp.repeat(batch["view_directions"], count, axis=0))
    raw = raw.reshape(rays, count)
    sparsity = cauchy(jnp, density_of(jnp, family, jnp.take_along_axis(raw, uniform, axis=-1))).mean(axis=-1)
    if settings.density_noise:
        raw = raw + settings.density_noise * _normal(batch["seed"], noise, count)
    borders = jnp.concatenate([batch["near"][:, None], along[:, 1:], batch["far"][:, None]], axis=-1)
    depth = optical_depth(jnp, density_of(jnp, family, raw), jnp.diff(borders, axis=-1))
    if settings.opaque:
        depth = depth.at[:, -1].set(MAX_OPTICAL_DEPTH)
    gathered, transmittance, weights = composite_rows(jnp, depth, values.reshape(rays, count, -1))
    colour = ray_colour(jnp, view, params, gathered, transmittance, batch["view_directions"], batch.get("background", 1.0))
    return Seen(colour, transmittance, sparsity), weights, borders


def stratified(xnp: Any, near: Any, far: Any, random: Any, disparity: bool) -> Any:
    """Distances [R, K], one in each of K equal parts of near [R] .. far [R] (NeRF, eq. 2), increasing.

    random: [R, K] in [0, 1). disparity: the parts are equal in 1 / distance, for which near must be above 0.
    """
    count = random.shape[-1]
    share = (xnp.arange(count, dtype=np.float32) + xnp.minimum(random, 1 - 1e-3)) / count  # rounding must not reach the next part
    near, far = near[:, None], far[:, None]
    if disparity:
        return 1 / ((1 - share) / near + share / far)
    return near * (1 - share) + far * share


def spread(random: Any) -> Any:
    """Stratified random numbers [R, K] in [0, 1), ascending, one in each of K equal parts, from uniform ones [R, K] in [0, 1)."""
    count = random.shape[-1]
    return (jnp.arange(count, dtype=np.float32) + random) / count


def resampled(borders: Any, weights: Any, chances: Any) -> Any:
    """Distances [R, M] drawn by inverse transform sampling from a piecewise constant density (NeRF, section 5.2).

    The density has weights [R, K] on intervals with borders [R, K + 1], which are distances in field coordinates. chances: [R, M], uniform
    random numbers in [0, 1). The probability PADDING is spread evenly over the K intervals, so that each can be drawn, also where
    all weights are 0 (hard case 15). Weights that are not finite give NaN, so that the step is skipped (hard case 16).
    """
    total = weights.sum(axis=-1, keepdims=True)
    some = ~(total <= 1e-30)  # a NaN is some
    share = jnp.where(some, weights / jnp.where(some, total, 1), 1 / weights.shape[-1])
    share = (1 - PADDING) * share + PADDING / weights.shape[-1]
    ends = jnp.minimum(jnp.cumsum(share, axis=-1), 1).at[:, -1].set(1)
    cumulated = jnp.concatenate([jnp.zeros_like(ends[:, :1]), ends], axis=-1)
    place = jax.vmap(partial(jnp.searchsorted, side="right"))(cumulated, chances) - 1  # hard case 17: no table of rays x K x M
    place = jnp.clip(place, 0, weights.shape[-1] - 1)
    low, high, start, end = (jnp.take_along_axis(a, p, axis=-1) for a in (cumulated, borders) for p in (place, place + 1))
    inside = jnp.clip((chances - low) / jnp.maximum(high - low, 1e-30), 0, 1)
    return jnp.where(jnp.isfinite(total), start + inside * (end - start), jnp.nan)


def _uniform(seeds: Any, stream: int, count: int) -> Any:
    """Uniform random numbers [R, count] in [0, 1), from each ray's own seed: they do not depend on the other rays of the batch."""
    return jax.vmap(lambda seed: jax.random.uniform(_key(seed, stream), (count,)))(seeds)


def _normal(seeds: Any, stream: int, count: int) -> Any:
    return jax.vmap(lambda seed: jax.random.normal(_key(seed, stream), (count,)))(seeds)


def _key(seed: Any, stream: int) -> Any:
    return jax.random.fold_in(jax.random.key(seed), stream)
