"""Runs inside Blender's window: what pictures.py photographs. See tests/window/drive.py, which sends the events.

`blender --enable-event-simulate --python picture_walk.py -- panels FOLDER FILE` writes FOLDER/STEP.png, a picture of the whole window
for each step, and FOLDER/panels.json with the rectangles to crop to. `-- box FOLDER FILE` does the same for the box, `-- live FOLDER
SCENE` for the viewport and the camera view of a baked scene among meshes, and `-- growing FOLDER DATASET` for the viewport during a
training.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from mathutils import Euler

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "window"))
sys.path.insert(0, str(Path(__file__).resolve().parent))
import drive
import picture_object

STEPS = ("box", "dataset", "field", "bake", "preview", "study", "export", "results")  # and the list of results
SCALE = 1.25  # of Blender's interface: letters stay sharp in pictures of the sidebar
SIDEBAR_WIDTH = 420  # pixels: no name is cut off
VIEWPORT_SECONDS = 45  # for the viewport's render, by software
LIVE_DISTANCE, LIVE_SECONDS = 5.2, 15  # world units; seconds until the viewport has drawn the baked scene, by software
ENDLESS, PREVIEWS = 10**6, (1, 3, 7)  # steps of a training that is stopped, and those of its previews that are photographed
BOX_DISTANCE = 9.0  # world units: the rig's nearest cameras are in the picture
VIEW_DISTANCE = 3.7  # world units from the middle of the still life: nearer than its cameras, none of which is then in the way


def panels(window: drive.Window, file: str) -> drive.Walk:
    """A picture of the window with the panels of each step, then one of the rendered viewport beside all panels."""
    bpy.context.preferences.view.ui_scale = SCALE
    bpy.context.preferences.system.use_region_overlap = False  # else the sidebar is transparent
    yield from window.file("open_mainfile", Path(file))
    with bpy.context.temp_override(window=window.window, area=window.view):
        bpy.ops.screen.screen_full_area()
    look(window)
    yield from window.wait(1)
    yield from window.open_sidebar()
    yield from widen(window)
    for name in STEPS:
        show_only(name)
        yield from window.wait(0.5)
        yield from window.picture(name)
        window.seen.setdefault("crop", {})[name] = sidebar_rectangle(window)
    show_only("bake")
    window.view.spaces.active.shading.type = "RENDERED"
    yield from window.wait(VIEWPORT_SECONDS)
    yield from window.picture("blender")


def box(window: drive.Window, file: str) -> drive.Walk:
    """A picture of the viewport with the box, its arrows and voxels, and the rig's cameras, of the scene in the file."""
    bpy.context.preferences.view.ui_scale = SCALE
    yield from window.file("open_mainfile", Path(file))
    with bpy.context.temp_override(window=window.window, area=window.view):
        bpy.ops.screen.screen_full_area()
    look(window)
    settings, space, scene = window.settings, window.view.spaces.active, window.window.scene
    for thing in scene.objects:
        thing.hide_set(thing.type == "CAMERA" or bool(thing.snerg.folder))
    settings.show_voxels, settings.resolution, settings.cameras, settings.rig_count = True, 48, "RIG", 40
    space.shading.color_type, space.show_gizmo = "MATERIAL", True
    space.region_3d.view_rotation, space.region_3d.view_distance = Euler((1.1, 0, 0.6)).to_quaternion(), BOX_DISTANCE
    with bpy.context.temp_override(window=window.window):
        settings.box.select_set(True)
        window.window.view_layer.objects.active = settings.box
    yield from window.wait(2)
    yield from window.picture("box")
    window.seen["crop"] = region_rectangle(window)


