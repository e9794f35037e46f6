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
from .losses import over, shown_over
from .ray_dataset import RayDataset

HELD_OUT_RAYS = 4096  # enough for 0.1 dB, and little next to a second of training
HELD_OUT_VIEWS = 8  # that they are spread over, so that few images are read

Evaluate = Callable[[NDArray[Any]], Sequence[NDArray[Any]]]


class ValidationRays:
    """Rays of a dataset, drawn once with the settings' seed, and their true colours over the background that the field is trained over."""

    def __init__(self, pool: RayDataset, views: NDArray[Any] | None, count: int, settings: TrainSettings) -> None:
        """views: [views] bool, those to draw from; all when None."""
        rng = np.random.default_rng(settings.seed)
        held, pool.withheld = pool.withheld, np.zeros(len(pool.ends), bool) if views is None else ~views
        index = pool.draw(count, rng)
        pool.withheld = held
        self.origins, self.directions, self.near, self.far, self.looking = pool.rays(index)
        self.offset = rng.random(count)
        self.background = np.broadcast_to(shown_over(settings.background), (count, 3))
        self.wanted, _ = over(pool.pixels[index].astype(np.float32) / 255, self.background)

    def errors(self, colour: NDArray[Any]) -> NDArray[Any]:
        """Squared error [R] of colours [R, 3], the mean of the channels."""
        return np.asarray(((colour - self.wanted) ** 2).mean(axis=-1))


def packed_colours(
    settings: TrainSettings, domain: Domain, occupied: NDArray[Any], spacing: float, evaluate: Evaluate, params: Any, rays: ValidationRays
) -> NDArray[Any]:
    """Colours [R, 3] of rays over their background, from packed samples.

    evaluate: points [N, 3] to (density [N], values [N, C]) by the field of params, as they are trained.
    """
    got = pack_samples(domain, occupied, rays.origins, rays.directions, spacing, rays.offset, rays.near)
    density, values = evaluate(got.points)
    wanted = ("view", "field") if settings.view_dependence == "sample" else ("view",)
    host = {name: _host(params[name]) for name in wanted if name in params}
    looking = rays.looking.astype(np.float32)
    values = sample_values(np, settings.view_dependence, settings.family, host, values, looking[got.ray])
    gathered, through, _ = composite(np, optical_depth(np, density, np.float32(got.length)), values, got.ray, len(looking))
    return np.asarray(ray_colour(np, settings.view_dependence, host, gathered, through, looking, rays.background))


def _host(tree: Any) -> Any:
    """NumPy copies of JAX arrays in tuples and dicts."""
    if isinstance(tree, dict):
        return {name: _host(value) for name, value in tree.items()}
    if isinstance(tree, tuple):
        parts = [_host(value) for value in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return np.asarray(tree)


def some_views(dataset: Dataset, most: int = HELD_OUT_VIEWS) -> Dataset:
    """At most so many of its views, spread evenly."""
    chosen = np.unique(np.linspace(0, len(dataset.views) - 1, most).round().astype(int))
    return replace(dataset, views=tuple(dataset.views[i] for i in chosen), bounds=None)
