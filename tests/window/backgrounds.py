"""The walk of photographs that EXIF turns: what is seen through their cameras, and what the panel says of the dataset."""

from __future__ import annotations

import bpy
from drive import Walk, Window


def turned(window: Window, photos: str) -> Walk:
    """Import the dataset, look through its first camera, and open the panel."""
    yield from window.file("save_as_mainfile", window.folder / "turned.blend")
    yield from window.open_sidebar()
    bpy.data.objects.remove(bpy.data.objects["Cube"])  # it would hide the photograph
    window.operator("import_dataset", filepath=photos)
    yield from window.wait(1)
    view, scene = window.view, window.window.scene
    view.spaces.active.region_3d.view_perspective = "CAMERA"
    view.spaces.active.overlay.show_extras = False
    yield from window.open_steps()
    yield from window.wait(1)
    scene.render.filepath = str(window.folder / "seen.png")
    region = next(region for region in view.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window.window, area=view, region=region):
        bpy.ops.render.opengl(write_still=True, view_context=True)
    window.seen["dataset"] = window.texts("dataset")
    yield from window.picture("imported")
