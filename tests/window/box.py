"""The box's arrows, its voxels and the rig's cameras in the viewport. Runs inside Blender."""

from __future__ import annotations

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from drive import Walk, Window


def box_handles(window: Window) -> Walk:
    """Drag the arrow of the face +X outwards, undo and redo; drag it and press Esc; show the voxels and the rig."""
    for thing in [thing for thing in bpy.data.objects if thing.type != "MESH"]:
        bpy.data.objects.remove(thing)
    yield from window.open_sidebar()
    yield from window.click("snerg.add_box")
    region, data3d = next(r for r in window.view.regions if r.type == "WINDOW"), window.view.spaces[0].region_3d
    data3d.view_rotation, data3d.view_location, data3d.view_distance = (0.8, 0.4, 0.2, 0.4), (0, 0, 0), 12
    data3d.view_perspective = "PERSP"
    yield from window.wait(1)
    sizes = window.seen["sizes"] = [size(window)]

    def on_screen(x: float) -> tuple[float, float]:
        at = location_3d_to_region_2d(region, data3d, (x, 0, 0))
        return region.x + at.x, region.y + at.y

    def drag(end: str) -> Walk:
        face = sizes[-1] / 2 if len(sizes) == 1 else window.settings.box.matrix_world.translation.x + size(window) / 2
        yield from window.move(*on_screen(face + 0.15))
        yield from window.wait(0.3)
        window.send("LEFTMOUSE", "PRESS")
        yield
        for part in range(1, 6):
            yield from window.move(*on_screen(face + 0.15 + part / 5))
        window.shoot(f"drag-{end}")
        window.send("ESC" if end == "esc" else "LEFTMOUSE", "PRESS" if end == "esc" else "RELEASE")
        yield
        if end == "esc":
            window.send("LEFTMOUSE", "RELEASE")
        yield from window.wait(0.3)
        sizes.append(size(window))

    yield from drag("release")
    yield from window.press("Z", ctrl=True)
    yield from window.wait(0.3)
    sizes.append(size(window))
    yield from window.press("Z", ctrl=True, shift=True)
    yield from window.wait(0.3)
    sizes.append(size(window))
    yield from drag("esc")
    window.settings.show_voxels, window.settings.resolution, window.settings.cameras, window.settings.rig_count = True, 32, "RIG", 24
    yield from window.picture("overlay")


def size(window: Window) -> float:
    """The box's side along x."""
    box = window.settings.box
    return float(2 * box.empty_display_size * box.matrix_world.to_scale().x)
