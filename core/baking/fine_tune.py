"""Fine-tuning the view-dependence network on the baked, quantised scene (section 5.5), in JAX."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..io.images import over
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import ViewNetwork, as_numpy, view_residual
from ..progress import Progress, silent, within
from ..rendering.render import TILE, MarchSettings, march_rays
from ..scene.scene import Scene

VALIDATION_EVERY = 10  # every tenth view is judged by


@dataclass(frozen=True)
class RefineSettings:
    """pixels: gathered over all training views; four times as many gain 0.02 dB more and take three times as long. batch: a step.
    rate: of Adam, falling to a tenth by cosine (the paper's 3e-4 is for 100 epochs; here a larger one for fewer). epochs: at most.
    patience: epochs without a gain after which it stops. seed: of the pixels and their order. background: RGB in [0, 1] that the
    field was trained over: behind the images' alpha, and behind what lets light through.
    """

    pixels: int = 250_000
    batch: int = 8192
    rate: float = 2e-3
    epochs: int = 24
    patience: int = 4
    seed: int = 0
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class TrainingPixels:
    """Pixels of the training views as the baked scene composites them: what the network sees, and what it should add up to.

    colour: over white [N, 3]; features [N, 4]; directions [N, 3] in the network's axes; wanted: over white [N, 3]. held: how many of
    them, the first, are not fitted to but judged by: whole views, because a network may learn by heart what the others show.
    """

    colour: NDArray[Any]
    features: NDArray[Any]
    directions: NDArray[Any]
    wanted: NDArray[Any]
    held: int


def refine(
    scene: Scene,
    dataset: Dataset,
    settings: RefineSettings = RefineSettings(),
    progress: Progress = silent,
) -> tuple[Scene, dict[str, Any]]:
    """A scene with a network that makes up for what baking and quantising changed, and a report of the gain.

    A tenth of the views is kept out to judge by (of a few views, a tenth of the pixels); the best network on those is what comes back,
    the old one if none is better. A diffuse or empty scene comes back as it is. Raises SnergError when an image cannot be read, Cancelled
    when `progress` does.
    """
    if scene.network is None or not len(scene.cells):
        return scene, {"skipped": "the scene is diffuse" if len(scene.cells) else "the scene is empty"}
    began = time.perf_counter()
    gathered = march_training_views(scene, dataset, settings, within(progress, 0, 0.6))
    if len(gathered.colour) < 16:
        return scene, {"skipped": "no training view sees the scene"}
    marched = time.perf_counter()
    network, report = fit(scene.network, gathered, settings, within(progress, 0.6, 1))
    report |= {
        "settings": asdict(settings),
        "seconds": {"march": round(marched - began, 3), "fit": round(time.perf_counter() - marched, 3)},
    }
    return replace(scene, network=network, about={**scene.about, "refine": report}), report


def march_training_views(scene: Scene, dataset: Dataset, settings: RefineSettings, progress: Progress) -> TrainingPixels:
    """March a random share of every view's pixels, and keep those where the network runs and the view's mask does not hide them.

    The network is defined over white: another background adds to the image, over white, what white adds to the scene.
    """
    dark = 1 - np.array(settings.background, np.float32)
    rng = np.random.default_rng(settings.seed)
    share = min(1.0, 2 * settings.pixels / sum(c.width * c.height for c in dataset.cameras))
    parts = []
    for i, camera in enumerate(dataset.cameras):
        image, mask = dataset.read(i), dataset.mask(i)
        index = rng.choice(camera.width * camera.height, max(1, int(share * camera.width * camera.height)), replace=False)
        row, column = np.divmod(index, camera.width)
        # The marcher is quickest where rays that follow one another are close together.
        order = np.lexsort((column, row, column // TILE, row // TILE))
        row, column = row[order], column[order]
        origins, directions = camera.rays(np.stack([column, row], axis=-1))
        rays = march_rays(scene, origins, directions, MarchSettings(), near=max(scene.near, camera.near))
        used = rays.transmittance <= NETWORK_TRANSMITTANCE
        seen = np.flatnonzero(used if mask is None else used & mask[row, column])
        colour = rays.colour[seen] + rays.transmittance[seen, None]
        towards = (directions[seen] @ scene.view_rotation.T).astype(np.float32)
        pixels = image[row[seen], column[seen]]
        clear = 1 - pixels[:, 3:].astype(np.float32) / 255 if pixels.shape[-1] == 4 else np.float32(0)
        wanted = over(pixels) + dark * (rays.transmittance[seen, None] - clear)
        parts.append((colour, rays.features[seen], towards, wanted))
        progress((i + 1) / len(dataset.cameras), f"Marching training view {i + 1} of {len(dataset.cameras)}")
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = rng.permutation(len(columns[0]))[: settings.pixels]
    view = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])[order]
    aside = view % VALIDATION_EVERY == VALIDATION_EVERY // 2
    held = int(aside.sum()) if aside.any() else max(1, len(order) // VALIDATION_EVERY)
    order = order[np.argsort(~aside, kind="stable")]
    colour, features, towards, wanted = (column[order] for column in columns)
    return TrainingPixels(colour, features, towards, wanted, held)


def fit(network: ViewNetwork, data: TrainingPixels, settings: RefineSettings, progress: Progress) -> tuple[ViewNetwork, dict[str, Any]]:
    """Adam on the squared error of the final colour; the best network on the pixels held out, and what it gained in dB."""
    columns = data.colour, data.features, data.directions, data.wanted
    test = tuple(jnp.asarray(a[: data.held]) for a in columns)
    train = tuple(a[data.held :] for a in columns)
    batch = min(settings.batch, len(train[0]))
    steps = max(1, len(train[0]) // batch)
    total = steps * settings.epochs
    error = jax.jit(squared_error)
    step = jax.jit(partial(adam_step, settings.rate, total))
    params = ViewNetwork(*(jnp.asarray(a) for a in network))
    moments = jax.tree.map(jnp.zeros_like, (params, params))
    first = best = float(error(params, *test))
    kept, since, epoch = params, 0, 0
    rng = np.random.default_rng(settings.seed)
    for epoch in range(1, settings.epochs + 1):
        order = rng.permutation(len(train[0]))
        for i in range(steps):
            rows = order[i * batch : (i + 1) * batch]
            params, moments = step(params, moments, jnp.float32((epoch - 1) * steps + i), tuple(a[rows] for a in train))
        now = float(error(params, *test))
        if not np.isfinite(now):
            raise SnergError("Refining went wrong: the error is not finite; bake with --no-refine and check the dataset's images.")
        since = 0 if now < best * 0.9995 else since + 1
        if now < best:
            best, kept = now, params
        progress(epoch / settings.epochs, f"Refining: {psnr(now):.2f} dB, was {psnr(first):.2f}")
        if since >= settings.patience:
            break
    report = {"psnr_before": psnr(first), "psnr_after": psnr(best), "gain_db": psnr(best) - psnr(first), "epochs": epoch}
    return as_numpy(kept), report


def psnr(error: float) -> float:
    """PSNR of a mean squared error, at most 100."""
    return -10 * float(np.log10(max(error, 1e-10)))


def squared_error(network: ViewNetwork, colour: Any, features: Any, directions: Any, wanted: Any) -> Any:
    """Mean over pixels and channels."""
    return ((colour + view_residual(jnp, network, colour, features, directions) - wanted) ** 2).mean()


def adam_step(rate: float, total: int, params: Any, moments: Any, step: Any, data: tuple[Any, ...]) -> tuple[Any, Any]:
    """One step of Adam at a rate that falls by cosine to a tenth. An input that the network never had a weight for stays without: the
    frequencies of the direction that training left out (TrainSettings.view_degrees)."""
    gradient = jax.grad(squared_error)(params, *data)
    gradient = gradient._replace(weights_0=gradient.weights_0 * (params.weights_0 != 0).any(axis=1, keepdims=True))
    now = rate * (0.1 + 0.9 * 0.5 * (1 + jnp.cos(jnp.pi * step / total)))
    m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, moments[0], gradient)
    v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, moments[1], gradient)
    unbias = jnp.sqrt(1 - 0.999 ** (step + 1)) / (1 - 0.9 ** (step + 1))
    return jax.tree.map(lambda p, m, v: p - now * unbias * m / (jnp.sqrt(v) + 1e-8), params, m, v), (m, v)
