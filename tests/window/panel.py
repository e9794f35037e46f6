"""The sidebar's steps one by one, as they look at its default width. Runs inside Blender."""

from __future__ import annotations

import math
import urllib.request
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import blf
import bpy
from drive import SIDEBAR_MARGIN, Walk, Window

STEPS = ("box", "dataset", "field", "bake", "preview", "study", "export")
UNDO_STEPS = 14  # more than the walk makes
F3_STEPS = (  # what is typed, the picture's name, and whether it starts a task
    ("snerg add box", "box", False),
    ("snerg render dataset", "dataset", True),
    ("snerg train field", "field", True),
    ("snerg fit box to field", "fitted", False),
    ("snerg bake", "bake", True),
    ("snerg export web page", "page", True),
    ("snerg open web page", "opened", False),
)


def steps_opened(window: Window, photos: str, trained: str) -> Walk:
    """Open each step alone: before anything is made, then with a dataset, a field and a baked scene."""
    yield from window.file("save_as_mainfile", window.folder / "artwork.blend")
    yield from window.open_sidebar()
    window.seen["width"] = window.sidebar.width
    yield from each_step(window, "before")
    window.settings.dataset = photos
    window.operator("import_field", filepath=trained)
    window.operator("add_box")
    window.settings.resolution, window.settings.cameras = 24, "RIG"
    window.operator("estimate")
    window.operator("bake")
    window.operator("bake")
    window.settings.train_background, window.settings.codec = "colour", "avif"
    window.settings.rig_distance, window.settings.train_background = 3, "colour"
    yield from window.wait(1.5)  # the step that comes next opens itself
    yield from each_step(window, "after")
    yield from scaled_live(window)
    window.seen["names"] = names_of(window)
    window.settings.cameras, window.settings.over_frames = "ALL", True
    window.seen["names"] += names_of(window)
    blf.size(0, bpy.context.preferences.ui_styles[0].widget.points * bpy.context.preferences.system.ui_scale)
    window.seen["cut"] = blf.dimensions(0, "View Dependence")[0]


def scaled_live(window: Window) -> Walk:
    """The bake step beside the box: before, and while the box is scaled with S."""
    for name in STEPS:
        setattr(bpy.context.window_manager.snerg_steps, name, name == "bake")
    window.window.view_layer.objects.active = window.settings.box
    window.settings.box.select_set(True)
    bpy.context.preferences.system.use_region_overlap = False  # else the box is seen through the sidebar
    yield from window.wait(0.5)
    window.seen["sidebar"] = [window.sidebar.x, window.sidebar.width]
    yield from window.picture("live-before")
    yield from window.press("S")
    yield from window.type("2")
    yield from window.wait(1)
    window.shoot("live-scaled")
    yield from window.press("ESC")
    yield from window.wait(0.5)


def each_step(window: Window, when: str) -> Walk:
    """A picture of each step, opened alone."""
    for step in STEPS:
        for name in STEPS:
            setattr(bpy.context.window_manager.snerg_steps, name, name == step)
        yield from window.wait(0.3)
        yield from window.picture(f"{when}-{step}")


def empty_to_page(window: Window) -> Walk:
    """From the file that Blender starts with to the page in the browser, by clicks and keys alone; then all of it undone and redone."""
    walk = Artist(window)
    quick(window, 48, 4)
    yield from walk.look("empty")
    yield from window.open_sidebar()
    yield from walk.look("sidebar")
    yield from walk.click("snerg.add_box")
    yield from walk.undone_and_redone("box")
    yield from walk.set_menu("snerg.cameras", "R")
    yield from walk.paste("snerg.rig_count", "12")
    yield from walk.undone_and_redone("rig")
    yield from walk.run("snerg.render_dataset", "dataset")
    yield from walk.paste("snerg.minutes", "0.1")
    yield from walk.run("snerg.train", "field")
    yield from walk.scale_twice()
    yield from walk.undone_and_redone("scaled")
    yield from walk.open("box")
    yield from walk.click("snerg.fit_box_to_field", SIDEBAR_MARGIN)
    yield from walk.undone_and_redone("fitted")
    yield from walk.open("bake")
    yield from walk.paste("snerg.resolution", "48")
    yield from walk.run("snerg.bake", "bake")
    yield from walk.undone_and_redone("baked")
    yield from walk.run("snerg.export_web", "page")
    yield from walk.click("snerg.open_page")
    yield from window.wait(1)
    yield from walk.look("opened")
    window.seen["page"] = page_of(window)
    yield from walk.all_undone_and_redone()
    window.seen["main"] = window.texts("main")


def quick(window: Window, size: int, samples: int) -> None:
    """Set the scene to render pictures of `size` pixels a side."""
    scene = window.window.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", samples, False
    scene.render.resolution_x = scene.render.resolution_y = size


