"""What the box and the rig will do, drawn in the viewport beforehand: the voxels of the chosen resolution, and the rig's cameras."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.baking.bake import BakeSettings
from ..core.data.rig import rig_cameras
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from .bridge import box_from_blender, box_of, resolution, rig_settings
from .estimate_panel import bake_settings

MAX_LINES = 64  # along a side of the box; where there are more voxels, a line stands for several
VOXELS = (1.0, 0.65, 0.2, 0.35)
CAMERAS = (0.35, 0.75, 1.0, 0.7)
CAMERA_SIZE = 0.06  # length of a drawn camera, of its distance from the box's centre
_handle: Any = None


def register() -> None:
    """Draw in every viewport from here on."""
    global _handle
    if _handle is None and not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    """Draw no longer."""
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None


def draw() -> None:
    """Draw what the settings ask for."""
    context = bpy.context
    settings, empty = context.scene.snerg, box_of(context.scene)
    if empty is None or not context.space_data.overlay.show_overlays:
        return
    try:
        box = box_from_blender(empty)
        if settings.show_voxels:
            draw_lines(voxel_lines(box, lines_of(box, bake_settings(context.scene))[0]), VOXELS)
        if settings.cameras == "RIG":
            draw_lines(camera_lines(rig_cameras(box, rig_settings(context.scene), *resolution(context.scene)), box), CAMERAS)
    except SnergError:
        return  # the panel says what is wrong with the box or the rig


def voxels_a_line(scene: bpy.types.Scene) -> int:
    """How many voxels of the bake a drawn square stands for, along each side; 0 where the box cannot be baked."""
    try:
        return lines_of(box_from_blender(box_of(scene)), bake_settings(scene))[1]
    except SnergError:
        return 0


def lines_of(box: Box, settings: BakeSettings) -> tuple[np.ndarray, int]:
    """(cells [3] that are drawn along each side, voxels that one of them stands for along each side, a power of 2)."""
    size = settings.voxel_size or float(box.size.max()) / settings.resolution
    voxels = np.maximum(np.ceil(box.size / size - 1e-6), 1)
    each = 1
    while voxels.max() / each > MAX_LINES:
        each *= 2
    return np.ceil(voxels / each).astype(int), each


def voxel_lines(box: Box, cells: np.ndarray) -> np.ndarray:
    """Line ends [N, 2, 3] of a grid with that many cells along each side on three faces of the box, world units."""
    low, high = -box.size / 2, box.size / 2
    lines = []
    for face in range(3):
        u, v = (axis for axis in range(3) if axis != face)
        for along, across in ((u, v), (v, u)):
            at = np.linspace(low[across], high[across], int(cells[across]) + 1)
            ends = np.full((len(at), 2, 3), low[face])
            ends[:, :, across] = at[:, None]
            ends[:, 0, along], ends[:, 1, along] = low[along], high[along]
            lines.append(ends)
    local = np.concatenate(lines)
    return local @ box.box_to_world[:3, :3].T + box.box_to_world[:3, 3]


def camera_lines(cameras: tuple[Camera, ...], box: Box) -> np.ndarray:
    """Line ends [N, 2, 3] of a pyramid for each camera, world units."""
    lines = []
    for camera in cameras:
        eye = camera.position
        depth = CAMERA_SIZE * float(np.linalg.norm(eye - box.box_to_world[:3, 3]))
        x, y = (
            depth * (0.5 if camera.is_wide else side / 2 / focal)
            for side, focal in zip((camera.width, camera.height), camera.focal, strict=True)
        )
        corners = np.array([[sx * x, sy * y, -depth] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        corners = corners @ camera.camera_to_world[:3, :3].T + eye
        lines += [(eye, corner) for corner in corners]
        lines += list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    return np.array(lines)


def draw_lines(ends: np.ndarray, colour: tuple[float, float, float, float]) -> None:
    """Draw lines [N, 2, 3], behind what is in front of them."""
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "LINES", {"pos": ends.reshape(-1, 3).astype(np.float32).tolist()})
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    shader.uniform_float("color", colour)
    batch.draw(shader)
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")
