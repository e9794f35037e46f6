"""The samples that pixels of the training views take of a baked scene: its voxels are fitted and pruned by them. NumPy alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..progress import Progress, within
from ..rendering.interpolator import CORNER_OFFSETS
from ..rendering.render import TILE, MarchSettings, march_rays
from ..scene.blocks import CELL_VOXELS, fill_aprons
from ..scene.scene import Scene

# Of a fit; here, because the cost model needs them without JAX. Pixels of all training views, of which those that hit the scene are fitted
# to (it bounds the memory), and how many rays are fitted to in all: other pixels gain more than the same ones again.
FIT_PIXELS, FIT_RAYS, FIT_PASSES = 8_000_000, 2_500_000, 2
STOP_TRANSMITTANCE = 0.01  # rays end here: what lies behind has hardly a gradient, and takes a third of the samples
MAX_SAMPLES = 2**25  # of all views, 11 to 15 bytes each; where there would be more, rays are left out
MAX_RAY_SAMPLES = 256  # of a ray; rays with more, through fog, are left out: without its last samples a ray has another colour
FRACTION_STEPS = 256  # a sample's position in its stencil is stored in so many steps along each axis
T_BITS = 18  # of a sample's distance in voxels: a grid has at most 2^17 along an axis
NO_VOXEL = -1  # in `own_voxels`


@dataclass(frozen=True, eq=False)
class RaySamples:
    """R rays and their S samples, ordered by ray and from front to back.

    first: int64 [R + 1], of each ray its first sample, then S. base: int32 or int64 [S], index of the stencil's lowest corner among the
    voxels of the atlas, [M * 32^3]. fraction: uint8 [S, 3], position in the stencil in steps of 1 / FRACTION_STEPS. view_directions:
    float32 [R, 3], unit, in the network's axes. pixels: uint8 [R, 4], sRGB with straight alpha.
    """

    first: NDArray[Any]
    base: NDArray[Any]
    fraction: NDArray[Any]
    view_directions: NDArray[Any]
    pixels: NDArray[Any]

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def concatenate(cls, parts: list[RaySamples]) -> RaySamples:
        """The rays of all parts (at least one), in order."""
        lengths = np.concatenate([np.diff(part.first) for part in parts])
        first = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
        rest = ("base", "fraction", "view_directions", "pixels")
        return cls(first, *(np.concatenate([getattr(part, name) for part in parts]) for name in rest))

    def thinned(self, limit: int) -> RaySamples:
        """Every n-th ray, so many that there are about `limit` samples at most; itself where there are no more."""
        step = -(-int(self.first[-1]) // max(limit, 1))
        if step < 2:
            return self
        rays = np.arange(0, len(self), step)
        rows, _, _ = self.rows(rays)
        first = np.concatenate([np.zeros(1, np.int64), np.cumsum(np.diff(self.first)[rays])])
        return RaySamples(first, self.base[rows], self.fraction[rows], self.view_directions[rays], self.pixels[rays])

    def rows(self, rays: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """The samples of rays [n]: their rows [k], the position in `rays` of each sample's ray [k], and its number on that ray [k]."""
        lengths = self.first[rays + 1] - self.first[rays]
        ray = np.repeat(np.arange(len(rays)), lengths)
        slot = np.arange(len(ray)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        return self.first[rays][ray] + slot, ray, slot


def sampled_views(scene: Scene, dataset: Dataset, views: NDArray[Any], pixels: int, seed: int, progress: Progress) -> Iterator[RaySamples]:
    """For each of some views, the samples of its share of `pixels` random pixels.

    views: their numbers [V]. Pixels that a mask hides are left out, and those that hit nothing. Raises SnergError when an image cannot be
    read.
    """
    rng = np.random.default_rng(seed)
    cameras = [dataset.cameras[view] for view in views.tolist()]
    share = min(1.0, pixels / max(sum(camera.width * camera.height for camera in cameras), 1))
    for number, (view, camera) in enumerate(zip(views.tolist(), cameras, strict=True)):
        count = camera.width * camera.height
        index = rng.choice(count, max(1, round(share * count)), replace=False)
        shown, text = within(progress, number / len(views), (number + 1) / len(views)), f"Marching view {number + 1} of {len(views)}"

        def tell(fraction: float, _: str, shown: Progress = shown, text: str = text) -> None:
            shown(fraction, text)

        yield _view_samples(scene, dataset, view, index, tell).thinned(MAX_SAMPLES // len(views))


def _view_samples(scene: Scene, dataset: Dataset, view: int, index: NDArray[Any], progress: Progress) -> RaySamples:
    """The samples of pixels [n] of a view."""
    camera, image, mask = dataset.cameras[view], dataset.read(view), dataset.mask(view)
    row, column = np.divmod(index, camera.width)
    used = np.ones(len(row), bool) if mask is None else mask[row, column]
    row, column = row[used], column[used]
    order = np.lexsort((column, row, column // TILE, row // TILE))  # tile by tile: the marcher is fastest on coherent rays
    row, column = row[order], column[order]
    origins, directions = camera.rays(np.stack([column, row], axis=-1))
    passes: list[tuple[NDArray[Any], ...]] = [_NO_SAMPLES]
    settings = MarchSettings(stop_transmittance=STOP_TRANSMITTANCE)
    near, far = camera.clip_distances(directions)
    near = np.maximum(scene.near, near)
    march_rays(scene, origins, directions, settings, progress, near, record=lambda *samples: passes.append(samples), far=far)
    ray, t, base, fraction = (np.concatenate(column, axis=-1) for column in zip(*passes, strict=True))
    order = np.argsort((ray << T_BITS) + t.astype(np.int64))  # t is a whole number and a half, below the grid's diagonal
    ray = ray[order]
    first = np.flatnonzero(np.diff(ray, prepend=-1))
    rays, lengths = ray[first], np.diff(first, append=len(ray))
    short = lengths <= MAX_RAY_SAMPLES
    order, rays, lengths = order[np.repeat(short, lengths)], rays[short], lengths[short]
    pixels = image[row[rays], column[rays]]
    if pixels.shape[-1] == 3:
        pixels = np.concatenate([pixels, np.full((len(pixels), 1), 255, np.uint8)], axis=-1)
    return RaySamples(
        first=np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)]),
        base=base[order].astype(_index_type(scene)),
        fraction=np.minimum(fraction[:, order].T * FRACTION_STEPS, FRACTION_STEPS - 1).astype(np.uint8),
        view_directions=(directions[rays] @ scene.view_rotation.T).astype(np.float32),
        pixels=pixels,
    )


def _index_type(scene: Scene) -> Any:
    """The integers that number the voxels of the atlas."""
    return np.int32 if len(scene.cells) * CELL_VOXELS**3 < 2**31 else np.int64


_NO_SAMPLES = np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.int64), np.zeros((3, 0), np.float32)


def stencil_weights(xnp: Any, fraction: Any) -> Any:
    """Trilinear weights [S, 8] float32 of the corners of stencils, in the order of CORNER_OFFSETS. fraction: see RaySamples."""
    high = (fraction.astype(xnp.float32) + 0.5) / FRACTION_STEPS
    x, y, z = (xnp.stack([1 - high[:, axis], high[:, axis]], axis=-1) for axis in range(3))
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, 8)


def own_voxels(scene: Scene) -> NDArray[Any]:
    """For each voxel of the atlas, int32 or int64 [M * 32^3], the block's own voxel of which it is a copy, or itself.

    NO_VOXEL in an apron towards a block without a cell.
    """
    own = np.full((len(scene.cells), *(CELL_VOXELS,) * 3), NO_VOXEL, _index_type(scene))
    inside = (slice(None), *(slice(1, -1),) * 3)
    own[inside] = np.arange(own.size).reshape(own.shape)[inside]
    for _ in fill_aprons(own, scene.indirection):
        pass
    return own.reshape(-1)


def corners_of(base: Any) -> Any:
    """Indices [S, 8] of a stencil's corners among the voxels of the atlas, from those of its lowest [S]."""
    return base[:, None] + CORNER_OFFSETS