def live(window: drive.Window, scene: str) -> drive.Walk:
    """A picture of the viewport with a baked scene among meshes, and one of its camera view."""
    bpy.context.preferences.view.ui_scale = SCALE
    with bpy.context.temp_override(window=window.window):
        baked = picture_object.build(Path(scene))
    with bpy.context.temp_override(window=window.window, area=window.view):
        bpy.ops.screen.screen_full_area()
    look(window)
    space = window.view.spaces.active
    space.shading.color_type = "MATERIAL"
    space.region_3d.view_rotation = Euler((1.05, 0, 0.75)).to_quaternion()
    space.region_3d.view_distance = LIVE_DISTANCE
    baked.select_set(True)
    region = next(region for region in window.view.regions if region.type == "WINDOW")
    for name in ("viewport", "camera"):
        if name == "camera":
            baked.select_set(False)
            space.region_3d.view_perspective = "CAMERA"
            with bpy.context.temp_override(window=window.window, area=window.view, region=region):
                bpy.ops.view3d.view_center_camera()
        yield from window.wait(LIVE_SECONDS)
        yield from window.picture(name)
        left, top, right, bottom = region_rectangle(window)
        aside, high = (region.width // 5, region.height // 8) if name == "viewport" else (0, 0)  # what lies round the scene is only grid
        window.seen.setdefault("crop", {})[name] = [left + aside, top + high, right - aside, bottom]


def growing(window: drive.Window, dataset: str) -> drive.Walk:
    """A picture of the viewport with some of the first previews of a training, which is stopped then."""
    yield from window.file("save_as_mainfile", window.folder / "training.blend")
    with bpy.context.temp_override(window=window.window):
        picture_object.empty()
    with bpy.context.temp_override(window=window.window, area=window.view):
        bpy.ops.screen.screen_full_area()
    look(window)
    window.view.spaces.active.region_3d.view_rotation = Euler((1.05, 0, 0.4)).to_quaternion()
    window.settings.dataset, window.settings.steps, window.settings.view_dependence = dataset, ENDLESS, "deferred"
    with bpy.context.temp_override(window=window.window):
        bpy.ops.snerg.train("INVOKE_DEFAULT")
    previews: set[int] = set()
    for count in PREVIEWS:
        if not (yield from window.until(lambda least=count: len(preview_times(window, previews)) >= least, 300)):
            raise RuntimeError(f"The training wrote {len(previews)} previews in place of {count}.")
        yield from window.wait(4)
        yield from window.picture(f"growing-{count}")
    left, top, right, bottom = region_rectangle(window)
    middle, height = (left + right) // 2, (bottom - top) * 7 // 8  # without the header
    window.seen["crop"] = [middle - height // 2, bottom - height, middle + height // 2, bottom]
    window.operator("cancel")
    yield from window.until(lambda: not window.busy(), 60)


def preview_times(window: drive.Window, seen: set[int]) -> set[int]:
    """When each preview of the training was written, as far as it was seen."""
    seen.update(path.stat().st_mtime_ns for path in window.folder.rglob("preview/scene.json"))
    return seen


def region_rectangle(window: drive.Window) -> list[int]:
    """Left, top, right and bottom of the 3D view in pixels of a picture of the window."""
    region = next(region for region in window.view.regions if region.type == "WINDOW")
    top = window.window.height - region.y - region.height
    return [region.x, top, region.x + region.width, top + region.height]


def look(window: drive.Window) -> None:
    """Look at the still life from its active camera's side, with nothing selected and small cameras around it."""
    scene, space = window.window.scene, window.view.spaces.active
    for thing in scene.objects:
        thing.select_set(False)
        if thing.type == "CAMERA":
            thing.data.display_size = 0.12
        if thing.type == "LIGHT":
            thing.data.cutoff_distance = 0.3  # the length of the line that is drawn; its light does not end there
    view = space.region_3d
    view.view_location, view.view_distance = (0, 0, 0.35), VIEW_DISTANCE
    if scene.camera is not None:
        view.view_rotation = scene.camera.matrix_world.to_quaternion()
    space.overlay.show_relationship_lines = space.overlay.show_text = space.overlay.show_cursor = False
    space.show_gizmo = space.show_region_toolbar = False


def widen(window: drive.Window) -> drive.Walk:
    """Drag the sidebar's left edge until it is SIDEBAR_WIDTH wide."""
    x, y = window.sidebar.x, window.sidebar.y + window.sidebar.height // 2
    yield from window.move(x, y)
    window.send("LEFTMOUSE", "PRESS")
    yield
    goal = x + window.sidebar.width - SIDEBAR_WIDTH
    for part in range(1, 6):
        yield from window.move(x + (goal - x) * part / 5, y)
    window.send("LEFTMOUSE", "RELEASE")
    yield from window.wait(0.5)


def show_only(shown: str) -> None:
    """Open a step of the sidebar and close the others."""
    for step in STEPS:
        setattr(bpy.context.window_manager.snerg_steps, step, step == shown)


def sidebar_rectangle(window: drive.Window) -> list[int]:
    """Left, top, right and bottom of the sidebar in pixels of a picture of the window."""
    sidebar, height = window.sidebar, window.window.height
    return [sidebar.x, height - sidebar.y - sidebar.height, sidebar.x + sidebar.width, height - sidebar.y]


if __name__ == "__main__":
    drive.main(sys.modules[__name__])
