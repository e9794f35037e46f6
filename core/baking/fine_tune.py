"""Fine-tunes the view-dependence network on the baked, quantised scene (section 5.5). Uses JAX."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..io.images import over
from ..io.settings import check_colour, check_number, check_whole
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import ViewNetwork, as_numpy, view_residual
from ..progress import Progress, silent, within
from ..rendering.render import TILE, MarchSettings, march_rays
from ..scene.scene import Scene

VALIDATION_EVERY = 10  # one view of so many is kept out for validation
MIN_PIXELS = 16  # fewer cannot be fitted to
MIN_IMPROVEMENT = 0.0005  # share by which an epoch must reduce the validation error to count as a gain
MARCH_SHARE = 0.6  # of the progress that marching the training views gets
FINAL_RATE = 0.1  # learning rate at the end, as a share of that at the start


@dataclass(frozen=True)
class RefineSettings:
    """How the network is fine-tuned. Raises SnergError for values out of range."""

    pixels: int = 250_000  # of all training views; four times as many gain 0.02 dB more and take three times as long
    batch: int = 8192  # pixels a step
    rate: float = 2e-3  # of Adam at the start, with cosine decay; the paper has 3e-4 for 100 epochs, fewer epochs want a larger one
    epochs: int = 24  # at most
    patience: int = 4  # epochs without a gain after which it stops
    seed: int = 0  # of the choice of pixels and their order
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)  # RGB in [0, 1] over which the field was trained

    def __post_init__(self) -> None:
        for name in ("pixels", "batch"):
            check_whole(f"The number of fine-tuning's {name}", getattr(self, name), 1, 2**40)
        check_number("The learning rate of fine-tuning", self.rate, 1e-12, 1e3)
        check_whole("The number of fine-tuning's epochs", self.epochs, 0, 2**31)
        check_whole("The patience of fine-tuning", self.patience, 1, 2**31)
        check_whole("The seed of fine-tuning", self.seed, 0, 2**63 - 1)
        check_colour("The background of fine-tuning", self.background)


@dataclass(frozen=True, eq=False)
class TrainingPixels:
    """Pixels of the training views: the network's inputs, as the baked scene gives them, and the colour that should come out.

    The first `validation` pixels are kept out of fitting and measure it. They are those of whole views where possible, because a network
    may overfit to what other views show.
    """

    colour: NDArray[Any]  # [N, 3] composited colour over white
    features: NDArray[Any]  # [N, 4] composited features
    view_directions: NDArray[Any]  # [N, 3] unit, in the network's axes
    target: NDArray[Any]  # [N, 3] the image's colour over white
    validation: int


def refine(
    scene: Scene,
    dataset: Dataset,
    settings: RefineSettings = RefineSettings(),
    progress: Progress = silent,
) -> tuple[Scene, dict[str, Any]]:
    """Fine-tune a scene's network to make up for the changes of baking and quantisation.

    Returns the scene with the network that is best on the validation pixels (the old one if none is better), and a report: "psnr_before",
    "psnr_after", "gain_db" on those pixels, "epochs", "settings" and "seconds". A diffuse or empty scene is returned as it is, with the
    reason under "skipped". Raises SnergError when an image cannot be read, Cancelled when `progress` does.
    """
    if scene.network is None or not len(scene.cells):
        return scene, {"skipped": "the scene is diffuse" if len(scene.cells) else "the scene is empty"}
    began = time.perf_counter()
    pixels = march_training_views(scene, dataset, settings, within(progress, 0, MARCH_SHARE))
    if len(pixels.colour) < MIN_PIXELS:
        return scene, {"skipped": "no training view sees the scene"}
    marched = time.perf_counter()
    network, report = fit(scene.network, pixels, settings, within(progress, MARCH_SHARE, 1))
    report |= {
        "settings": asdict(settings),
        "seconds": {"march": round(marched - began, 3), "fit": round(time.perf_counter() - marched, 3)},
    }
    return replace(scene, network=network, about={**scene.about, "refine": report}), report


def march_training_views(scene: Scene, dataset: Dataset, settings: RefineSettings, progress: Progress) -> TrainingPixels:
    """March random pixels of every view, and keep those where the network runs and that the view's mask does not hide."""
    rng = np.random.default_rng(settings.seed)
    share = min(1.0, 2 * settings.pixels / sum(c.width * c.height for c in dataset.cameras))
    views = []
    for view, camera in enumerate(dataset.cameras):
        index = rng.choice(camera.width * camera.height, max(1, int(share * camera.width * camera.height)), replace=False)
        views.append(_march_view(scene, dataset, view, index, settings.background))
        progress((view + 1) / len(dataset.cameras), f"Marching training view {view + 1} of {len(dataset.cameras)}")
    columns = [np.concatenate(column) for column in zip(*views, strict=True)]
    order = rng.permutation(len(columns[0]))[: settings.pixels]
    view_of = np.repeat(np.arange(len(views)), [len(columns[0]) for columns in views])[order]
    kept_out = view_of % VALIDATION_EVERY == VALIDATION_EVERY // 2
    validation = int(kept_out.sum()) if kept_out.any() else max(1, len(order) // VALIDATION_EVERY)
    order = order[np.argsort(~kept_out, kind="stable")]
    colour, features, view_directions, target = (column[order] for column in columns)
    return TrainingPixels(colour, features, view_directions, target, validation)


def _march_view(
    scene: Scene, dataset: Dataset, view: int, index: NDArray[Any], background: tuple[float, float, float]
) -> tuple[NDArray[Any], ...]:
    """Colour, features, view directions and targets (see TrainingPixels) of pixels [n] of a view that are used.

    The network is defined over white. Over another background the target is the image plus what white would add to it:
    (1 - background) times the scene's transmittance; an image with alpha is put over white itself.
    """
    camera, image, mask = dataset.cameras[view], dataset.read(view), dataset.mask(view)
    row, column = np.divmod(index, camera.width)
    order = np.lexsort((column, row, column // TILE, row // TILE))  # tile by tile: the marcher is fastest on coherent rays
    row, column = row[order], column[order]
    origins, directions = camera.rays(np.stack([column, row], axis=-1))
    near, far = camera.clip_distances(directions)
    rays = march_rays(scene, origins, directions, MarchSettings(), near=np.maximum(scene.near, near), far=far)
    used = rays.transmittance <= NETWORK_TRANSMITTANCE
    rows = np.flatnonzero(used if mask is None else used & mask[row, column])
    transmittance = rays.transmittance[rows, None]
    pixels = image[row[rows], column[rows]]
    clear = 1 - pixels[:, 3:].astype(np.float32) / 255 if pixels.shape[-1] == 4 else np.float32(0)
    target = over(pixels) + (1 - np.array(background, np.float32)) * (transmittance - clear)
    view_directions = (directions[rows] @ scene.view_rotation.T).astype(np.float32)
    return rays.colour[rows] + transmittance, rays.features[rows], view_directions, target


def fit(network: ViewNetwork, pixels: TrainingPixels, settings: RefineSettings, progress: Progress) -> tuple[ViewNetwork, dict[str, Any]]:
    """Fit the network to the pixels' targets: Adam on the squared error, with early stopping.

    Returns the network that is best on the validation pixels, and "psnr_before", "psnr_after", "gain_db" on them and "epochs".
    """
    columns = pixels.colour, pixels.features, pixels.view_directions, pixels.target
    validation = tuple(jnp.asarray(column[: pixels.validation]) for column in columns)
    training = tuple(column[pixels.validation :] for column in columns)
    error = jax.jit(squared_error)
    params = ViewNetwork(*(jnp.asarray(array) for array in network))
    first = best = float(error(params, *validation))
    best_params, without_gain, epoch = params, 0, 0
    run_epoch = _epochs(params, training, settings)
    for epoch in range(1, settings.epochs + 1):
        params = run_epoch()
        now = float(error(params, *validation))
        if not np.isfinite(now):
            raise SnergError("Refining went wrong: the error is not finite; bake with --no-refine and check the dataset's images.")
        without_gain = 0 if now < best * (1 - MIN_IMPROVEMENT) else without_gain + 1
        if now < best:
            best, best_params = now, params
        progress(epoch / settings.epochs, f"Refining: {psnr(now):.2f} dB, was {psnr(first):.2f}")
        if without_gain >= settings.patience:
            break
    report = {"psnr_before": psnr(first), "psnr_after": psnr(best), "gain_db": psnr(best) - psnr(first), "epochs": epoch}
    return as_numpy(best_params), report


def _epochs(params: ViewNetwork, training: tuple[NDArray[Any], ...], settings: RefineSettings) -> Callable[[], ViewNetwork]:
    """A function that runs one more epoch over the training pixels, in random order, and returns the parameters."""
    batch = min(settings.batch, len(training[0]))
    steps = max(1, len(training[0]) // batch)
    adam = optax.adam(optax.cosine_decay_schedule(settings.rate, steps * settings.epochs, FINAL_RATE))
    step, state, rng = jax.jit(partial(adam_step, adam)), adam.init(params), np.random.default_rng(settings.seed)

    def run_epoch() -> ViewNetwork:
        nonlocal params, state
        order = rng.permutation(len(training[0]))
        for i in range(steps):
            rows = order[i * batch : (i + 1) * batch]
            params, state = step(params, state, tuple(column[rows] for column in training))
        return params

    return run_epoch


def psnr(error: float) -> float:
    """Peak signal-to-noise ratio, dB, of a mean squared error of values in [0, 1]; at most 100."""
    return -10 * float(np.log10(max(error, 1e-10)))


def squared_error(network: ViewNetwork, colour: Any, features: Any, view_directions: Any, target: Any) -> Any:
    """Mean squared error, over pixels and channels, of composited colour plus residual (eq. 7). See TrainingPixels for the arguments."""
    return ((colour + view_residual(jnp, network, colour, features, view_directions) - target) ** 2).mean()


def adam_step(adam: optax.GradientTransformation, params: ViewNetwork, state: Any, data: tuple[Any, ...]) -> tuple[ViewNetwork, Any]:
    """One step of the optimiser on the squared error of some pixels; returns the parameters and the optimiser's state.

    Rows of the first layer that are all 0 stay 0: frequencies of the view direction that training left out (TrainSettings.view_degrees).
    """
    gradient = jax.grad(squared_error)(params, *data)
    gradient = gradient._replace(weights_0=gradient.weights_0 * (params.weights_0 != 0).any(axis=1, keepdims=True))
    updates, state = adam.update(gradient, state)
    updated: ViewNetwork = optax.apply_updates(params, updates)
    return updated, state
