"""Fits the voxels of a baked scene, with its network, to the training images through the march. Uses JAX.

As PlenOctrees (Yu et al., ICCV 2021, section 4.2) and Plenoxels (Fridovich-Keil et al., CVPR 2022) do, colour, features and opacity of
the voxels that training rays sample are moved by Adam. Whole views are kept out, and the voxels that are best on them, as they are
stored, are returned: so a fit never loses there. Voxels that are 0 stay 0, so that the scene takes as many blocks as before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import ViewNetwork, as_numpy, view_residual
from ..progress import Progress, silent, within
from ..rendering.interpolator import CORNER_OFFSETS
from ..rendering.opacity import opacity_factor
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates, fill_aprons
from ..scene.quantize import quantize
from ..scene.scene import Scene
from .fine_tune import MIN_IMPROVEMENT, MIN_PIXELS, VALIDATION_EVERY, psnr
from .jitter import voxel_uniform
from .ray_samples import MAX_RAY_SAMPLES, NO_VOXEL, RaySamples, corners_of, own_voxels, sampled_views, stencil_weights

MARCH_SHARE = 0.3  # of the progress that marching the training views gets
BATCH_SAMPLES = 12  # samples a ray for which a batch has room, on average
BETA_1, BETA_2, EPSILON = 0.9, 0.99, 1e-9  # of Adam
MAX_ALPHA = 0.9999  # of a sample, whose logarithm of transmittance must be finite
MAX_NUMBER = 2**31 - 1  # of int32, in which JAX numbers voxels
MIN_ALPHA = 1e-3  # of a voxel, by which premultiplied values are divided


@dataclass(frozen=True)
class FitSettings:
    """How voxels are fitted."""

    pixels: int = 4_000_000  # of all training views, of which those that hit something are fitted to: bounds the memory and the time
    passes: int = 2  # over these pixels
    batch: int = 4096  # rays a step, at most
    rate: float = 3e-3  # of Adam at the start, of values in [0, 1]; at 2e-2 views that were kept out lose 1.7 dB
    network_rate: float = 1e-3  # of the network's weights
    final_rate: float = 0.1  # rates at the end, as a share of those at the start; they decay exponentially
    evaluations: int = 10  # on the views that are kept out, over the whole fit
    patience: int = 2  # evaluations without a gain after which it stops
    seed: int = 0  # of the choice of pixels and their order
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)  # RGB in [0, 1] over which images with alpha are fitted


class Batch(NamedTuple):
    """Rays [R] and their samples [S]; arrays of always the same shapes, so that a step is compiled once.

    base, fraction: see RaySamples. ray, slot: int32 [S], the sample's ray, and its number on that ray. valid: float32 [S], 0 in samples
    that fill up the batch. view_directions, pixels: of the rays. used: float32 [R], 0 in rays that fill up the batch.
    """

    base: Any
    fraction: Any
    ray: Any
    slot: Any
    valid: Any
    view_directions: Any
    pixels: Any
    used: Any


class Fitted(NamedTuple):
    """What a fit moves. voxels: [P + 1, C], straight colour and features and alpha, in [0, 1]; the last one is empty and stays 0."""

    voxels: Any
    network: ViewNetwork | None


@dataclass(frozen=True, eq=False)
class Voxels:
    """The voxels of a scene that a fit moves. rows: [P] their indices in the atlas, own voxels of their blocks. numbers: int32 [M * 32^3],
    of each voxel of the atlas its number among them, or P. stored: [P + 1, C] their values in the scene, then zeros."""

    rows: NDArray[Any]
    numbers: NDArray[Any]
    stored: NDArray[Any]

    @classmethod
    def of(cls, scene: Scene, samples: RaySamples) -> Voxels:
        """Those that some of the samples lie next to, and that are not 0."""
        own, cells = own_voxels(scene), scene.cells.reshape(-1, scene.cells.shape[-1])
        touched = np.zeros(len(own) + 1, bool)
        for offset in CORNER_OFFSETS:
            touched[own[samples.base + offset]] = True  # NO_VOXEL is the last
        rows = np.flatnonzero(touched[:-1] & (cells[:, -1] > 0))
        numbers = np.full(len(own) + 1, len(rows), np.int32)
        numbers[rows] = np.arange(len(rows), dtype=np.int32)
        assert NO_VOXEL == -1
        return cls(rows, numbers[own], np.concatenate([cells[rows], np.zeros((1, cells.shape[1]), cells.dtype)]))

    def straight(self, unit: float) -> NDArray[Any]:
        """The stored values as `Fitted.voxels`. unit: stored value of 1."""
        values = self.stored.astype(np.float32) / np.float32(unit)
        alpha = values[:, -1:]
        return np.concatenate([np.minimum(values[:, :-1] / np.maximum(alpha, MIN_ALPHA), 1), alpha], axis=-1)


def fit_voxels(
    scene: Scene, dataset: Dataset, settings: FitSettings = FitSettings(), progress: Progress = silent
) -> tuple[Scene, dict[str, Any]]:
    """Fit a scene's voxels and its network to the images of a dataset.

    Returns the scene that is best on the views kept out (as it was, if none is better), and a report: "psnr_before", "psnr_after" and
    "gain_db" on pixels of those views that hit the scene, "steps", "voxels", "settings" and "seconds". A scene that cannot be fitted is
    returned as it is, with the reason under "skipped". The same seed gives the same bytes on the same processor.
    Raises SnergError when an image cannot be read, Cancelled when `progress` does.
    """
    if reason := _unfit(scene, dataset):
        return scene, {"skipped": reason}
    began = time.perf_counter()
    training, validation = _recorded(scene, dataset, settings, within(progress, 0, MARCH_SHARE))
    if min(len(training), len(validation)) < MIN_PIXELS:
        return scene, {"skipped": "no training view sees the scene"}
    marched = time.perf_counter()
    voxels = Voxels.of(scene, training)
    stored, network, report = _fit(scene, voxels, training, validation, settings, within(progress, MARCH_SHARE, 1))
    report |= {
        "voxels": len(voxels.rows),
        "settings": asdict(settings),
        "seconds": {"march": round(marched - began, 3), "fit": round(time.perf_counter() - marched, 3)},
    }
    cells = scene.cells.copy()
    cells.reshape(-1, cells.shape[-1])[voxels.rows] = stored[:-1]
    for _ in fill_aprons(cells, scene.indirection):
        pass
    return replace(scene, cells=cells, network=network, about={**scene.about, "fit": report}), report


def _unfit(scene: Scene, dataset: Dataset) -> str:
    """Why a scene cannot be fitted, '' where it can."""
    if not len(scene.cells):
        return "the scene is empty"
    if len(scene.cells) * CELL_VOXELS**3 > MAX_NUMBER:
        return "the scene has too many voxels"
    return "" if len(dataset.views) > 1 else "there is no view to keep out"


def _recorded(scene: Scene, dataset: Dataset, settings: FitSettings, progress: Progress) -> tuple[RaySamples, RaySamples]:
    """The samples of the views that are fitted to, and of those that are kept out."""
    views = np.arange(len(dataset.views))
    middle = min(VALIDATION_EVERY, len(views)) // 2
    kept_out = views % VALIDATION_EVERY == middle
    share = int(kept_out.sum()) / len(views)
    parts = []
    for some, begin, end in ((views[~kept_out], 0.0, 1 - share), (views[kept_out], 1 - share, 1.0)):
        pixels = round(settings.pixels * len(some) / len(views))
        parts.append(RaySamples.concatenate(list(sampled_views(scene, dataset, some, pixels, settings.seed, within(progress, begin, end)))))
    return parts[0], parts[1]


def _fit(
    scene: Scene, voxels: Voxels, training: RaySamples, validation: RaySamples, settings: FitSettings, progress: Progress
) -> tuple[NDArray[Any], ViewNetwork | None, dict[str, Any]]:
    """The stored values [P + 1, C] and the network that are best on the validation samples, and the report's measurements."""
    rng = np.random.default_rng(settings.seed)
    numbers, unit = jnp.asarray(voxels.numbers), scene.unit
    start = jnp.asarray(voxels.straight(unit))
    fitted = Fitted(start, None if scene.network is None else ViewNetwork(*(jnp.asarray(array) for array in scene.network)))
    moments = jax.tree.map(jnp.zeros_like, (fitted, fitted))
    measured = list(batches(validation, np.arange(len(validation)), settings.batch))
    run = partial(_step, settings=settings, correct=scene.opacity_correction)

    def error(stored: NDArray[Any], network: ViewNetwork | None) -> float:
        now = jnp.asarray(stored)
        sums = [
            float(_stored_error(now, network, numbers, batch, settings.background, unit, scene.opacity_correction)) for batch in measured
        ]
        return sum(sums) / (3 * len(validation))

    steps = settings.passes * sum(1 for _ in batch_ends(training, np.arange(len(training)), settings.batch))
    best_of = _Best(error(voxels.stored, fitted.network), voxels.stored, scene.network)
    every, step = max(1, -(-steps // settings.evaluations)), 0
    for step, batch in enumerate(_passes(training, settings, rng), 1):
        fitted, moments = run(fitted, moments, step, settings.final_rate ** (step / steps), numbers, batch)
        if step % every == 0:
            stored = _stored(scene, voxels, np.asarray(fitted.voxels), settings.seed)
            best_of.add(error(stored, fitted.network), stored, fitted.network)
        progress(min(step / steps, 1), f"Fitting voxels: {best_of.text()}")
        if best_of.without_gain >= settings.patience:
            break
    return best_of.stored, best_of.network, {**best_of.report(), "steps": step}


class _Best:
    """The values with the least error so far."""

    def __init__(self, error: float, stored: NDArray[Any], network: ViewNetwork | None) -> None:
        self.first = self.error = error
        self.stored, self.network, self.without_gain = stored, network, 0

    def add(self, error: float, stored: NDArray[Any], network: ViewNetwork | None) -> None:
        """Compare other values. Raises SnergError when their error is not finite."""
        if not np.isfinite(error):
            raise SnergError("Fitting the voxels went wrong: the error is not finite; bake without --fit and check the dataset's images.")
        self.without_gain = 0 if error < self.error * (1 - MIN_IMPROVEMENT) else self.without_gain + 1
        if error < self.error:
            self.error, self.stored, self.network = error, stored, None if network is None else as_numpy(network)

    def text(self) -> str:
        return f"{psnr(self.error):.2f} dB, was {psnr(self.first):.2f}"

    def report(self) -> dict[str, float]:
        before, after = psnr(self.first), psnr(self.error)
        return {"psnr_before": before, "psnr_after": after, "gain_db": after - before}


def _passes(samples: RaySamples, settings: FitSettings, rng: np.random.Generator) -> Iterator[Batch]:
    """The batches of all passes, each in another random order."""
    for _ in range(settings.passes):
        yield from batches(samples, rng.permutation(len(samples)), settings.batch)


def batch_ends(samples: RaySamples, order: NDArray[Any], size: int) -> Iterator[tuple[int, int]]:
    """(first, end) of each batch among rays in an order [n]: as many as have room in it, of at most size - 1 rays.

    The last ray and the last samples of a batch are never used: what fills up the batch points there.
    """
    ends = np.cumsum(samples.first[order + 1] - samples.first[order])
    first = 0
    while first < len(order):
        before = int(ends[first - 1]) if first else 0
        end = min(int(np.searchsorted(ends, before + size * BATCH_SAMPLES, side="right")), first + size - 1)
        yield first, end
        first = end


def batches(samples: RaySamples, order: NDArray[Any], size: int) -> Iterator[Batch]:
    """The batches of rays in an order [n]."""
    for first, end in batch_ends(samples, order, size):
        rays = order[first:end]
        rows, ray, slot = samples.rows(rays)
        of_samples = (
            samples.base[rows],
            samples.fraction[rows],
            ray.astype(np.int32),
            slot.astype(np.int32),
            np.ones(len(rows), np.float32),
        )
        of_rays = (samples.view_directions[rays], samples.pixels[rays], np.ones(len(rays), np.float32))
        rest = (0, 0, size - 1, MAX_RAY_SAMPLES - 1, 0)
        filled = [_filled_up(values, size * BATCH_SAMPLES, value) for values, value in zip(of_samples, rest, strict=True)]
        yield Batch(*filled, *(_filled_up(values, size, 0) for values in of_rays))


def _filled_up(values: NDArray[Any], size: int, value: int) -> NDArray[Any]:
    """Values [n, ...] followed by `value`, [size, ...]."""
    result = np.full((size, *values.shape[1:]), value, values.dtype)
    result[: len(values)] = values
    return result


def pixel_errors(corners: Any, network: ViewNetwork | None, batch: Batch, background: tuple[float, ...], correct: bool) -> Any:
    """What the scene shows minus the image, [R, 3], over a background. corners: [S, 8, C], premultiplied values of the stencils' corners.

    correct: whether the scene has opacity correction (eq. 9).
    """
    values = jnp.einsum("sk,skc->sc", stencil_weights(jnp, batch.fraction), corners)
    rays, alpha = len(batch.pixels), jnp.clip(values[:, -1], 0, MAX_ALPHA) * batch.valid
    depth = jnp.zeros((rays, MAX_RAY_SAMPLES)).at[batch.ray, batch.slot].add(-jnp.log1p(-alpha))
    before = jnp.exp(depth - jnp.cumsum(depth, axis=1))[batch.ray, batch.slot]
    weighted = (before * batch.valid)[:, None] * values[:, :-1]
    composited = jax.ops.segment_sum(weighted, batch.ray, rays, indices_are_sorted=True)
    transmittance = jnp.exp(-depth.sum(axis=1))[:, None]
    if correct:
        factor = opacity_factor(jnp, 1 - transmittance)
        composited, transmittance = composited * factor, jnp.maximum(1 - factor * (1 - transmittance), 0)
    behind, pixels = jnp.asarray(background, jnp.float32), batch.pixels.astype(jnp.float32) / 255
    colour = composited[:, :3] + transmittance * behind
    if network is not None:
        residual = view_residual(jnp, network, composited[:, :3] + transmittance, composited[:, 3:], batch.view_directions)
        colour = colour + jnp.where(transmittance <= NETWORK_TRANSMITTANCE, residual, 0)
    return (colour - pixels[:, :3] * pixels[:, 3:] - (1 - pixels[:, 3:]) * behind) * batch.used[:, None]


def premultiplied(xnp: Any, voxels: Any) -> Any:
    """Straight values [..., C], alpha last, times their alpha."""
    return xnp.concatenate([voxels[..., :-1] * voxels[..., -1:], voxels[..., -1:]], axis=-1)


@partial(jax.jit, static_argnames=("settings", "correct"), donate_argnums=(0, 1))
def _step(fitted: Fitted, moments: Any, step: Any, decay: Any, numbers: Any, batch: Batch, settings: FitSettings, correct: bool) -> Any:
    """One step of Adam on the squared error of a batch; returns the values and the moments. step: from 1."""

    def loss(fitted: Fitted) -> Any:
        corners = premultiplied(jnp, fitted.voxels[numbers[corners_of(batch.base)]])
        return (pixel_errors(corners, fitted.network, batch, settings.background, correct) ** 2).sum() / (3 * batch.used.sum())

    gradient = jax.grad(loss)(fitted)
    if fitted.network is not None:  # rows of the first layer that are all 0 stay 0, as in fine_tune.adam_step
        weights = gradient.network.weights_0 * (fitted.network.weights_0 != 0).any(axis=1, keepdims=True)
        gradient = gradient._replace(network=gradient.network._replace(weights_0=weights))
    first, second = moments
    first = jax.tree.map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, first, gradient)
    second = jax.tree.map(lambda v, g: BETA_2 * v + (1 - BETA_2) * g * g, second, gradient)
    unbias = jnp.sqrt(1 - BETA_2 ** jnp.float32(step)) / (1 - BETA_1 ** jnp.float32(step))
    rates = Fitted(settings.rate, None if fitted.network is None else ViewNetwork(*[settings.network_rate] * 6))
    moved = jax.tree.map(lambda p, r, m, v: p - r * decay * unbias * m / (jnp.sqrt(v) + EPSILON), fitted, rates, first, second)
    return moved._replace(voxels=jnp.clip(moved.voxels, 0, 1).at[-1].set(0)), (first, second)


@partial(jax.jit, static_argnames=("background", "unit", "correct"))
def _stored_error(
    stored: Any, network: ViewNetwork | None, numbers: Any, batch: Batch, background: tuple[float, ...], unit: float, correct: bool
) -> Any:
    """The sum of squared errors of a batch, of voxels as they are stored, [P + 1, C]."""
    corners = stored[numbers[corners_of(batch.base)]].astype(jnp.float32) / unit
    return (pixel_errors(corners, network, batch, background, correct) ** 2).sum()


def _stored(scene: Scene, voxels: Voxels, values: NDArray[Any], seed: int) -> NDArray[Any]:
    """Fitted voxels [P + 1, C] as the scene stores them."""
    full = premultiplied(np, values)
    if not scene.quantised:
        return np.asarray(full)
    cell, local = np.divmod(voxels.rows, CELL_VOXELS**3)
    inside = np.stack(np.unravel_index(local, (CELL_VOXELS,) * 3), axis=-1) - 1
    places = block_coordinates(scene.indirection)[cell] * DATA_VOXELS + inside
    noise = np.concatenate([voxel_uniform(places, full.shape[1], seed + 1), np.zeros((1, full.shape[1]), np.float32)])
    return quantize(full, noise)
