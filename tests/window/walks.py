"""What an artist does in Blender's window: one walk a function, whose `window` (drive.py) clicks, types and looks.

A walk only notes what it sees, in `window.seen`; test_window.py says what it should have been.
"""

from __future__ import annotations

import time
from pathlib import Path

import bpy
from backgrounds import turned  # noqa: F401  # a walk too
from box import box_handles  # noqa: F401  # a walk too
from drive import Walk, Window
from moves import camera_move  # noqa: F401  # a walk too
from objects import (  # noqa: F401  # walks too
    composite,
    forward_facing,
    instances,
    kept,
    little_memory,
    refused_scene,
    several_regions,
    undo,
)
from panel import dropped, empty_to_page, found_by_f3, steps_opened  # noqa: F401  # walks too
from viewport import between_meshes, gpu_frames, preview_seen, rewritten, shown_training  # noqa: F401  # walks too

FROM_RIGHT = 40  # pixels from the sidebar's right edge to the button that stops what runs


def sidebar(window: Window) -> Walk:
    """N, the tab, the buttons, and a click on one."""
    window.seen["closed"] = window.sidebar.width
    yield from window.open_sidebar()
    window.seen["open"] = window.sidebar.width
    for operator in ("snerg.render_dataset", "snerg.train", "snerg.bake"):
        yield from window.find(operator)
    yield from window.click("snerg.add_box")
    window.seen["box"] = window.settings.box is not None
    yield from window.picture("box")


def training(window: Window, photos: str) -> Walk:
    """Click Train; play the timeline and press Esc; another workspace and back; stop it there by the panel's button."""
    yield from begin(window, "artwork", photos)
    yield from window.picture("before")
    window.settings.steps = 100000
    yield from window.click("snerg.train")
    window.seen["started"] = yield from window.until(window.busy, 20)
    window.seen["advanced"] = yield from window.until(lambda: any("steps," in text for text in window.texts("field")), 120)
    yield from window.picture("training")
    yield from play_and_escape(window)
    yield from window.wait(4)
    window.seen["busy_after_esc"] = window.busy()
    yield from window.picture("after-esc")
    if not window.busy():
        yield from window.click("snerg.train")
        yield from window.until(window.busy, 20)
        yield from window.wait(1)
    yield from another_workspace(window, "PAGE_DOWN")
    yield from window.wait(1)
    yield from window.open_sidebar()
    yield from window.click("snerg.cancel", FROM_RIGHT)
    window.seen["stopped"] = yield from window.until(lambda: not window.busy(), 60)
    yield from window.wait(2)
    window.shoot("untouched")  # no event since: the panel must have been drawn again by itself
    yield from window.picture("touched")
    yield from window.picture("elsewhere")
    yield from another_workspace(window, "PAGE_UP")
    yield from window.wait(1)
    yield from window.picture("after")


def play_and_escape(window: Window) -> Walk:
    """Space plays the timeline, Esc ends that."""
    yield from window.over_view()
    yield from window.press("SPACE")
    window.seen["plays"] = yield from window.until(lambda: window.window.screen.is_animation_playing, 5)
    yield from window.press("ESC")
    window.seen["ends"] = yield from window.until(lambda: not window.window.screen.is_animation_playing, 3)


def another_workspace(window: Window, key: str) -> Walk:
    """Ctrl-Page Down goes to the next one, Ctrl-Page Up back."""
    before = window.window.workspace.name
    yield from window.over_view()
    yield from window.press(key, ctrl=True)
    window.seen[key] = yield from window.until(lambda: window.window.workspace.name != before, 5)


def box_deleted(window: Window) -> Walk:
    """Add a box by its button, then delete it with X."""
    yield from window.open_sidebar()
    yield from window.click("snerg.add_box")
    window.settings.cameras = "RIG"
    window.seen["box_before"], window.seen["dataset_before"] = window.texts("box"), window.texts("dataset")
    name = window.settings.box.name
    yield from window.over_view()
    yield from window.press("X")
    yield from window.wait(0.3)
    if name in window.window.scene.objects:  # it asks
        yield from window.press("RET")
        yield from window.wait(0.3)
    window.seen["deleted"] = name not in window.window.scene.objects
    window.seen["box"], window.seen["dataset"] = window.texts("box"), window.texts("dataset")
    yield from window.picture("deleted")


