"""The order in which a page reads a scene's cells: first those that the first camera sees, front to back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..progress import Progress, within
from ..rendering.render import MarchSettings, march_rays, tiled_pixels
from ..scene.blocks import DATA_VOXELS
from ..scene.scene import Scene
from .atlas import atlas_blocks

SIDE = 400  # pixels of the longer side of the picture that says which cells are seen
FRONT, SEEN = 0.3, 1 / 255  # transmittance in front of a cell's voxels: of cells that come first, and of those that change a picture


@dataclass(frozen=True, eq=False)
class CellOrder:
    """cells: int [M], the cells by importance. seen: how many of them the camera sees."""

    cells: NDArray[Any]
    seen: int

    def sorted(self, scene: Scene) -> Scene:
        """The same scene with its cells in this order."""
        rank = np.empty(len(self.cells) + 1, np.int32)
        rank[self.cells], rank[-1] = np.arange(len(self.cells), dtype=np.int32), -1
        return replace(scene, indirection=rank[scene.indirection], cells=scene.cells[self.cells])

    def layers(self, in_order: bool) -> dict[str, Any]:
        """The value of "layers" in cameras.json: the atlas's layers by importance, and how many of them hold what the camera sees.

        in_order: whether the cells of the atlas are in this order.
        """
        bx, by, _ = atlas_blocks(len(self.cells))
        layer_of = (np.arange(len(self.cells)) if in_order else self.cells) // (bx * by)
        order = sorted(set(layer_of.tolist()), key=lambda layer: float(np.flatnonzero(layer_of == layer).mean()))
        needed = set(layer_of[: self.seen].tolist())
        return {"order": order, "seen": max((order.index(layer) + 1 for layer in needed), default=0)}


def cell_order(scene: Scene, camera: Camera, progress: Progress) -> CellOrder:
    """The cells of a scene by their importance to a camera: in front, seen behind others, not seen; each of these front to back."""
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    origins, directions = small.rays(tiled_pixels(small.width, small.height))
    group = np.zeros(len(scene.cells), np.int64)
    for half, transmittance in enumerate((FRONT, SEEN)):
        visited = np.zeros(scene.cells.shape[0] * np.prod(scene.cells.shape[1:4]), bool)
        part = within(progress, 0.5 * half, 0.5 * (half + 1))
        march_rays(scene, origins, directions, MarchSettings(stop_transmittance=transmittance), part, max(scene.near, small.near), visited)
        group += ~visited.reshape(len(scene.cells), -1).any(axis=1)
    return CellOrder(np.lexsort((_distances(scene, camera), group)), int((group < 2).sum()))


def _distances(scene: Scene, camera: Camera) -> NDArray[Any]:
    """From a camera to the middle of each cell's block, [M], in the scene's units; in device coordinates, the depth there."""
    blocks = np.argwhere(scene.indirection >= 0)
    middle = (blocks + 0.5) * DATA_VOXELS * scene.voxel_size
    world = middle @ scene.grid_to_world[:3, :3].T + scene.grid_to_world[:3, 3]
    distances = np.full(len(scene.cells), np.inf)
    if scene.ndc is not None:
        found = world[:, 2]
    elif camera.projection == "orthographic":
        found = (camera.position - world) @ camera.camera_to_world[:3, 2]
    else:
        found = np.linalg.norm(world - camera.position, axis=1)
    distances[scene.indirection[tuple(blocks.T)]] = found
    return distances
