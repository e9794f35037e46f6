"""Validation while training: the error of a fixed set of rays of views that are not trained on.

Packed samples are composited by volume rendering (NeRF, eq. 3; Max 1995).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..nerf.sampling import Domain, pack_samples
from ..nerf.shading import ray_colour, sample_values
from ..nerf.volume_rendering import composite, optical_depth
from .config import TrainSettings
from .losses import mse_to_psnr, over, shown_over
from .ray_dataset import RayDataset

HELD_OUT_RAYS = 4096  # validation rays: their PSNR is accurate to 0.1 dB, and rendering them takes much less than a second of training
HELD_OUT_VIEWS = 8  # views from which they are drawn; each view's image must be read

Evaluate = Callable[[NDArray[Any]], Sequence[NDArray[Any]]]


class ValidationRays:
    """A fixed set of R rays of a dataset, drawn with the settings' seed, and their true colours `wanted` [R, 3] over `background` [R, 3].

    origins, directions [R, 3] and near, far [R] are in field coordinates; view_directions: [R, 3] unit, world axes; offset: [R], see
    `pack_samples`; view: [R] their views. The background is that of `losses.shown_over`.
    """

    def __init__(self, ray_dataset: RayDataset, views: NDArray[Any] | None, count: int, settings: TrainSettings) -> None:
        """Draw `count` rays. views: bool [views], the views to draw from; None for all."""
        rng = np.random.default_rng(settings.seed)
        held, ray_dataset.withheld = ray_dataset.withheld, np.zeros(len(ray_dataset.ends), bool) if views is None else ~views
        index = ray_dataset.draw(count, rng)
        ray_dataset.withheld = held
        self.origins, self.directions, self.near, self.far, self.view_directions = ray_dataset.rays(index)
        self.offset = rng.random(count)
        self.view = ray_dataset.view(index)
        self.background = np.broadcast_to(shown_over(settings.background), (count, 3))
        self.wanted, _ = over(ray_dataset.pixels[index].astype(np.float32) / 255, self.background)

    def errors(self, colour: NDArray[Any]) -> NDArray[Any]:
        """Squared error [R] of colours [R, 3], the mean of the channels."""
        return np.asarray(((colour - self.wanted) ** 2).mean(axis=-1))


def mean_psnr_of(errors: NDArray[Any], view: NDArray[Any]) -> float:
    """The mean over views of the PSNR in dB of their rays, as evaluation has it.

    errors: [R] squared errors of rays; view: [R] their views.
    """
    _, group = np.unique(view, return_inverse=True)
    return float(np.mean([mse_to_psnr(error) for error in np.bincount(group, errors) / np.bincount(group)]))


def packed_colours(
    settings: TrainSettings, domain: Domain, occupied: NDArray[Any], spacing: float, evaluate: Evaluate, params: Any, rays: ValidationRays
) -> NDArray[Any]:
    """Colours [R, 3] of rays over their background, from packed samples.

    occupied: bool [CELLS^3]; spacing: of the samples, field coordinates. evaluate: maps points [N, 3] to (density [N], values [N, C])
    with the field's present parameters.
    """
    got = pack_samples(domain, occupied, rays.origins, rays.directions, spacing, rays.offset, rays.near, rays.far)
    density, values = evaluate(got.points)
    wanted = ("view", "field") if settings.view_dependence == "sample" else ("view",)
    host = {name: _host(params[name]) for name in wanted if name in params}
    view_directions = rays.view_directions.astype(np.float32)
    values = sample_values(np, settings.view_dependence, settings.family, host, values, view_directions[got.ray])
    gathered, transmittance, _ = composite(np, optical_depth(np, density, np.float32(got.length)), values, got.ray, len(view_directions))
    return np.asarray(ray_colour(np, settings.view_dependence, host, gathered, transmittance, view_directions, rays.background))


def _host(tree: Any) -> Any:
    """NumPy copies of JAX arrays in tuples and dicts."""
    if isinstance(tree, dict):
        return {name: _host(value) for name, value in tree.items()}
    if isinstance(tree, tuple):
        parts = [_host(value) for value in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return np.asarray(tree)


def some_views(dataset: Dataset, most: int = HELD_OUT_VIEWS) -> Dataset:
    """The dataset reduced to at most `most` of its views, evenly spaced."""
    chosen = np.unique(np.linspace(0, len(dataset.views) - 1, most).round().astype(int))
    return replace(dataset, views=tuple(dataset.views[i] for i in chosen), bounds=None)