def unsaved(window: Window) -> Walk:
    """Render a dataset in a file that was never saved, then save it."""
    quick(window, 24, 1)
    yield from window.open_sidebar()
    yield from window.click("snerg.add_box")
    window.settings.cameras, window.settings.rig_count, window.settings.test_every = "RIG", 4, 2
    yield from window.click("snerg.render_dataset")
    window.seen["started"] = yield from window.until(window.busy, 20)
    window.seen["ended"] = yield from window.until(lambda: not window.busy(), 120)
    window.seen["main_before"], window.seen["dataset_before"] = window.texts("main"), window.texts("dataset")
    yield from window.picture("unsaved")
    yield from window.file("save_as_mainfile", window.folder / "saved.blend")
    yield from window.until(lambda: not window.busy(), 60)
    yield from window.wait(1)
    window.seen["main"], window.seen["dataset"] = window.texts("main"), window.texts("dataset")
    window.seen["views"] = len(views_of(window))
    yield from window.picture("saved")


def views_of(window: Window) -> list[Path]:
    """The rendered views in the project's folder; the pictures of the walk lie beside that."""
    return [path for path in window.folder.rglob("*.png") if path.parent != window.folder]


def quick(window: Window, size: int, samples: int) -> None:
    """Set the scene to render pictures of `size` pixels a side."""
    scene = window.window.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", samples, False
    scene.render.resolution_x = scene.render.resolution_y = size


def second_file(window: Window, trained: str) -> Walk:
    """A project with a field; a second scene in its file; a second file beside it; and the first file again."""
    first = window.folder / "first.blend"
    yield from begin(window, "first")
    window.operator("import_field", filepath=trained)
    yield from window.file("save_as_mainfile", first)
    window.seen["first"] = window.texts("main") + window.texts("field")
    with bpy.context.temp_override(window=window.window):
        bpy.ops.scene.new(type="NEW")
    yield from window.wait(0.5)
    window.seen["scene"] = window.texts("main") + window.texts("field")
    yield from window.picture("second-scene")
    yield from window.file("read_homefile")
    yield from window.file("save_as_mainfile", window.folder / "second.blend")
    yield from window.open_sidebar()
    window.seen["second"] = window.texts("main") + window.texts("field")
    yield from window.picture("second-file")
    yield from window.file("open_mainfile", first)
    window.seen["again"] = window.texts("main") + window.texts("field")


def search(window: Window) -> Walk:
    """F3, a few letters, Enter."""
    yield from window.over_view()
    yield from window.press("F3")
    yield from window.wait(0.5)
    yield from window.type("snerg add box")
    yield from window.wait(0.5)
    window.shoot("search")
    yield from window.press("RET")
    yield from window.wait(0.5)
    window.seen["box"] = window.settings.box is not None
    yield from window.press("ESC")


def import_dialog(window: Window, photos: str) -> Walk:
    """Import Dataset: what the file browser proposes, and what comes of a folder chosen there."""
    yield from begin(window, "artwork")
    yield from window.click("snerg.import_dataset")
    yield from window.until(lambda: browser(window) is not None, 10)
    parameters = browser(window).spaces.active.params
    window.seen["proposed"] = parameters.filename
    window.seen["shows"] = [parameters.use_filter, parameters.use_filter_folder, parameters.filter_glob]
    parameters.directory, parameters.filename = photos.encode(), ""
    yield from window.wait(1)
    window.shoot("browser")
    area = browser(window)
    with bpy.context.temp_override(window=window.window, area=area, region=area.regions[-1]):
        bpy.ops.file.execute()
    yield from window.until(lambda: browser(window) is None, 10)
    yield from window.wait(0.5)
    yield from window.until(lambda: not window.busy(), 60)
    window.seen["dataset"], window.seen["main"] = window.settings.dataset, window.texts("main")
    yield from window.picture("imported")
    window.settings.dataset = "//nowhere"
    yield from window.wait(0.2)
    window.seen["wrong"] = window.texts("dataset") + window.texts("main") + window.texts("field")
    yield from window.picture("wrong-folder")


