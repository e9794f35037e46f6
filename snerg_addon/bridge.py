"""Conversion between Blender's objects and core's dataclasses, and from core's arrays to Blender's images."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..core.data.rig import RigSettings
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from ..core.io.images import to_uint8
from .panoramic import panoramic_camera, set_panoramic

SENSOR = 36.0  # mm, the sensor width of the cameras that are created: Blender's default
MAX_SHEAR = 1e-3  # largest cosine between two axes of a camera; rounding of Blender's float32 matrices gives less
PREVIEW = "SNeRG Preview"
STUDY = "SNeRG Study"
BOX = "SNeRG Box"


def resolution(scene: bpy.types.Scene) -> tuple[int, int]:
    """(width, height) of a render of the scene in pixels, with the resolution percentage."""
    render = scene.render
    return max(1, render.resolution_x * render.resolution_percentage // 100), max(
        1, render.resolution_y * render.resolution_percentage // 100
    )


def camera_from_blender(
    camera: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, size: tuple[int, int] | None = None
) -> Camera:
    """The core camera with the projection that Blender computes, for every sensor fit, shift and pixel aspect (hard cases 1, 2, 3).

    size: (width, height) in pixels, by default the scene's. Raises SnergError where the camera is of another kind (see
    `panoramic_camera`), or its pose is sheared or mirrored.
    """
    if camera.type != "CAMERA":
        raise SnergError(f"{camera.name!r} is not a camera; choose a camera.")
    evaluated = camera.evaluated_get(depsgraph)
    kind = evaluated.data.type
    if kind not in ("PERSP", "ORTHO", "PANO"):
        raise SnergError(f"The camera {camera.name!r} is {kind.lower()}; only perspective, orthographic and panoramic cameras can be used.")
    width, height = size or resolution(scene)
    pose = np.array(evaluated.matrix_world, np.float64)
    if shear(pose) > MAX_SHEAR:
        raise SnergError(f"The camera {camera.name!r} is sheared by a parent that is scaled unevenly; apply the parent's scale.")
    if kind == "PANO":
        return panoramic_camera(evaluated, camera.name, pose, width, height)
    projection = np.array(
        evaluated.calc_matrix_camera(
            depsgraph, x=width, y=height, scale_x=scene.render.pixel_aspect_x, scale_y=scene.render.pixel_aspect_y
        ),
        np.float64,
    )
    # Perspective: x_ndc = P00 x / -z - P02. Orthographic: x_ndc = P00 x + P03.
    offset_x, offset_y = (-projection[0, 2], -projection[1, 2]) if kind == "PERSP" else (projection[0, 3], projection[1, 3])
    return Camera(
        width=width,
        height=height,
        focal=(float(projection[0, 0]) * width / 2, float(projection[1, 1]) * height / 2),
        centre=(width / 2 * (1 + float(offset_x)), height / 2 * (1 - float(offset_y))),
        camera_to_world=pose,
        projection="perspective" if kind == "PERSP" else "orthographic",
        name=camera.name,
        near=float(evaluated.data.clip_start),
        far=float(evaluated.data.clip_end),
    )


def shear(pose: np.ndarray) -> float:
    """The largest cosine between two axes of a matrix [4, 4], 0 for axes without length."""
    axes = pose[:3, :3] / np.maximum(np.linalg.norm(pose[:3, :3], axis=0), 1e-12)
    return float(np.abs(axes.T @ axes - np.diag(np.diag(axes.T @ axes))).max())


def set_camera(camera: bpy.types.Object, source: Camera, scene: bpy.types.Scene | None = None) -> None:
    """Give a Blender camera the pose and the projection of `source`, without its lens distortion, which Blender cameras lack.

    scene: takes the camera's resolution and pixel aspect, if given. A scene has only one of each: a camera with another resolution or
    aspect still gets the right horizontal field of view.
    """
    data, (width, height) = camera.data, (source.width, source.height)
    aspect = source.focal[0] / source.focal[1]  # of a pixel: its height over its width
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.shift_x, data.shift_y = 0.5 - source.centre[0] / width, (source.centre[1] - height / 2) * aspect / width
    if source.is_wide:
        set_panoramic(data, source)
    elif source.projection == "orthographic":
        data.type, data.ortho_scale = "ORTHO", width / source.focal[0]
    else:
        data.type, data.lens_unit, data.lens = "PERSP", "MILLIMETERS", source.focal[0] * SENSOR / width
    if source.near > 0:
        data.clip_start = source.near
    if math.isfinite(source.far):
        data.clip_end = source.far
    camera.matrix_world = Matrix(source.camera_to_world.tolist())
    if scene is not None:
        set_picture(scene, source)


def set_picture(scene: bpy.types.Scene, source: Camera) -> None:
    """Set a scene to the resolution and the pixel aspect of a camera."""
    render, aspect = scene.render, 1.0 if source.is_wide else source.focal[0] / source.focal[1]
    render.resolution_x, render.resolution_y, render.resolution_percentage = source.width, source.height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1 / aspect), max(1.0, aspect)


def add_background(
    camera: bpy.types.Object, path: Path, scene: bpy.types.Scene, size: tuple[int, int], turn: tuple[int, bool] = (0, False)
) -> None:
    """Show an image of `size` (width, height) as the background of a camera that `set_camera` set, across the full width of its view.

    turn: how Blender, which ignores EXIF, must turn the image so that it has that size (see `images.quarter_turn`).
    """
    width, height = resolution(scene)
    aspect = scene.render.pixel_aspect_y / scene.render.pixel_aspect_x  # Blender treats the image's pixels as square
    taller = size[1] / size[0] - height * aspect / width
    background = camera.data.background_images.new()
    background.image = bpy.data.images.load(str(path), check_existing=True)  # the pixels are read when the image is first shown
    background.alpha, background.display_depth = 1.0, "BACK"
    background.frame_method = "STRETCH" if size == (width, height) else "CROP" if taller > 0 else "FIT"
    if turn[0]:
        background.rotation, background.use_flip_x = turn[0] * math.pi / 2, turn[1]  # positive is clockwise
        background.frame_method = "FIT"  # of the image as it is stored, before it is turned
        background.scale = max(size[1] / size[0], width / (height * aspect))
    camera.data.show_background_images = True


def add_points(name: str, points: np.ndarray, colours: np.ndarray | None, collection: bpy.types.Collection) -> bpy.types.Object:
    """A mesh of vertices without faces from points [N, 3], with sRGB colours [N, 3] uint8 as the attribute 'Color' if given."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(points, np.float32).ravel())
    if colours is not None:
        rgba = np.ones((len(points), 4), np.float32)
        rgba[:, :3] = np.asarray(colours, np.float32) / 255
        attribute = mesh.color_attributes.new(name="Color", type="BYTE_COLOR", domain="POINT")
        attribute.data.foreach_set("color_srgb", rgba.ravel())
    mesh.update()
    thing = bpy.data.objects.new(name, mesh)
    thing.hide_render = True
    collection.objects.link(thing)
    return thing


