"""The axes of the reference layout, and turning a scene's grid to them and back.

The published viewer's world has the grid's own axes, y up. The viewer starts at (0, 1, -4), looks at the origin, and has its near
plane at 0.33. It evaluates the network for M d, with M the upper 3 x 3 of worldspace_T_opengl and d a direction in its world.

A forward-facing scene ("ndc") lies in normalised device coordinates with z reversed, near plane at 1. There the viewer looks along
its z axis with x to the left, so that a direction in the frame's axes is diag(-1, 1, -1) d. Where a ray meets the near plane, the
viewer computes origin * t + direction in place of origin + t * direction, so that its perspective is slightly wrong with any file
(hard case 10).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.ndc import Ndc
from ..scene.blocks import DATA_VOXELS
from ..scene.scene import Scene

WORLD_FROM_VIEWER = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])  # the viewer starts at Blender's front view
IDENTITY = np.eye(3, dtype=int)
FLIP_Z = np.diag([1, 1, -1])  # our device coordinates to the layout's, and back
FRAME_FROM_VIEWER = np.diag([-1, 1, -1])  # of a forward-facing scene


def viewer_scene(scene: Scene) -> Scene:
    """The scene with its grid along the viewer's axes; a forward-facing scene in the layout's device coordinates.

    Raises SnergError when a forward-facing scene's box is rotated.
    """
    rotation = scene.grid_to_world[:3, :3]
    if scene.ndc is None:
        return reorient(scene, viewer_axes(rotation))
    if np.abs(np.rint(rotation) - rotation).max() > 1e-9:
        raise SnergError(
            "The scene is forward-facing and its box is turned, which the reference layout has no room for: bake it without a box."
        )
    return reorient(scene, np.rint(rotation.T @ FLIP_Z).astype(int), FLIP_Z)


def layout_from_ndc(ndc: Ndc | None) -> NDArray[Any]:
    """int [3, 3] from the space that a scene's grid lies in, the world or NDC, to the one that the layout's grid lies in."""
    return IDENTITY if ndc is None else FLIP_Z


def viewer_axes(rotation: NDArray[Any]) -> NDArray[Any]:
    """[3, 3] signed permutation from the viewer's axes to the grid's that shows the scene upright, as nearly as possible.

    rotation: [3, 3] from the grid's axes to the world's. Of the 24 rotations of a cube, it is the one that brings the viewer's y
    axis nearest to the world's z axis, and then the other axes nearest to Blender's front view.
    """
    weight = np.array([1.0, 10.0, 1.0])
    return max(_cube_rotations(), key=lambda turn: float((WORLD_FROM_VIEWER * (rotation @ turn) * weight).sum()))


def _cube_rotations() -> Iterable[NDArray[Any]]:
    """The 24 signed permutations [3, 3] with determinant 1."""
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        turn = np.eye(3, dtype=int)[:, list(order)] * signs
        if round(np.linalg.det(turn)) == 1:
            yield turn


def reorient(scene: Scene, turn: NDArray[Any], flip: NDArray[Any] = IDENTITY) -> Scene:
    """The same scene with its grid along other axes.

    turn: int [3, 3], a signed permutation; column j is the new axis j in the old axes. flip: int [3, 3], from the space that the
    grid lies in to that of the result; it mirrors if `turn` does. A reversed axis is padded to whole macroblocks, so that cells are
    reversed as a whole. Cells are numbered in x, y, z order with z fastest.
    """
    order, signs = np.abs(turn).argmax(axis=0), turn.sum(axis=0)
    reversed_axes = [axis for axis in range(3) if signs[axis] < 0]
    shape = [int(scene.shape[axis]) for axis in order]
    pose = scene.grid_to_world.copy()
    pose[:3] = flip @ pose[:3]
    pose[:3, :3] = pose[:3, :3] @ turn
    for axis in reversed_axes:
        shape[axis] = -(-shape[axis] // DATA_VOXELS) * DATA_VOXELS
        pose[:3, 3] -= pose[:3, axis] * shape[axis] * scene.voxel_size
    numbers = np.flip(scene.indirection.transpose(order), reversed_axes)
    full = numbers >= 0
    indirection = np.where(full, np.cumsum(full.reshape(-1)).reshape(full.shape) - 1, -1).astype(np.int32)
    cells = np.flip(scene.cells.transpose(0, *(order + 1), 4), [axis + 1 for axis in reversed_axes])[numbers[full]]
    return replace(
        scene, grid_to_world=pose, shape=(shape[0], shape[1], shape[2]), indirection=indirection, cells=np.ascontiguousarray(cells)
    )