def browser(window: Window) -> object:
    """The area of the file browser, None when there is none."""
    return next((area for area in window.window.screen.areas if area.type == "FILE_BROWSER"), None)


def rendering(window: Window) -> Walk:
    """Render views that take seconds each, and see how long the window does not answer, and how long a view takes."""
    quick(window, 700, 200)
    window.settings.cameras = "ALL"
    yield from begin(window, "artwork")
    yield from window.find("snerg.render_dataset")
    window.longest_pause, began = 0.0, time.monotonic()
    yield from window.press("LEFTMOUSE")
    window.seen["started"] = yield from window.until(window.busy, 20)
    window.seen["ended"] = yield from window.until(lambda: not window.busy(), 150)
    window.seen["longest_pause"] = window.longest_pause
    window.seen["seconds_a_view"] = (time.monotonic() - began) / max(len(views_of(window)), 1)
    window.seen["main"] = window.texts("main")
    yield from window.picture("rendered")


def leave(window: Window, photos: str, steps: str) -> Walk:
    """Start a training and quit, in a file that has no unsaved changes."""
    yield from begin(window, "artwork", photos)
    window.settings.steps = int(steps)
    yield from start_and_quit(window, "snerg.train")


def leave_in_mid_bake(window: Window, trained: str, resolution: str) -> Walk:
    """Import a field, start a bake and quit."""
    yield from begin(window, "artwork")
    window.operator("import_field", filepath=trained)
    window.settings.resolution = int(resolution)
    yield from start_and_quit(window, "snerg.bake")


def start_and_quit(window: Window, operator: str) -> Walk:
    """Click a button, wait until its job runs, and quit with Ctrl-Q."""
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    yield from window.click(operator)
    window.seen["started"] = yield from window.until(window.busy, 20)
    yield from window.wait(3)
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    window.seen["busy"] = window.busy()
    window.write()
    yield from window.over_view()
    yield from window.press("Q", ctrl=True)
    yield from window.wait(3)
    yield from window.press("RET")  # where it asks first
    yield from window.wait(5)
    raise AssertionError("Blender did not quit")


def come_back(window: Window) -> Walk:
    """Open that file again, and wait until the job has ended."""
    yield from window.file("open_mainfile", window.folder / "artwork.blend")
    yield from window.open_sidebar()
    yield from window.wait(1)
    window.seen["main_at_first"] = window.texts("main")
    yield from window.picture("back")
    yield from window.until(lambda: not window.busy(), 240)
    window.seen["field"], window.seen["bake"] = window.texts("field"), window.texts("bake")
    window.seen["objects"] = [thing.name for thing in bpy.data.objects if thing.snerg.folder]
    yield from window.wait(2)
    yield from window.picture("ended")


def undo_a_bake(window: Window, trained: str) -> Walk:
    """Move the cube, bake, move it meanwhile, then Ctrl-Z and Shift-Ctrl-Z; and a bake that ends while the cube is in Edit Mode."""
    yield from begin(window, "artwork")
    window.operator("import_field", filepath=trained)
    window.settings.resolution = 24
    yield from move_cube(window, "X")
    yield from window.click("snerg.bake")
    window.seen["started"] = yield from window.until(window.busy, 20)
    yield from move_cube(window, "Y")
    yield from window.until(lambda: not window.busy(), 120)
    window.seen["main"], window.seen["steps"] = window.texts("main"), [cube_and_baked()]
    yield from window.picture("baked")
    for shift in (False, True):
        for _ in range(3):
            yield from window.press("Z", ctrl=True, shift=shift)
            yield from window.wait(0.3)
            window.seen["steps"].append(cube_and_baked())
    yield from window.press("TAB")
    yield from window.wait(0.3)
    window.seen["mode"] = bpy.data.objects["Cube"].mode
    window.settings.resolution = 20
    yield from window.click("snerg.bake")
    window.seen["waits"] = yield from window.until(lambda: any("leave Edit Mode" in text for text in window.texts("main")), 120)
    window.seen["in_edit_mode"] = baked_versions()
    yield from window.picture("waits")
    yield from window.press("TAB")
    yield from window.until(lambda: not window.busy(), 20)
    window.seen["left_edit_mode"] = baked_versions()
    for shift in (False, True):
        yield from window.press("Z", ctrl=True, shift=shift)
        yield from window.wait(0.3)
        window.seen["redone" if shift else "undone"] = baked_versions()