def page_of(window: Window) -> str:
    """The first characters of the page that the browser was told to open."""
    server = import_module("bl_ext.user_default.snerg_addon.snerg_addon.page_server")
    with urllib.request.urlopen(server.address_of(project(window).web), timeout=20) as answer:
        return str(answer.read(200).decode())


def project(window: Window) -> Any:
    """The project of the scene that the window shows."""
    return import_module("bl_ext.user_default.snerg_addon.snerg_addon.project").project_of(window.window.scene)


def told(window: Window) -> Any:
    """What the panel says of the task that ended last."""
    return import_module("bl_ext.user_default.snerg_addon.snerg_addon.activity").last_report(project(window).folder)


class Artist:
    """Clicks and keys in the sidebar, with a numbered picture of each step, and what undo and redo make of it."""

    def __init__(self, window: Window) -> None:
        self.window, self.pictures = window, 0
        self.told: Any = None  # what the panel said of the task that ended last
        self.states = window.seen["states"] = {}
        system = bpy.context.preferences.system  # a software renderer draws the window a hundred times for each step
        system.viewport_aa, system.use_region_overlap = "OFF", False

    def look(self, name: str) -> Walk:
        """A picture of the window."""
        self.pictures += 1
        yield from self.window.picture(f"{self.pictures:02d}-{name}")

    def click(self, operator: str, from_right: int = 0) -> Walk:
        """Click a button of the steps that are open. from_right: where it does not begin at the left, as in Window.find."""
        yield from self.window.wait(1.5)  # the step that comes next opens itself
        yield from self.window.seek(f"bpy.ops.{operator}(", f"button for {operator}", from_right, ctrl=True)
        yield from self.window.press("LEFTMOUSE")
        yield from self.window.wait(0.5)

    def run(self, operator: str, name: str) -> Walk:
        """Click a button that starts a task, and wait until that has ended."""
        yield from self.click(operator)
        yield from self.ended(operator, name)

    def ended(self, operator: str, name: str) -> Walk:
        """Wait until the task that was started has ended."""
        started = yield from self.window.until(lambda: self.window.busy() or told(self.window) != self.told, 20)
        if self.window.busy():
            yield from self.window.wait(2)
            yield from self.look(f"{name}-runs")
        ended = yield from self.window.until(lambda: not self.window.busy(), 240)
        self.told = told(self.window)
        assert started and ended, f"{operator} started: {started}, ended: {ended}: {self.window.texts('main')}"
        yield from self.window.wait(1.5)
        yield from self.look(name)

    def scale_twice(self) -> Walk:
        """S, 2 and Enter over the view, where the box is selected."""
        yield from self.window.over_view()
        yield from self.window.press("S")
        yield from self.window.type("2")
        yield from self.window.press("RET")
        yield from self.window.wait(0.5)

    def search(self, words: str, name: str) -> Walk:
        """F3, words, and Enter."""
        yield from self.window.over_view()
        yield from self.window.press("F3")
        yield from self.window.wait(1)
        yield from self.window.type(words)
        yield from self.window.wait(1.5)
        self.window.shoot(f"{self.pictures + 1:02d}-{name}-f3")
        yield from self.window.press("RET")
        yield from self.window.wait(1)
        yield from self.look(name)

    def drop(self, path: str, name: str) -> Walk:
        """Drop a file into the view: the operator that Blender calls when the pointer lets go of it. Wait until it was imported."""
        view, file = self.window.view, Path(path)
        region = next(region for region in view.regions if region.type == "WINDOW")
        with bpy.context.temp_override(window=self.window.window, area=view, region=region):
            bpy.ops.wm.drop_import_file("INVOKE_DEFAULT", directory=f"{file.parent}/", files=[{"name": file.name}])
        yield from self.window.wait(1)
        yield from self.window.until(lambda: not self.window.busy(), 120)
        yield from self.window.wait(1.5)
        yield from self.look(name)

    def open(self, step: str) -> Walk:
        """Open a step alone."""
        for name in STEPS:
            setattr(bpy.context.window_manager.snerg_steps, name, name == step)
        yield from self.window.wait(0.3)

    def paste(self, path: str, value: str) -> Walk:
        """Ctrl-V over a setting."""
        yield from self.window.wait(1.5)
        yield from self.window.find_setting(path)
        bpy.context.window_manager.clipboard = value
        yield from self.window.press("V", ctrl=True)
        yield from self.window.wait(0.3)

    def set_menu(self, path: str, key: str) -> Walk:
        """Click a menu, and press the key of an entry."""
        yield from self.window.wait(1.5)
        yield from self.window.find_setting(path)
        yield from self.window.press("LEFTMOUSE")
        yield from self.window.wait(0.5)
        yield from self.window.press(key)
        yield from self.window.wait(0.5)

    def undone_and_redone(self, name: str) -> Walk:
        """Ctrl-Z and Shift-Ctrl-Z over the view, and the state before and after each; a picture at the end."""
        states = [self.state()]
        for shift in (False, True):
            yield from self.window.over_view()
            yield from self.window.press("Z", ctrl=True, shift=shift)
            yield from self.window.wait(0.5)
            states.append(self.state())
        self.states[name] = states
        yield from self.look(name)

    def all_undone_and_redone(self) -> Walk:
        """Ctrl-Z until nothing is left to undo, then Shift-Ctrl-Z as often."""
        states = [self.state()]
        for shift in (False, True):
            yield from self.window.over_view()
            for _ in range(UNDO_STEPS):
                yield from self.window.press("Z", ctrl=True, shift=shift)
                yield from self.window.wait(0.3)
            states.append(self.state())
            yield from self.look("all-redone" if shift else "all-undone")
        self.states["all"] = states

    def state(self) -> list[Any]:
        """The box's width, the cameras, how many, the voxels, the baked objects, and whether the project has each result."""
        settings, scene = self.window.settings, self.window.window.scene
        box = settings.box if settings.box and settings.box.name in scene.objects else None
        baked = sum(bool(thing.snerg.folder) for thing in scene.objects)
        has = [step for step in ("dataset", "field", "scene", "web") if project(self.window).has(step)]
        width = round(2 * box.empty_display_size * box.matrix_world.to_scale().x, 3) if box else None
        return [width, settings.cameras, settings.rig_count, settings.resolution, baked, has]


