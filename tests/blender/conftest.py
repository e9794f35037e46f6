"""Blender as a module in this process: one scene, emptied before each test, with the add-on registered."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def addon() -> Iterator[None]:
    """The add-on, registered from the source tree."""
    import snerg

    snerg.register()
    yield
    snerg.unregister()


@pytest.fixture
def preference(monkeypatch: pytest.MonkeyPatch, scene: Any) -> Any:
    """A function that gives a preference of the add-on a value: Blender as a module has no add-on preferences of a source tree."""
    from snerg.snerg_addon import preferences

    def choose(chosen: str, value: Any) -> None:
        monkeypatch.setattr(preferences, "_chosen", lambda name, otherwise: value if name == chosen else otherwise)

    return choose


@pytest.fixture
def scene(addon: None, tmp_path: Path) -> Any:
    """An empty scene with a white world and fast render settings, whose project is in the test's temporary folder."""
    emptied = (bpy.data.objects, bpy.data.collections, bpy.data.meshes, bpy.data.cameras, bpy.data.materials, bpy.data.lights)
    for things in (*emptied, bpy.data.images):
        for thing in list(things):
            things.remove(thing)
    for other in list(bpy.data.scenes)[1:]:
        bpy.data.scenes.remove(other)
    scene = bpy.context.scene
    names = [prop.identifier for prop in scene.snerg.bl_rna.properties]
    for name in names:
        if name not in ("rna_type", "name"):
            scene.snerg.property_unset(name)
    scene.snerg.folder = str(tmp_path / "project")
    render = scene.render
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    render.resolution_x, render.resolution_y, render.resolution_percentage = 32, 24, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.use_border = render.use_crop_to_border = False
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 1.0
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    return scene