def add_box(box: Box, scene: bpy.types.Scene, name: str = BOX) -> bpy.types.Object:
    """Add a cube empty for a box, and make it the box that the scene bakes."""
    empty = bpy.data.objects.new(name, None)
    scene.collection.objects.link(empty)
    set_box(empty, box)
    empty.show_name = True
    scene.snerg.box = empty
    return empty


def box_of(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The scene's box object; None where none is chosen, or it was deleted from the scene (the setting keeps its data-block alive)."""
    box = scene.snerg.box
    return box if box is not None and scene.objects.get(box.name) == box else None


def box_from_blender(empty: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph | None = None) -> Box:
    """The box that a cube empty shows. Half a side is the display size times the scale.

    Raises SnergError where there is no empty, the object is not one, or the box has no volume.
    """
    if empty is None:
        raise SnergError("There is no box; add one with Add Box, or choose an empty under Box.")
    if empty.type != "EMPTY":
        raise SnergError(f"The box {empty.name!r} is not an empty; choose an empty, or add one with Add Box.")
    matrix = np.array((empty.evaluated_get(depsgraph) if depsgraph else empty).matrix_world, np.float64)
    try:
        return Box.from_matrix(matrix @ np.diag([*[empty.empty_display_size] * 3, 1]))
    except SnergError as error:
        raise SnergError(f"{empty.name}: {error}") from error


def size_text(empty: bpy.types.Object, scene: bpy.types.Scene) -> str:
    """'2 m x 1.5 m x 0.8 m': the sides of the box that a cube empty shows, in the scene's units."""
    unit = scene.unit_settings
    sizes = [2 * abs(side) * empty.empty_display_size * unit.scale_length for side in empty.matrix_world.to_scale()]
    return " x ".join(bpy.utils.units.to_string(unit.system, "LENGTH", size, precision=3) for size in sizes)


def rig_settings(scene: bpy.types.Scene) -> RigSettings:
    """The rig of the panel's settings."""
    settings = scene.snerg
    return RigSettings(settings.rig_count, settings.rig_shape == "HEMISPHERE", settings.rig_angle, settings.rig_distance)


def set_box(empty: bpy.types.Object, box: Box) -> None:
    """Set an empty to show a box as a cube."""
    empty.empty_display_type, empty.empty_display_size = "CUBE", 1.0
    empty.matrix_world = Matrix((box.box_to_world @ np.diag([*(box.size / 2), 1])).tolist())


def write_image(pixels: np.ndarray, name: str = PREVIEW) -> bpy.types.Image:
    """Put pixels [H, W, 3 or 4] into a Blender image: display-referred values in [0, 1], straight alpha, top row first.

    The image is 8-bit sRGB, so that Blender shows and saves the values unchanged whatever the scene's view transform is. Editors that
    show an earlier image of that name show the new one.
    """
    height, width = pixels.shape[:2]
    image = _byte_image(name, width, height)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., : pixels.shape[2]] = to_uint8(pixels).astype(np.float32) / 255
    image.pixels.foreach_set(rgba[::-1].ravel())  # Blender stores the bottom row first
    image.update()
    image.pack()  # else it would be lost with the session, and Blender would ask to save it
    image.use_fake_user = True  # else it would not be saved while no editor shows it
    return image