def found_by_f3(window: Window) -> Walk:
    """From a scene with cameras to the page, by Blender's search alone."""
    walk = Artist(window)
    quick(window, 48, 4)
    ring(window.window.scene, 10)
    window.settings.minutes, window.settings.resolution = 0.1, 48
    yield from walk.look("scene")
    for words, name, is_task in F3_STEPS:
        yield from walk.search(words, name)
        if is_task:
            yield from walk.ended(words, name)
    window.seen["page"], window.seen["state"] = page_of(window), walk.state()
    yield from window.open_sidebar()
    yield from walk.look("end")


def ring(scene: Any, count: int) -> None:
    """Cameras round the scene's cube, which they look at."""
    for index in range(count):
        camera = bpy.data.objects.new(f"Camera {index}", bpy.data.cameras.new(f"Camera {index}"))
        scene.collection.objects.link(camera)
        angle = 2 * math.pi * index / count
        camera.location = 7 * math.cos(angle), 7 * math.sin(angle), 2 + 2 * (index % 3)
        camera.rotation_euler = (-camera.location).to_track_quat("-Z", "Y").to_euler()


def dropped(window: Window, photos: str, trained: str, baked: str) -> Walk:
    """A dataset, a field and a baked scene dropped into the view, then the page; and files that are none of these."""
    walk = Artist(window)
    yield from window.open_sidebar()
    for path, name in ((photos, "dataset"), (trained, "field"), (baked, "scene")):
        yield from walk.drop(path, name)
        window.seen[name] = window.texts("main")
    window.seen["state"] = walk.state()
    yield from walk.run("snerg.export_web", "page")
    window.seen["page"] = page_of(window)


class Names:
    """Stands in for Blender's layout, and measures the names that it is given, in pixels of Blender's interface."""

    def __init__(self, found: list[tuple[str, str]], split: bool = False, width: float = 1.0) -> None:
        self.__dict__.update(found=found, use_property_split=split, share=width)

    def __getattr__(self, kind: str) -> Any:
        if kind.startswith("__"):
            raise AttributeError(kind)
        return lambda *values, **keywords: self._put(kind, values, keywords)

    def _put(self, kind: str, values: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        """Take note of a name, or give a layout within this one."""
        if kind in ("panel", "panel_prop"):
            return Names(self.found), Names(self.found, self.use_property_split)
        if kind in ("prop", "prop_search"):
            owner = values[0].bl_rna.properties[values[1]]
            name = keywords.get("text", owner.name)
            split = self.use_property_split and owner.type != "BOOLEAN"
            self.found.append(("setting" if split else "check box" if owner.type == "BOOLEAN" else "line", name))
        elif kind == "operator":
            module, _, operator = values[0].partition(".")
            name = keywords.get("text") or getattr(getattr(bpy.ops, module), operator).get_rna_type().name
            self.found.append(("button", name))
            return SimpleNamespace()
        elif kind == "label":
            self.found.append(("line", keywords.get("text", "")))
        return Names(self.found, self.use_property_split)


def names_of(window: Window) -> list[tuple[str, str, float]]:
    """(kind, name, its width in pixels) of all settings and buttons that the steps show now."""
    found: list[tuple[str, str]] = []
    steps = import_module("bl_ext.user_default.snerg_addon.snerg_addon.panels.main").STEPS
    with bpy.context.temp_override(window=window.window):
        for step in steps:
            step.draw_body(Names(found), bpy.context)
    blf.size(0, bpy.context.preferences.ui_styles[0].widget.points * bpy.context.preferences.system.ui_scale)
    return [(kind, name, blf.dimensions(0, name)[0]) for kind, name in dict.fromkeys(found) if name]
