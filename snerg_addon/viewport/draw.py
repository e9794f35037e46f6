"""SNeRG objects in the viewports, marched on the graphics card: coarse while the view moves, then refined; before and behind meshes."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import gpu
import numpy as np

from ...core.errors import SnergError
from ...core.scene.scene import Scene
from ..preferences import gpu_bytes
from ..scene_object import box_corners, problem_of, snerg_objects, source_of
from . import shader
from .gpu_scene import GpuScene, Target, bytes_of, march, triangle
from .loading import forget, in_use, keep, loaded, reading
from .view import Part, Projection, screen_part, uniforms

BUDGET = 0.03  # seconds of marching at a time
SETTLE = 0.12  # seconds without change after which a view counts as still
COARSEST = 8  # times smaller, each way, that the picture of a moving view may be
LATER = 0.05  # seconds between two looks for what is still to be drawn
EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))  # of Box.corners

_handle: Any = None
_composite: gpu.types.GPUShader | None = None
_scenes: dict[int, GpuScene] = {}  # by the identity of the scene, which they hold
_pictures: dict[tuple[int, int], Picture] = {}  # by region and object


@dataclass
class Picture:
    """An object as one region sees it. full: marched whole, `rows` of the part in which the object is so far, from the
    top; draft: what is shown until then."""

    full: Target
    key: bytes = b""
    draft: Target | None = None
    part: Part = Part(0, 0, 0, 0)  # of the picture, in which the object is
    rows: int = 0
    changed: float = 0.0
    pixel: float = 0.0  # seconds, as measured; 0: not yet

    @property
    def done(self) -> bool:
        """Whether the whole picture is there."""
        return self.rows >= self.part.height


def register() -> None:
    """Draw in every viewport from here on."""
    global _handle
    if _handle is None and not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")
        bpy.app.handlers.load_pre.append(clear)


def unregister() -> None:
    """Draw no more, and let go of the card's memory."""
    global _handle, _composite
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        bpy.app.handlers.load_pre.remove(clear)
    _handle = _composite = None
    clear()


@bpy.app.handlers.persistent
def clear(*_arguments: object) -> None:
    """Let go of all scenes and pictures: another file is opened, or the add-on is disabled."""
    _pictures.clear()
    _scenes.clear()
    forget()


def works() -> bool:
    """Whether the viewport draws SNeRG objects; False after an error, and without a window."""
    return _handle is not None


def memory() -> int:
    """Bytes of the card's memory that scenes take."""
    return sum(held.bytes for held in _scenes.values())


def draw() -> None:
    """Every visible SNeRG object of the region that is being drawn, the farthest first. After an error nothing is drawn any more: it would
    come again at every redraw."""
    context = bpy.context
    try:
        shown = [thing for thing in snerg_objects(context.view_layer) if thing.visible_in_viewport_get(context.space_data)]
        eye = context.region_data.view_matrix.inverted().translation
        drawn = [draw_object(context, o) for o in sorted(shown, key=lambda o: -(o.matrix_world.translation - eye).length)]
        if not all(drawn) or reading():
            _later()
        _forget_closed(context.window_manager)
    except Exception as error:
        traceback.print_exception(error)
        unregister()


def draw_object(context: bpy.types.Context, thing: bpy.types.Object) -> bool:
    """One object: its picture, and its box where it is selected. Returns whether there is nothing more to come of it."""
    if thing.select_get():
        outline(thing)
    try:
        found = loaded(source_of(thing))
    except SnergError:
        return True  # its panel says it
    if found.scene is None:
        return bool(found.problem)
    matrix = np.array(thing.matrix_world, np.float64)
    if problem_of(thing) or found.scene.ndc is not None or (held := _held(found.scene)) is None:
        return True
    region, data = context.region, context.region_data
    projection = Projection.from_matrix(np.array(data.window_matrix))
    camera = np.linalg.inv(np.array(data.view_matrix, np.float64))
    seen = uniforms(found.scene, matrix, camera, projection)
    part = screen_part(found.scene, matrix, camera, projection, (region.width, region.height))
    place = region.as_pointer(), thing.session_uid
    picture = _pictures.get(place)
    if picture is None or picture.full.size != (region.width, region.height):
        picture = _pictures[place] = Picture(Target(region.width, region.height))
    bound = gpu.state.viewport_get()
    work(held, seen, picture, part)
    gpu.state.viewport_set(*bound)
    show(picture, projection)
    return picture.done


