"""SNeRG objects in the viewports, marched on the graphics card: coarse while the view moves, then refined; before and behind meshes.

What the card does not march (forward-facing scenes, and scenes that it refuses) the processor does, more slowly (slow.py).
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass, replace
from typing import Any

import bpy
import gpu
import numpy as np

from ...core.errors import SnergError
from ...core.scene.scene import Scene
from ..scene_object import UNEVEN, box_corners, placed_camera, source_of
from . import card
from .gpu_scene import PIXEL_BYTES, GpuScene, Target
from .instances import Shown, shown_in
from .loading import loaded, reading
from .picture import Picture, lay, restore, show, work
from .slow import SlowPicture, View
from .view import Part, Projection, camera_of, even_scale, screen_part, uniforms

LATER = 0.05  # seconds between two looks for what is still to be drawn
SWEEP = 2.0  # seconds between two looks for regions that were closed
EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))  # of Box.corners

_handle: Any = None


@dataclass(frozen=True, eq=False)
class Region:
    """The region that is being drawn: its address, its pixels, and its view."""

    address: int
    width: int
    height: int
    camera: np.ndarray  # [4, 4], to the world
    projection: Projection

    @classmethod
    def of(cls, context: bpy.types.Context) -> Region:
        """Of the context of a draw handler."""
        region, data = context.region, context.region_data
        camera = np.linalg.inv(np.array(data.view_matrix, np.float64))
        projection = Projection.from_matrix(np.array(data.window_matrix))
        return cls(region.as_pointer(), region.width, region.height, camera, projection)


def register() -> None:
    """Draw in every viewport from here on."""
    global _handle
    if _handle is None and not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")
        bpy.app.handlers.load_pre.append(clear)


def unregister() -> None:
    """Draw no more, and let go of the card's memory."""
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        bpy.app.handlers.load_pre.remove(clear)
    _handle = None
    for timer in (_redraw, _sweep):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    card.clear()


@bpy.app.handlers.persistent
def clear(*_arguments: object) -> None:
    """Let go of all scenes and pictures: another file is opened."""
    card.clear()


def works() -> bool:
    """Whether the viewport draws SNeRG objects: not without a window."""
    return _handle is not None


def draw() -> None:
    """Every SNeRG object that the region shows, the farthest first. An error is the one object's: the others are drawn."""
    context = bpy.context
    try:
        things, region = list(shown_in(context)), Region.of(context)
        things.sort(key=lambda one: -float(np.linalg.norm(one.matrix[:3, 3] - region.camera[:3, 3])))
        card.forget_hidden(region.address, {(region.address, *one.place) for one in things})
        overlays = context.space_data.overlay.show_overlays
        done = [draw_one(region, one, overlays) for one in things]
        if not all(done):
            _later()
        if things and not bpy.app.timers.is_registered(_sweep):
            bpy.app.timers.register(_sweep, first_interval=SWEEP)
    except Exception as error:  # not of an object: it would come again at every redraw
        traceback.print_exception(error)
        unregister()


def draw_one(region: Region, one: Shown, overlays: bool) -> bool:
    """One object: its picture, and its box where it is selected. Returns whether there is nothing more to come of it."""
    place = (region.address, *one.place)
    if one.selected and overlays:
        outline(one)
    try:
        found = loaded(source_of(one.thing))
    except SnergError:
        return True  # its panel says it
    if found.scene is None:
        return bool(found.problem)
    if even_scale(one.matrix) is None:
        card.drop(place)
        card.said[place] = UNEVEN.format(one.thing.name)
        return True
    bound = gpu.state.viewport_get()
    try:
        on_card = card.held(found.scene) if found.scene.ndc is None else None
        return draw_slowly(region, one, found.scene, place) if on_card is None else draw_fast(region, one, on_card, place)
    except Exception as error:
        card.drop(place)
        if id(found.scene) in card.refused:  # the processor's picture failed too
            card.said[place] = f"The viewport does not draw it ({error}); F12 works."
            return True
        card.refuse(found.scene, error)
        return False
    finally:
        gpu.state.viewport_set(*bound)
        restore()


