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
from ..io.settings import check_colour, check_number, check_whole
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import ViewNetwork, as_numpy, view_residual
from ..progress import Progress, silent, within
from ..rendering.opacity import opacity_factor
from ..scene.blocks import fill_aprons
from ..scene.scene import Scene
from .fine_tune import MIN_IMPROVEMENT, MIN_PIXELS, VALIDATION_EVERY, psnr
from .fit_batches import Batch, Neighbourhoods, Voxels, batch_ends, batches
from .ray_samples import FIT_PASSES, FIT_PIXELS, FIT_RAYS, MAX_RAY_SAMPLES, RaySamples, sampled_views, stencil_weights

VALIDATION_PIXELS = 250_000  # of the views kept out, at most
MARCH_SHARE = 0.3  # of the progress that marching the training views gets
BETA_1, BETA_2, EPSILON = 0.9, 0.99, 1e-9  # of Adam
UNTOUCHED = 1e-9  # magnitude of a gradient up to which a value keeps its moments (see optimizer.train_step)
MAX_ALPHA = 0.9999  # of a sample, whose logarithm of transmittance must be finite


@dataclass(frozen=True)
class FitSettings:
    """How voxels are fitted. Raises SnergError for values out of range."""

    pixels: int = FIT_PIXELS  # of all training views, of which those that hit the scene are fitted to
    rays: int = FIT_RAYS  # in all passes together, at most
    passes: int = FIT_PASSES  # over these pixels, at most
    batch: int = 2048  # rays a step, at most
    rate: float = 3e-3  # of Adam at the start, of values in [0, 1]; at 2e-2 views that were kept out lose 1.7 dB
    network_rate: float = 1e-3  # of the network's weights
    final_rate: float = 0.1  # rates at the end, as a share of those at the start; they decay exponentially
    evaluations: int = 6  # on the views that are kept out, over the whole fit
    patience: int = 4  # evaluations without a gain after which it stops; on fine grids most is gained when the rate is low
    seed: int = 0  # of the choice of pixels and their order
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)  # RGB in [0, 1] over which images with alpha are fitted

    def __post_init__(self) -> None:
        for name in ("pixels", "rays", "passes", "batch", "evaluations", "patience"):
            check_whole(f"The fit's setting {name}", getattr(self, name), 1, 2**40)
        for name in ("rate", "network_rate", "final_rate"):
            check_number(f"The fit's setting {name}", getattr(self, name), 0, 1e3)
        check_whole("The seed of the fit", self.seed, 0, 2**63 - 1)
        check_colour("The background of the fit", self.background)


class Fitted(NamedTuple):
    """What a fit moves. voxels: [P, C], straight colour and features and alpha, in [0, 1]; the last one stays 0."""

    voxels: Any
    network: ViewNetwork | None


def fit_voxels(
    scene: Scene, dataset: Dataset, settings: FitSettings = FitSettings(), progress: Progress = silent
) -> tuple[Scene, dict[str, Any]]:
    """Fit a scene's voxels and its network to the images of a dataset.

    Returns the scene that is best on the views kept out (as it was, if none is better), and a report: "psnr_before", "psnr_after" and
    "gain_db" on pixels of those views that hit the scene, "steps", "voxels", "settings" and "seconds". A scene that cannot be fitted is
    returned as it is, with the reason under "skipped". The same seed gives the same bytes on the same processor.
    Raises SnergError when an image cannot be read, Cancelled when `progress` does.
    """
    if not len(scene.cells) or len(dataset.views) < 2:
        return scene, {"skipped": "there is no view to keep out" if len(scene.cells) else "the scene is empty"}
    if scene.square_roots:
        return scene, {"skipped": "the scene is thin fog, of which no single voxel tells in a picture"}
    began = time.perf_counter()
    training, validation = _recorded(scene, dataset, settings, within(progress, 0, MARCH_SHARE))
    if min(len(training), len(validation)) < MIN_PIXELS:
        return scene, {"skipped": "no training view sees the scene"}
    marched = time.perf_counter()
    fit = _Fit(scene, training, validation, settings, within(progress, MARCH_SHARE, 1))
    report = fit.run() | {
        "voxels": len(fit.voxels.rows),
        "settings": asdict(settings),
        "seconds": {"march": round(marched - began, 3), "fit": round(time.perf_counter() - marched, 3)},
    }
    cells = scene.cells.copy()
    cells.reshape(-1, cells.shape[-1])[fit.voxels.rows] = fit.best[0][: len(fit.voxels.rows)]
    for _ in fill_aprons(cells, scene.indirection):
        pass
    return replace(scene, cells=cells, network=fit.best[1], about={**scene.about, "fit": report}), report


