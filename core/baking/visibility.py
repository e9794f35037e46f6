"""Which voxels a camera ever sees (section 5.3): the skipping marcher, stopped where little light is left.

It marches voxels of two on a side: an eighth of the work and of the memory, and still finer than the two voxels by which what
is seen is widened. A coarse voxel stops as much light as its eight do on average, so that what lies behind a thin sheet is rather
seen than not.
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
from ..rendering.render import MarchSettings, march_rays, tiled_pixels
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
from .resume import ResumeCache, arrays_match

HALF = DATA_VOXELS // 2
HIT_TRANSMITTANCE = 0.99  # a ray that keeps less of its light has met something


@dataclass(frozen=True)
class VisibilityStatistics:
    """What became of the light of the cameras' rays. met: rays that met something; left: the sum of what passes that; samples: that all
    rays took."""

    met: float = 0.0
    left: float = 0.0
    samples: float = 0.0

    def and_of(self, rays: Composited, stop: float) -> VisibilityStatistics:
        """With more rays, which ended where less light than `stop` was left."""
        met, passes = rays.transmittance < HIT_TRANSMITTANCE, rays.transmittance > stop
        left = rays.transmittance[met & passes].sum(dtype=np.float64)
        return VisibilityStatistics(self.met + met.sum(), self.left + left, self.samples + (rays.samples or 0))

    def to_json(self) -> dict[str, Any]:
        """{"rays": that met something, "passes": the share of their light that passes it, "voxels": taken samples along, a ray, about}."""
        rays = max(self.met, 1.0)
        return {"rays": round(self.met), "passes": round(self.left / rays, 4), "voxels": round(2 * self.samples / rays, 1)}


def visible_voxels(
    matter: OccupiedVoxels,
    voxel_grid: VoxelGrid,
    ndc: Ndc | None,
    cameras: Sequence[Camera],
    threshold: float,
    kept: ResumeCache,
    progress: Progress,
) -> tuple[NDArray[Any], VisibilityStatistics]:
    """uint32 [M, 30, 30]: voxels that a ray of some camera reaches with transmittance >= threshold, and those within two of them; and what
    became of the light of all rays."""
    scene = coarse_opacity_scene(matter, voxel_grid.halved(), ndc)
    visited, light, first = np.zeros(len(scene.cells) * CELL_VOXELS**3, bool), VisibilityStatistics(), 0
    for done, arrays in kept.read("visibility"):
        wanted = {"visited": ((-(-len(visited) // 8),), np.uint8), "light": ((3,), np.floating)}
        if first < done <= len(cameras) and arrays_match(arrays, wanted) and np.isfinite(arrays["light"]).all():
            first, light = done, VisibilityStatistics(*arrays["light"].tolist())
            visited = np.unpackbits(arrays["visited"])[: len(visited)].astype(bool)
    settings = MarchSettings(stop_transmittance=threshold)
    for index in range(first, len(cameras)):
        camera, what = cameras[index], f"Visibility: camera {index + 1} of {len(cameras)}"

        def tell(fraction: float, _: str, index: int = index, what: str = what) -> None:
            progress((index + fraction) / len(cameras), what)

        coarse = visibility_camera(camera, scene)
        origins, directions = coarse.rays(tiled_pixels(coarse.width, coarse.height))
        light = light.and_of(march_rays(scene, origins, directions, settings, tell, camera.near, visited), threshold)
        tell(1.0, "")
        if kept.due or index + 1 == len(cameras):
            kept.add("visibility", index + 1, {"visited": np.packbits(visited), "light": np.array(astuple(light))})
            kept.flush()
    own = visited.reshape(-1, *(CELL_VOXELS,) * 3)[:, 1:-1, 1:-1, 1:-1]
    return refine_mask(dilate(pack_mask(own), scene.indirection), scene.indirection, matter.indirection), light


def coarse_opacity_scene(matter: OccupiedVoxels, voxel_grid: VoxelGrid, ndc: Ndc | None) -> Scene:
    """A scene of opacity alone on the lattice of voxels twice as large; faint voxels stay, so that fog adds up."""
    places = block_coordinates(matter.indirection)
    mask = np.zeros(voxel_grid.blocks, bool)
    mask[tuple((places // 2).T)] = True
    indirection = number_blocks(mask)
    cells = np.zeros((int(mask.sum()), *(CELL_VOXELS,) * 3, 4), np.uint8)
    for octant, rows in octants(places):
        part = tuple(slice(1 + HALF * o, 1 + HALF * (o + 1)) for o in octant)
        cells[(indirection[tuple((places[rows] // 2).T)], *part, 3)] = matter.coarse[rows]
    for _ in fill_aprons(cells, indirection):
        pass
    return Scene(voxel_grid.grid_to_world, voxel_grid.voxel_size, voxel_grid.shape, indirection, cells, None, ndc=ndc)


def refine_mask(bits: NDArray[Any], coarse: NDArray[Any], fine: NDArray[Any]) -> NDArray[Any]:
    """A mask of coarse voxels [Mc, 30, 30] as one of the voxels twice as fine [M, 30, 30]; coarse, fine: their indirection grids."""
    places = block_coordinates(fine)
    result = np.zeros((len(places), DATA_VOXELS, DATA_VOXELS), np.uint32)
    for octant, rows in octants(places):
        part = tuple(slice(HALF * o, HALF * (o + 1)) for o in octant)
        for start in range(0, len(rows), BLOCKS_PER_CHUNK):
            some = rows[start : start + BLOCKS_PER_CHUNK]
            own = unpack_mask(bits[coarse[tuple((places[some] // 2).T)]])[(slice(None), *part)]
            result[some] = pack_mask(own.repeat(2, axis=1).repeat(2, axis=2).repeat(2, axis=3))
    return result


def octants(places: NDArray[Any]) -> list[tuple[tuple[int, ...], NDArray[Any]]]:
    """Each octant (0 or 1 an axis) of a block of coarse voxels, and which blocks at places [M, 3] of fine ones fill it."""
    return [(octant, np.flatnonzero((places % 2 == octant).all(axis=-1))) for octant in product((0, 1), repeat=3)]


def visibility_camera(camera: Camera, scene: Scene) -> Camera:
    """The camera with pixels of about two voxels at the middle of the scene, at most as many as it has."""
    scale = min(1.0, 0.5 / (pixels_per_unit(camera, scene) * scene.voxel_size))
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def pixels_per_unit(camera: Camera, scene: Scene) -> float:
    """Pixels of a camera that a length of 1 of the scene's space covers, about the middle of the scene."""
    if camera.projection == "orthographic":
        return max(camera.focal)
    if scene.ndc is not None:  # as many at any depth for a camera where the frame is, about as many for its neighbours
        return max(mine / frame for mine, frame in zip(camera.focal, scene.ndc.focal, strict=True))
    box = scene.box
    return max(camera.focal) / max(float(np.linalg.norm(camera.position - box.box_to_world[:3, 3])), float(box.size.max()) / 4)
