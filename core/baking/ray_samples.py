"""The samples that pixels of the training views take of a baked scene, for fitting its voxels and for pruning them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..progress import Progress, within
from ..rendering.acceleration import STRIDES
from ..rendering.render import TILE, MarchSettings, march_rays
from ..scene.scene import Scene

CORNERS = np.array([x * STRIDES[0] + y * STRIDES[1] + z for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)
STOP_TRANSMITTANCE = 0.01  # rays end here: what lies behind has hardly a gradient, and takes a third of the samples
MAX_RAY_SAMPLES = 32  # of a ray, the first; more are left out, which lie behind fog
FRACTION_STEPS = 256  # a sample's position in its stencil is stored in so many steps along each axis


@dataclass(frozen=True, eq=False)
class RaySamples:
    """R rays and their S samples, ordered by ray and from front to back.

    first: int64 [R + 1], of each ray its first sample, then S. base: int32 [S], index of the stencil's lowest corner among the atlas's
    voxels, [M * 32^3]. fraction: uint8 [S, 3], position in the stencil in steps of 1 / FRACTION_STEPS. view_directions: float32 [R, 3],
    unit, in the network's axes. pixels: uint8 [R, 4], sRGB with straight alpha. view: int32 [R], number of the ray's view.
    """

    first: NDArray[Any]
    base: NDArray[Any]
    fraction: NDArray[Any]
    view_directions: NDArray[Any]
    pixels: NDArray[Any]
    view: NDArray[Any]

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rays: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """The samples of rays [n]: their rows [k], the position in `rays` of each sample's ray [k], and its number on that ray [k]."""
        lengths = self.first[rays + 1] - self.first[rays]
        ray = np.repeat(np.arange(len(rays), dtype=np.int32), lengths)
        slot = np.arange(len(ray)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        return self.first[rays][ray] + slot, ray, slot.astype(np.int32)


def record_samples(scene: Scene, dataset: Dataset, views: NDArray[Any], pixels: int, seed: int, progress: Progress) -> RaySamples:
    """The samples of about `pixels` random pixels of some views; pixels that the view's mask hides, and that hit nothing, are left out."""
    rng = np.random.default_rng(seed)
    total = sum(dataset.cameras[view].width * dataset.cameras[view].height for view in views)
    parts = []
    for number, view in enumerate(views.tolist()):
        camera = dataset.cameras[view]
        count = camera.width * camera.height
        index = rng.choice(count, max(1, min(count, round(pixels * count / max(total, 1)))), replace=False)
        shown = within(progress, number / len(views), (number + 1) / len(views))
        parts.append(_record_view(scene, dataset, view, index, lambda f, _, shown=shown, n=number: shown(f, f"Marching view {n + 1}")))
    lengths = np.concatenate([np.zeros(1, np.int64), *(part[0] for part in parts)])
    columns = [np.concatenate([part[i] for part in parts]) for i in range(1, 6)]
    return RaySamples(np.cumsum(lengths), *columns)


def _record_view(scene: Scene, dataset: Dataset, view: int, index: NDArray[Any], progress: Progress) -> tuple[NDArray[Any], ...]:
    """Of pixels [n] of a view that hit something: the number of samples of each, then the other columns of RaySamples."""
    camera, image, mask = dataset.cameras[view], dataset.read(view), dataset.mask(view)
    row, column = np.divmod(index, camera.width)
    used = np.ones(len(row), bool) if mask is None else mask[row, column]
    row, column = row[used], column[used]
    order = np.lexsort((column, row, column // TILE, row // TILE))  # tile by tile: the marcher is fastest on coherent rays
    row, column = row[order], column[order]
    origins, directions = camera.rays(np.stack([column, row], axis=-1))
    passes: list[tuple[NDArray[Any], ...]] = []
    settings = MarchSettings(stop_transmittance=STOP_TRANSMITTANCE)
    near = max(scene.near, camera.near)
    march_rays(scene, origins, directions, settings, progress, near, record=lambda *samples: passes.append(samples))
    ray, t, base, fraction = _joined(passes)
    order = np.lexsort((t, ray))
    ray = ray[order]
    starts = np.flatnonzero(np.diff(ray, prepend=-1))
    slot = np.arange(len(ray)) - np.repeat(starts, np.diff(np.append(starts, len(ray))))
    order, ray = order[slot < MAX_RAY_SAMPLES], ray[slot < MAX_RAY_SAMPLES]
    rays, lengths = np.unique(ray, return_counts=True)
    pixels = image[row[rays], column[rays]]
    if pixels.shape[-1] == 3:
        pixels = np.concatenate([pixels, np.full((len(pixels), 1), 255, np.uint8)], axis=-1)
    position = np.minimum(fraction[:, order].T * FRACTION_STEPS, FRACTION_STEPS - 1).astype(np.uint8)
    towards = (directions[rays] @ scene.view_rotation.T).astype(np.float32)
    return lengths, base[order].astype(np.int32), position, towards, pixels, np.full(len(rays), view, np.int32)


def _joined(passes: list[tuple[NDArray[Any], ...]]) -> Iterator[NDArray[Any]]:
    """The four columns of all passes."""
    if not passes:
        passes = [(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.int64), np.zeros((3, 0), np.float32))]
    return (np.concatenate(column, axis=-1) for column in zip(*passes, strict=True))
