"""The camera's move in the export step, and in the page that it is exported with. Runs inside Blender."""

from __future__ import annotations

import json
import math
import time
import urllib.request
from importlib import import_module
from pathlib import Path

import bpy
from drive import Walk, Window


def camera_move(window: Window, baked: str) -> Walk:
    """Look at the export step with a camera at rest, then with one that turns round the scene; count, and export by clicks."""
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    yield from window.open_sidebar()
    window.operator("import_scene", filepath=baked)
    yield from window.wait(1.5)
    for name in ("box", "dataset", "field", "bake", "preview", "study", "export"):
        setattr(bpy.context.window_manager.snerg_steps, name, name == "export")
    window.seen["still"] = window.texts("export")
    yield from window.picture("still")
    scene = window.window.scene
    parent = bpy.data.objects.new("Turntable", None)
    scene.collection.objects.link(parent)
    scene.camera.parent = parent
    scene.frame_start, scene.frame_end = 1, 60
    for frame, angle in ((1, 0.0), (61, 2 * math.pi)):
        parent.rotation_euler.z = angle
        parent.keyframe_insert("rotation_euler", frame=frame)
    scene.frame_set(20)
    yield from window.wait(0.5)
    window.seen["moving"] = window.texts("export")
    yield from window.picture("moving")
    yield from stop_counting(window)
    yield from press(window, "snerg.count_keyframes")
    yield from window.until(lambda: any("keyframes, " in text for text in window.texts("export")), 20)
    window.seen["counted"], window.seen["frame"] = window.texts("export"), scene.frame_current
    yield from window.picture("counted")
    yield from press(window, "snerg.export_web")
    project = import_module("bl_ext.user_default.snerg_addon.snerg_addon.project").project_of
    yield from window.until(lambda: project(window.window.scene).has("web") and not window.busy(), 60)
    yield from window.picture("exported")
    web = Path(project(window.window.scene).web)
    window.seen["files"] = sorted(path.name for path in web.iterdir())
    window.seen["path"] = json.loads((web / "path.json").read_text())
    window.operator("open_page")
    address = import_module("bl_ext.user_default.snerg_addon.snerg_addon.page_server").address_of(web)
    window.seen["script"] = urllib.request.urlopen(f"{address}optional/path.js").read(200).decode()


def stop_counting(window: Window) -> Walk:
    """Esc while frames are evaluated, of which a driver makes each slow."""
    scene = window.window.scene
    bpy.app.driver_namespace["slow"] = lambda: time.sleep(0.1) or 0.0
    scene.camera.driver_add("delta_location", 0).driver.expression = "slow() + 0 * frame"
    running = lambda: [operator.bl_idname for operator in window.window.modal_operators]  # noqa: E731
    yield from press(window, "snerg.count_keyframes")
    window.seen["counting"] = yield from window.until(running, 20)
    yield from window.wait(1.0)
    yield from window.picture("counting")
    began = time.monotonic()
    yield from window.press("ESC")
    yield from window.until(lambda: not running(), 20)
    window.seen["stopped after"] = time.monotonic() - began
    window.seen["stopped"], window.seen["stopped at"] = window.texts("export"), scene.frame_current
    scene.camera.driver_remove("delta_location", 0)
    yield from window.wait(0.5)


def press(window: Window, operator: str) -> Walk:
    """Click a button of the step that is open: quicker than to look for it in all of them."""
    yield from window.seek(f"bpy.ops.{operator}(", f"button for {operator}", ctrl=True)
    yield from window.press("LEFTMOUSE")