def move_cube(window: Window, axis: str) -> Walk:
    """G, an axis, 1, Enter, over the 3D view with the cube selected."""
    yield from window.over_view()
    for key in ("G", axis):
        yield from window.press(key)
    window.send("ONE", "PRESS", unicode="1")
    window.send("ONE", "RELEASE")
    yield
    yield from window.press("RET")
    yield from window.wait(0.3)


def cube_and_baked() -> list[float]:
    """Where the cube is, and how many SNeRG objects there are."""
    cube = bpy.data.objects["Cube"].location
    return [round(cube.x, 3), round(cube.y, 3), len(baked_versions())]


def baked_versions() -> list[str]:
    """The versions that SNeRG objects show."""
    return [Path(thing.snerg.folder).name for thing in bpy.data.objects if thing.snerg.folder]


def flat_box(window: Window, trained: str) -> Walk:
    """Bake in a box of zero thickness."""
    yield from begin(window, "artwork")
    window.operator("import_field", filepath=trained)
    yield from window.click("snerg.add_box")
    window.settings.box.scale.z = 0
    yield from window.wait(0.5)
    window.seen["box"], window.seen["bake_before"] = window.texts("box"), window.texts("bake")
    yield from window.picture("flat")
    yield from window.click("snerg.bake")
    yield from window.wait(2)
    window.seen["busy"], window.seen["main"] = window.busy(), window.texts("main")
    yield from window.picture("after")


def unwritable(window: Window, photos: str, folder: str) -> Walk:
    """Train into a project folder that cannot be written."""
    yield from begin(window, "artwork", photos)
    window.settings.folder = folder
    yield from window.wait(0.5)
    yield from window.click("snerg.train")
    yield from window.wait(2)
    window.seen["busy"], window.seen["main"] = window.busy(), window.texts("main")
    yield from window.picture("after")


def begin(window: Window, name: str, photos: str = "") -> Walk:
    """A saved file with the sidebar open, which trains on `photos`."""
    yield from window.file("save_as_mainfile", window.folder / f"{name}.blend")
    if photos:
        window.settings.dataset = photos
    yield from window.open_sidebar()


def send_frames(window: Window, url: str, blend: str) -> Walk:
    """Name a Manager in the preferences; its panel appears; send frames by its button and the dialog's Enter."""
    panel = bpy.types.SNERG_PT_farm
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()  # open: no script can open a panel
    bpy.utils.register_class(panel)
    yield from window.file("open_mainfile", Path(blend))
    addons = bpy.context.preferences.addons
    addon = next(addon for addon in addons if addon.module.endswith(".snerg_addon"))
    addon.preferences.flamenco_url = ""
    yield from window.open_sidebar()
    yield from window.wait(2)
    window.seen["without"] = panel.poll(bpy.context)
    addon.preferences.flamenco_url = url
    yield from window.over_view()
    window.seen["found"] = yield from window.until(lambda: panel.poll(bpy.context), 20)
    yield from window.picture("panel")
    yield from window.click("snerg.send_to_flamenco")
    yield from window.wait(1)
    window.shoot("dialog")
    yield from window.press("RET")
    window.seen["sent"] = yield from window.until(lambda: any("Sent" in text for text in window.texts("main")), 30)
    window.seen["texts"] = window.texts("farm") + window.texts("main")
    yield from window.picture("sent")