def image_editor(image: bpy.types.Image | None) -> tuple[bpy.types.Window, bpy.types.Area] | None:
    """The first image editor that shows an image, or that shows none where `image` is None, and its window."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and area.ui_type == "IMAGE_EDITOR" and area.spaces.active.image == image:
                return window, area
    return None


def show_image(image: bpy.types.Image) -> None:
    """Show an image: where it is shown already, else in an image editor that shows none, else in a window of its own."""
    if image_editor(image) is not None:
        return
    found = image_editor(None)
    if found is None:
        manager = bpy.context.window_manager
        before = set(manager.windows)
        with bpy.context.temp_override(window=manager.windows[0]):
            bpy.ops.wm.window_new()
        (window,) = set(manager.windows) - before
        found = window, window.screen.areas[0]
        found[1].ui_type = "IMAGE_EDITOR"
    found[1].spaces.active.image = image


def _byte_image(name: str, width: int, height: int) -> Any:
    old = bpy.data.images.get(name)
    if old is not None and (old.is_float or old.source not in ("GENERATED", "FILE")):
        old.name = f"{name} (old)"  # an image of the artist's own stays as it is
        old = None
    if old is not None and tuple(old.size) == (width, height):
        return old
    image = bpy.data.images.new(name, width, height, alpha=True, float_buffer=False)
    image.colorspace_settings.name = "sRGB"
    image.alpha_mode = "STRAIGHT"
    if old is not None:  # a packed image cannot change its size
        old.user_remap(image)
        bpy.data.images.remove(old)
        image.name = name
    return image
