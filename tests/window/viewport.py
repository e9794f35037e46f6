"""SNeRG objects in the viewport: marched on the graphics card as by NumPy, before and behind meshes. Runs inside Blender."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from drive import Walk, Window

CUBES = {"front": ((0.0, -1.5, 0.0), (1, 0, 0, 1)), "behind": ((0.0, 1.5, 0.7), (0, 0, 1, 1))}


def part(name: str) -> Any:
    """A module of the installed extension."""
    return importlib.import_module(f"bl_ext.user_default.snerg_addon.{name}")


def gpu_frames(window: Window, folder: str, cameras: str) -> Walk:
    """The largest and the mean difference, in levels of 8 bits, of the card's picture from NumPy's, of each camera."""
    gpu_scene, view = part("snerg_addon.viewport.gpu_scene"), part("snerg_addon.viewport.view")
    rendering, files = part("core.rendering.render"), part("core.export.scene_files")
    window.seen["differences"] = []
    scene = files.read_scene(Path(folder))
    held = gpu_scene.GpuScene(scene)
    for value in json.loads(Path(cameras).read_text()):
        camera = part("core.geometry.camera").Camera.from_json(value)
        width, height = camera.width, camera.height
        target = gpu_scene.Target(width, height)
        scale = width / 2 / camera.focal[0], height / 2 / camera.focal[1]
        offset = (width / 2 - camera.centre[0]) / camera.focal[0], (camera.centre[1] - height / 2) / camera.focal[1]
        projection = view.Projection(scale, offset, camera.projection == "orthographic", camera.near, min(camera.far, 1e6), np.eye(4))
        seen = view.uniforms(scene, scene.box.box_to_world, camera.camera_to_world, projection)
        gpu_scene.march(held, seen, target)
        frame = rendering.render_scene(scene, camera)
        wanted = np.concatenate([frame.colour, frame.alpha[..., None]], axis=-1)
        error = 255 * np.abs(np.clip(target.pixels()[0], 0, 1) - np.clip(wanted, 0, 1))
        window.seen["differences"].append([camera.name, float(error.max()), float(error.mean())])
        yield


def between_meshes(window: Window, folder: str) -> Walk:
    """A green block between a red cube in front and a blue one behind, in each shading; where on the picture each should be seen."""
    data = bpy.data
    for thing in list(data.objects):
        data.objects.remove(thing)
    for name, (place, colour) in CUBES.items():
        bpy.ops.mesh.primitive_cube_add(size=0.3, location=place)
        bpy.context.object.name, bpy.context.object.color = name, colour
    window.operator("add_scene", directory=folder)
    bpy.context.object.select_set(False)
    space, region = window.view.spaces[0], next(r for r in window.view.regions if r.type == "WINDOW")
    shading, data3d = space.shading, space.region_3d
    shading.light, shading.color_type = "FLAT", "OBJECT"
    space.overlay.show_overlays = False
    data3d.view_rotation, data3d.view_location, data3d.view_distance = (0.7071068, 0.7071068, 0, 0), (0, 0, 0), 4
    for kind in ("PERSP", "ORTHO"):
        data3d.view_perspective = kind
        yield from window.wait(3)
        points = {"red": (0, -1.65, 0), "green": (0.3, -0.47, -0.3), "green over blue": (0.0, -0.47, 0.38), "blue": (0.0, 1.35, 0.8)}
        found = {name: location_3d_to_region_2d(region, data3d, point) for name, point in points.items()}
        window.seen[kind] = {name: [region.x + at.x, region.y + at.y] for name, at in found.items()}
        window.shoot(kind)
    window.seen["height"] = window.window.height


def shown_training(window: Window, photos: str) -> Walk:
    """Train with the 3D view in sight: how often the training's object shows something new, and what is left of it at the end."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    window.settings.dataset, window.settings.steps, window.settings.view_dependence = photos, 100000, "diffuse"
    window.view.spaces.active.region_3d.view_distance = 6
    with bpy.context.temp_override(window=window.window):
        bpy.ops.snerg.train("INVOKE_DEFAULT")
    yield from window.picture("before")
    for count in range(3):
        window.seen[f"shown {count}"] = yield from window.until(lambda known=count: len(previews(window)) > known, 120)
        yield from window.picture(f"shown-{count}")
        if count == 1:
            yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    window.seen["objects"] = len(temporary())
    window.operator("cancel")
    window.seen["ended"] = yield from window.until(lambda: not window.busy(), 60)
    window.seen["left"] = [thing.name for thing in temporary()] + [str(path) for path in window.folder.rglob("preview")]
    yield from window.picture("after")


def temporary() -> list[Any]:
    """The objects that show trainings."""
    return [thing for thing in bpy.data.objects if thing.snerg.temporary]


def previews(window: Window) -> set[int]:
    """The previews that were seen so far, by the time of their files, once the object shows them."""
    seen: set[int] = window.__dict__.setdefault("previews", set())
    found = part("snerg_addon.viewport.loading")._known
    seen.update(found[folder].stamp for folder in found if temporary() and folder.name == "preview" and found[folder].scene)
    return seen


def preview_seen(window: Window, folder: str) -> Walk:
    """Render the preview, close its window, show it again, and render it once more."""
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    window.operator("import_scene", filepath=folder)
    window.seen["windows"] = [len(bpy.context.window_manager.windows)]
    window.window.scene.render.resolution_percentage = 25

    def note() -> None:
        manager = bpy.context.window_manager
        window.seen["windows"].append(len(manager.windows))
        shown = [a.spaces.active.image for w in manager.windows for a in w.screen.areas if a.type == "IMAGE_EDITOR"]
        window.seen.setdefault("images", []).append([image and image.name for image in shown])
        window.seen.setdefault("texts", []).append(window.texts("preview"))

    with bpy.context.temp_override(window=window.window):
        bpy.ops.snerg.preview("INVOKE_DEFAULT")
    yield from window.until(lambda: not window.busy() and len(bpy.context.window_manager.windows) > 1, 60)
    yield from window.wait(1)
    note()
    window.shoot("opened")
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.wm.window_close()
    yield from window.wait(1)
    note()
    yield from window.picture("closed")
    window.operator("show_preview")
    yield from window.wait(1)
    note()
    with bpy.context.temp_override(window=window.window):
        bpy.ops.snerg.preview("INVOKE_DEFAULT")
    yield from window.until(lambda: not window.busy(), 60)
    yield from window.wait(1)
    note()


def rewritten(window: Window, folder: str) -> Walk:
    """An object whose folder is written again and again, each time in another colour; where on the picture its middle is."""
    files = part("core.export.scene_files")
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    window.operator("add_scene", directory=folder)
    bpy.context.object.select_set(False)
    space, region = window.view.spaces[0], next(r for r in window.view.regions if r.type == "WINDOW")
    space.overlay.show_overlays = False
    space.region_3d.view_location, space.region_3d.view_distance = (0, 0, 0), 3
    scene = files.read_scene(Path(folder))
    for count in range(8):
        cells = scene.cells.copy()
        cells[..., :3] = np.where(cells[..., 3:] > 0, np.eye(3, dtype=np.uint8)[count % 3] * 255, 0)
        files.write_scene(replace(scene, cells=cells), Path(folder))
        space.region_3d.view_distance = 3  # draws the view again
        yield from window.wait(2)
        window.shoot(str(count))
    window.seen["middle"] = [region.x + region.width / 2, window.window.height - region.y - region.height / 2]
