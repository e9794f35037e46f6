"""The sidebar's steps one by one, as they look at its default width. Runs inside Blender."""

from __future__ import annotations

import bpy
from drive import Walk, Window

STEPS = ("box", "dataset", "field", "bake", "preview", "study", "export")


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
    yield from each_step(window, "after")


def each_step(window: Window, when: str) -> Walk:
    """A picture of each step, opened alone."""
    for step in STEPS:
        for name in STEPS:
            setattr(bpy.context.window_manager.snerg_steps, name, name == step)
        yield from window.wait(0.3)
        yield from window.picture(f"{when}-{step}")