def _recorded(scene: Scene, dataset: Dataset, settings: FitSettings, progress: Progress) -> tuple[RaySamples, RaySamples]:
    """The samples of the views that are fitted to, and of those that are kept out."""
    views = np.arange(len(dataset.views))
    kept_out = views % VALIDATION_EVERY == min(VALIDATION_EVERY, len(views)) // 2
    share = float(kept_out.mean())
    parts = []
    for some, begin, end in ((views[~kept_out], 0.0, 1 - share), (views[kept_out], 1 - share, 1.0)):
        most = VALIDATION_PIXELS if begin else settings.pixels
        pixels, shown = min(round(settings.pixels * len(some) / len(views)), most), within(progress, begin, end)
        parts.append(RaySamples.concatenate(list(sampled_views(scene, dataset, some, pixels, settings.seed, shown))))
    return parts[0], parts[1]


class _Fit:
    """A fit in progress. best: stored values [P, C] and the network of the least error so far on the views kept out."""

    def __init__(self, scene: Scene, training: RaySamples, validation: RaySamples, settings: FitSettings, progress: Progress) -> None:
        self.scene, self.training, self.validation, self.settings = scene, training, validation, settings
        self.voxels = Voxels.of(scene, training)
        network = None if scene.network is None else ViewNetwork(*(jnp.asarray(array) for array in scene.network))
        self.fitted = Fitted(jnp.asarray(self.voxels.straight(scene.unit)), network)
        self.progress, self.fraction, self.without_gain = progress, 0.0, 0
        self.best = self.voxels.stored, scene.network
        self.first = self.least = np.inf
        self.first = self.least = self.error(*self.best)

    def tell(self) -> None:
        """Report the progress, several times a second: it may raise Cancelled."""
        known = f": {psnr(self.least):.2f} dB, was {psnr(self.first):.2f}" if np.isfinite(self.first) else ""
        self.progress(self.fraction, f"Fitting voxels{known}")

    def run(self) -> dict[str, Any]:
        """Run all steps, or until nothing is gained any more. Returns the report's measurements."""
        settings, correct = self.settings, self.scene.opacity_correction
        moments = jax.tree.map(jnp.zeros_like, (self.fitted, self.fitted))
        near = Neighbourhoods(len(self.voxels.stored))
        in_pass = sum(1 for _ in batch_ends(self.training, np.arange(len(self.training)), settings.batch))
        steps = min(settings.passes * in_pass, -(-settings.rays * in_pass // len(self.training)))
        every, step = -(-steps // settings.evaluations), 0
        for step, batch in enumerate(self.batches(), 1):
            rows, corners = near(batch.corners)
            decay = settings.final_rate ** (step / steps)
            rates = decay * settings.rate, decay * settings.network_rate
            batch = batch._replace(corners=corners)
            self.fitted, moments = _step(self.fitted, moments, float(step), rates, rows, batch, settings.background, correct)
            self.fraction = min(step / steps, 1.0)
            self.tell()
            if step % every == 0 or step == steps:
                self.compare()
            if self.without_gain >= settings.patience or step == steps:
                break
        before, after = psnr(self.first), psnr(self.least)
        return {"psnr_before": before, "psnr_after": after, "gain_db": after - before, "steps": step}

    def batches(self) -> Iterator[Batch]:
        """The batches of all passes, each in another random order."""
        rng = np.random.default_rng(self.settings.seed)
        for _ in range(self.settings.passes):
            yield from batches(self.training, rng.permutation(len(self.training)), self.settings.batch, self.voxels)

    def compare(self) -> None:
        """Measure the values as they would be stored. Raises SnergError when their error is not finite."""
        stored = self.voxels.to_store(self.scene, premultiplied(np, np.asarray(self.fitted.voxels)), self.settings.seed)
        network = None if self.fitted.network is None else as_numpy(self.fitted.network)
        error = self.error(stored, network)
        if not np.isfinite(error):
            raise SnergError("Fitting the voxels went wrong: the error is not finite; bake without --fit and check the dataset's images.")
        self.without_gain = 0 if error < self.least * (1 - MIN_IMPROVEMENT) else self.without_gain + 1
        if error < self.least:
            self.least, self.best = error, (stored, network)

    def error(self, stored: NDArray[Any], network: ViewNetwork | None) -> float:
        """Mean squared error of stored values [P, C] and a network on the views kept out."""
        now, background, correct, total = jnp.asarray(stored), self.settings.background, self.scene.opacity_correction, 0.0
        for batch in batches(self.validation, np.arange(len(self.validation)), self.settings.batch, self.voxels):
            total += float(_stored_error(now, network, batch, background, self.scene.unit, correct))
            self.tell()
        return total / (3 * len(self.validation))


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


@partial(jax.jit, static_argnames=("background", "correct"), donate_argnums=(0, 1))
def _step(
    fitted: Fitted, moments: Any, step: Any, rates: Any, rows: Any, batch: Batch, background: tuple[float, ...], correct: bool
) -> Any:
    """One step of Adam on the squared error of a batch; returns the values and the moments. step: from 1. rates: of voxels and network.

    rows: see Neighbourhoods; `batch.corners` are places among them. Voxels that no ray of the batch needs keep their moments.
    """

    def loss(some: Fitted) -> Any:
        corners = premultiplied(jnp, some.voxels[batch.corners])
        return (pixel_errors(corners, some.network, batch, background, correct) ** 2).sum() / (3 * batch.used.sum())

    some, first, second = (whole._replace(voxels=whole.voxels[rows]) for whole in (fitted, *moments))
    gradient = jax.grad(loss)(some)
    unbias = jnp.sqrt(1 - BETA_2**step) / (1 - BETA_1**step)
    each = Fitted(rates[0], None if fitted.network is None else ViewNetwork(*[rates[1]] * len(ViewNetwork._fields)))

    def update(p: Any, g: Any, m: Any, v: Any, rate: Any) -> tuple[Any, Any, Any]:
        m2, v2 = BETA_1 * m + (1 - BETA_1) * g, BETA_2 * v + (1 - BETA_2) * g * g
        changes = jnp.abs(g) > UNTOUCHED
        moved = jnp.where(changes, p - rate * unbias * m2 / (jnp.sqrt(v2) + EPSILON), p)
        return moved, jnp.where(changes, m2, m), jnp.where(changes, v2, v)

    changed = jax.tree.map(update, some, gradient, first, second, each)
    parts = jax.tree.transpose(jax.tree.structure(some), jax.tree.structure((0, 0, 0)), changed)
    parts = (parts[0]._replace(voxels=jnp.clip(parts[0].voxels, 0, 1)), *parts[1:])
    wholes = (
        part._replace(voxels=whole.voxels.at[rows].set(part.voxels).at[-1].set(0))
        for part, whole in zip(parts, (fitted, *moments), strict=True)
    )
    fitted, first, second = wholes
    return fitted, (first, second)


@partial(jax.jit, static_argnames=("background", "unit", "correct"))
def _stored_error(stored: Any, network: ViewNetwork | None, batch: Batch, background: tuple[float, ...], unit: float, correct: bool) -> Any:
    """The sum of squared errors of a batch, of voxels as they are stored, [P, C]."""
    corners = stored[batch.corners].astype(jnp.float32) / unit
    return (pixel_errors(corners, network, batch, background, correct) ** 2).sum()