def _forget_closed(manager: bpy.types.WindowManager) -> None:
    """Let go of pictures of regions that are closed and of objects that are gone."""
    regions = {region.as_pointer() for window in manager.windows for area in window.screen.areas for region in area.regions}
    objects = {thing.session_uid for thing in bpy.data.objects}
    for place in [place for place in _pictures if place[0] not in regions or place[1] not in objects]:
        del _pictures[place]


def _held(scene: Scene) -> GpuScene | None:
    """A scene on the graphics card; None where the preferences leave no room for it, once scenes that nothing shows any more are let go."""
    held = _scenes.get(id(scene))
    if held is None:
        keep({folder for thing in snerg_objects(bpy.data) for folder in shown_from(thing)})
        for key in [key for key, other in _scenes.items() if not in_use(other.scene)]:
            del _scenes[key]
        if not fits(scene):
            return None
        held = _scenes[id(scene)] = GpuScene(scene)
    return held


def shown_from(thing: bpy.types.Object) -> list[Path]:
    """The folder that an object's scene is read from; none where its packed scene is damaged."""
    try:
        return [source_of(thing)]
    except SnergError:
        return []


def fits(scene: Scene) -> bool:
    """Whether a scene is on the graphics card, or there is room for it by the preferences."""
    return id(scene) in _scenes or memory() + bytes_of(scene) <= gpu_bytes()


def work(held: GpuScene, seen: np.ndarray, picture: Picture, part: Part) -> None:
    """March as much of the part of a picture in which the object is as BUDGET allows: all of it where that is quick; else a coarse one,
    and once the view rests the full one, a band of rows at a time."""
    now, (width, height) = time.monotonic(), picture.full.size
    if picture.key != (key := seen.tobytes() + held.number.to_bytes(8, "little")):
        picture.key, picture.part, picture.rows, picture.changed = key, part, 0, now
        if not part.pixels:
            picture.rows = part.height
            return
        affordable = BUDGET / (picture.pixel * part.pixels) if picture.pixel else 0.0
        if affordable >= 0.8:
            picture.rows = part.height
            _timed(held, seen, picture, picture.full, part)
            return
        scale = 2.0 ** max(-np.log2(COARSEST), np.floor(np.log2(max(affordable, 1e-9))) / 2)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        if picture.draft is None or picture.draft.size != size:
            picture.draft = Target(*size)
        _timed(held, seen, picture, picture.draft, part.scaled(picture.full.size, size))
    elif not picture.done and now - picture.changed > SETTLE:
        left = part.height - picture.rows
        count = min(left, max(left // 8, 8, int(BUDGET / (max(picture.pixel, 1e-12) * part.width))))
        _timed(held, seen, picture, picture.full, part.rows(picture.rows, count))
        picture.rows += count


def _timed(held: GpuScene, seen: np.ndarray, picture: Picture, target: Target, part: Part) -> None:
    """March a part of a target, and learn what a pixel takes."""
    began = time.perf_counter()
    march(held, seen, target, part)
    target.wait()
    cost = (time.perf_counter() - began) / part.pixels
    picture.pixel = cost if not picture.pixel or cost < picture.pixel else 0.5 * (cost + picture.pixel)


def show(picture: Picture, projection: Projection) -> None:
    """The picture into the viewport: the rows that are marched in full, and the draft's below them."""
    global _composite
    if _composite is None:
        _composite = shader.composite_shader()
    part, rows = picture.part, picture.rows
    p = projection.matrix
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.scissor_test_set(True)
    left, bottom = gpu.state.viewport_get()[:2]
    for target, shown in ((picture.full, part.rows(0, rows)), (picture.draft, part.rows(rows, part.height - rows))):
        if target is None or not shown.pixels:
            continue
        gpu.state.scissor_set(left + shown.left, bottom + shown.bottom, shown.width, shown.height)
        _composite.bind()
        _composite.uniform_float("projection", (p[2, 2], p[2, 3], p[3, 2], p[3, 3]))
        _composite.uniform_sampler("picture", target.picture)
        _composite.uniform_sampler("depths", target.depths)
        triangle().draw(_composite)
    gpu.state.scissor_test_set(False)
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.blend_set("NONE")


def outline(thing: bpy.types.Object) -> None:
    """The edges of the box that was baked."""
    from gpu_extras.batch import batch_for_shader

    corners = box_corners(thing)
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
        bpy.app.timers.register(_redraw, first_interval=LATER if reading() else 0.001)


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