def draw_fast(region: Region, one: Shown, held: GpuScene, place: card.Place) -> bool:
    """By the graphics card."""
    card.drop_slow(place)
    part = screen_part(held.scene, one.matrix, region.camera, region.projection, (region.width, region.height))
    if not part.pixels:
        card.drop(place)
        return True
    picture = card.pictures.get(place)
    if picture is None or picture.full.size != (region.width, region.height):
        card.drop(place)
        if not has_room(region, place):
            return True
        picture = card.pictures[place] = Picture(Target(region.width, region.height))
    card.said.pop(place, None)
    bound = gpu.state.viewport_get()
    work(held, uniforms(held.scene, one.matrix, region.camera, region.projection), picture, part)
    gpu.state.viewport_set(*bound)
    show(picture, region.projection, one.holdout)
    return picture.done


def draw_slowly(region: Region, one: Shown, scene: Scene, place: card.Place) -> bool:
    """By the processor: what the thread has so far."""
    card.pictures.pop(place, None)
    if place not in card.slow and not has_room(region, place):
        return True
    picture, target = card.slow.get(place) or (SlowPicture(), None)
    card.slow[place] = picture, target
    picture.ask(view_of(region, one, scene))
    done = picture.done  # before the last picture is taken
    if (taken := picture.take()) is not None:
        target = Target.of(*taken)
        card.slow[place] = picture, target
    if target is not None:
        lay(target, Part(0, 0, region.width, region.height), region.projection, one.holdout)
    card.said[place] = picture.problem or why_slow(scene)
    return done


def why_slow(scene: Scene) -> str:
    """Why the processor draws a scene, one sentence; '' for a forward-facing one, of which the panel says it."""
    if scene.ndc is not None:
        return ""
    return card.refused[id(scene)][1] if id(scene) in card.refused else card.NO_ROOM


def has_room(region: Region, place: card.Place) -> bool:
    """Whether a picture of the region's size, and a draft of half as many pixels, have room; else that is said."""
    if card.room_for(PIXEL_BYTES * region.width * region.height * 3 // 2):
        return True
    card.said[place] = card.NO_PICTURE
    return False


def view_of(region: Region, one: Shown, scene: Scene) -> View:
    """What the processor is to draw. Raises SnergError where no Camera sees so."""
    camera, back = camera_of(region.projection, region.camera, region.width, region.height)
    camera = replace(camera, near=max(region.projection.near + back, 0.0), far=region.projection.far + back)
    moved, scale = placed_camera(one.thing.name, scene, one.matrix, camera)
    key = b"".join(v.tobytes() for v in (one.matrix, region.camera, region.projection.matrix)) + id(scene).to_bytes(8, "little")
    key += bytes(f"{region.width} {region.height}", "ascii")
    return View(key, scene, moved, scale, -back / scale)


def outline(one: Shown) -> None:
    """The edges of the box that was baked."""
    from gpu_extras.batch import batch_for_shader

    corners = box_corners(one.thing, one.matrix)
    if corners is None:
        return
    lines = gpu.shader.from_builtin("UNIFORM_COLOR")
    points = [tuple(corners[i]) for edge in EDGES for i in edge]
    gpu.state.depth_test_set("LESS_EQUAL")
    lines.bind()
    lines.uniform_float("color", (*bpy.context.preferences.themes[0].view_3d.object_selected, 1.0))
    batch_for_shader(lines, "LINES", {"pos": points}).draw(lines)
    gpu.state.depth_test_set("NONE")


def _later() -> None:
    """Redraw the viewports soon: a scene is being read, or a picture is not done."""
    if not bpy.app.timers.is_registered(_redraw):
        bpy.app.timers.register(_redraw, first_interval=LATER if reading() or card.slow else 0.001)


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _sweep() -> float | None:
    """Let go of what regions held that are closed, where no viewport is drawn any more too."""
    card.forget_closed(bpy.context.window_manager)
    return SWEEP if card.pictures or card.slow or card.said else None
