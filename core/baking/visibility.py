"""Second pass of a bake: the voxels that some camera sees (section 5.3), found by marching the cameras' rays until little light is left.

The rays march a coarse scene of opacity alone, with voxels twice as large: an eighth of the memory and of the work. That is fine enough,
because the visible voxels are dilated by two voxels anyway. How many rays there are follows from the voxels (visibility_rays.py). The
transmittance of a coarse voxel is about the mean of its eight voxels, so voxels behind a thin sheet are seen rather than culled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.ndc import Ndc
from ..nerf.frame import Composited
from ..progress import Progress
from ..rendering.render import MarchSettings, march_rays
from ..scene.blocks import (
    BLOCKS_PER_CHUNK,
    CELL_VOXELS,
    DATA_VOXELS,
    block_coordinates,
    dilate,
    fill_aprons,
    number_blocks,
    pack_mask,
    unpack_mask,
)
from ..scene.scene import Scene
from ..scene.voxel_grid import VoxelGrid
from .occupied_voxels import OccupiedVoxels
from .resume import Arrays, ResumeCache, arrays_match
from .visibility_rays import ray_grid

HALF = DATA_VOXELS // 2  # coarse voxels along a block
STENCIL = 2  # voxels beyond the occupied ones that a stencil of the coarse scene reaches
HIT_TRANSMITTANCE = 0.99  # a ray with a lower transmittance has hit something


@dataclass(frozen=True)
class VisibilityStatistics:
    """Sums over the rays of all cameras."""

    hits: float = 0.0  # rays that hit something
    transmittance: float = 0.0  # sum of the transmittance of rays that hit something and left the scene
    samples: float = 0.0  # samples taken along all rays

    def with_rays(self, rays: Composited, stop: float) -> VisibilityStatistics:
        """The sums with more rays, which were marched until their transmittance fell to `stop`."""
        hit, passed = rays.transmittance < HIT_TRANSMITTANCE, rays.transmittance > stop
        transmittance = rays.transmittance[hit & passed].sum(dtype=np.float64)
        return VisibilityStatistics(self.hits + hit.sum(), self.transmittance + transmittance, self.samples + (rays.samples or 0))

    def to_json(self) -> dict[str, Any]:
        """{"rays": rays that hit something, "passes": their mean transmittance, "voxels": mean length sampled along a ray, in voxels}."""
        rays = max(self.hits, 1.0)
        return {"rays": round(self.hits), "passes": round(self.transmittance / rays, 4), "voxels": round(2 * self.samples / rays, 1)}


def visible_voxels(
    occupied: OccupiedVoxels,
    indirection: NDArray[Any],
    voxel_grid: VoxelGrid,
    ndc: Ndc | None,
    cameras: Sequence[Camera],
    threshold: float,
    cache: ResumeCache,
    progress: Progress,
) -> tuple[NDArray[Any], VisibilityStatistics]:
    """Voxels that a ray of some camera reaches with a transmittance of at least `threshold`, dilated by two voxels.

    indirection: int32 [bx, by, bz], the numbered blocks, which contain those of `occupied` and the neighbours that their voxels reach.
    Returns a mask uint32 [M, 30, 30] of these blocks (see scene/blocks.py), and statistics of the rays.
    """
    scene = coarse_opacity_scene(occupied, indirection, voxel_grid.halved(), ndc)
    blocks = np.argwhere(occupied.indirection >= 0)
    around = voxel_grid.box_of(blocks.min(axis=0) * DATA_VOXELS - STENCIL, (blocks.max(axis=0) + 1) * DATA_VOXELS + STENCIL)
    first, visited, statistics = _resume(cache, len(scene.cells) * CELL_VOXELS**3, len(cameras))
    settings = MarchSettings(stop_transmittance=threshold)
    for index in range(first, len(cameras)):
        camera, what = cameras[index], f"Visibility: camera {index + 1} of {len(cameras)}"

        def tell(fraction: float, _: str, index: int = index, what: str = what) -> None:
            progress((index + fraction) / len(cameras), what)

        for origins, directions in ray_grid(camera, around, scene.voxel_size, ndc).bands():
            near, far = camera.clip_distances(directions)
            rays = march_rays(scene, origins, directions, settings, tell, near, visited, far=far)
            statistics = statistics.with_rays(rays, threshold)
        tell(1.0, "")
        if cache.due or index + 1 == len(cameras):
            cache.add("visibility", index + 1, {"visited": np.packbits(visited), "light": np.array(astuple(statistics))})
            cache.flush()
    own = visited.reshape(-1, *(CELL_VOXELS,) * 3)[:, 1:-1, 1:-1, 1:-1]
    return refine_mask(dilate(pack_mask(own), scene.indirection), scene.indirection, indirection), statistics


def _resume(cache: ResumeCache, voxels: int, cameras: int) -> tuple[int, NDArray[Any], VisibilityStatistics]:
    """Cameras that are done already, the voxels that they visited, bool [voxels], and their statistics."""
    first, visited, statistics = 0, np.zeros(voxels, bool), VisibilityStatistics()
    expected = {"visited": ((-(-voxels // 8),), np.uint8), "light": ((3,), np.floating)}

    def is_valid(done: int, arrays: Arrays) -> bool:
        return first < done <= cameras and arrays_match(arrays, expected) and bool(np.isfinite(arrays["light"]).all())

    for done, arrays in cache.read("visibility"):
        if is_valid(done, arrays):
            first, statistics = done, VisibilityStatistics(*arrays["light"].tolist())
            visited = np.unpackbits(arrays["visited"])[:voxels].astype(bool)
    return first, visited, statistics


def coarse_opacity_scene(occupied: OccupiedVoxels, fine: NDArray[Any], voxel_grid: VoxelGrid, ndc: Ndc | None) -> Scene:
    """A scene of opacity alone on a grid of half the resolution, with cells for the numbered blocks of `fine`, int32 [bx, by, bz].

    Faint voxels are kept in it, so that fog adds up.
    """
    used = np.zeros(voxel_grid.blocks, bool)
    used[tuple((np.argwhere(fine >= 0) // 2).T)] = True
    indirection = number_blocks(used)
    coordinates = block_coordinates(occupied.indirection)
    cells = np.zeros((int(used.sum()), *(CELL_VOXELS,) * 3, 4), np.uint8)
    for octant, rows in octants(coordinates):
        part = tuple(slice(1 + HALF * o, 1 + HALF * (o + 1)) for o in octant)
        cells[(indirection[tuple((coordinates[rows] // 2).T)], *part, 3)] = occupied.coarse_opacity[rows]
    for _ in fill_aprons(cells, indirection):
        pass
    return Scene(voxel_grid.grid_to_world, voxel_grid.voxel_size, voxel_grid.shape, indirection, cells, None, ndc=ndc)


def refine_mask(mask: NDArray[Any], coarse: NDArray[Any], fine: NDArray[Any]) -> NDArray[Any]:
    """Refine a voxel mask: each coarse voxel of [Mc, 30, 30] becomes 2^3 voxels of half the edge length in [M, 30, 30].

    coarse, fine: int32 [bx, by, bz] indirection grids, which give the blocks of the two masks. The blocks of `fine` lie in those of
    `coarse`.
    """
    coordinates = block_coordinates(fine)
    result = np.zeros((len(coordinates), DATA_VOXELS, DATA_VOXELS), np.uint32)
    for octant, rows in octants(coordinates):
        part = tuple(slice(HALF * o, HALF * (o + 1)) for o in octant)
        for start in range(0, len(rows), BLOCKS_PER_CHUNK):
            chunk = rows[start : start + BLOCKS_PER_CHUNK]
            own = unpack_mask(mask[coarse[tuple((coordinates[chunk] // 2).T)]])[(slice(None), *part)]
            result[chunk] = pack_mask(own.repeat(2, axis=1).repeat(2, axis=2).repeat(2, axis=3))
    return result


def octants(coordinates: NDArray[Any]) -> list[tuple[tuple[int, ...], NDArray[Any]]]:
    """For each octant of a coarse block, (0 or 1 along each axis): the rows of those fine blocks [M, 3] that fill this octant of theirs."""
    return [(octant, np.flatnonzero((coordinates % 2 == octant).all(axis=-1))) for octant in product((0, 1), repeat=3)]
