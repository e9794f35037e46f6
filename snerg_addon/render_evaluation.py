"""The evaluated scene as a render sees it, read without rendering a picture.

The viewport's evaluation lacks what is hidden there, has the viewport's modifiers, and keeps changes without a key. This one is made
by Blender's render pipeline, with the engine of engine.py, which hands the dependency graph over instead of rendering it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import bpy

from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from .bridge import box_from_blender, camera_from_blender

T = TypeVar("T")
SetFrame: TypeAlias = Callable[[int, float], None]  # (frame, subframe): evaluates the dependency graph there
_readers: dict[str, Callable[[bpy.types.Depsgraph, SetFrame], None]] = {}  # by the name of the scene that is to be read


class SNERG_RE_evaluation(bpy.types.RenderEngine):
    """Hands the dependency graph over in a process of its own, where the add-on is not registered. It renders nothing."""

    bl_idname = "SNERG_EVALUATION"
    bl_label = "SNeRG Evaluation"

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """One view layer of one frame."""
        hand_over(depsgraph, self.frame_set)


def engine() -> str:
    """The engine that hands dependency graphs over to this module: that of engine.py where it is registered."""
    found = bpy.types.RenderEngine.bl_rna_get_subclass_py("SNERG_RE_engine")
    if found is not None and found.__module__ == f"{__package__}.engine":
        return "SNERG"
    if not SNERG_RE_evaluation.is_registered:
        bpy.utils.register_class(SNERG_RE_evaluation)
    return SNERG_RE_evaluation.bl_idname


def hand_over(depsgraph: bpy.types.Depsgraph, set_frame: SetFrame) -> bool:
    """Give a dependency graph to the `evaluate_render` that waits for it. False: none does, it is to be rendered."""
    reader = _readers.get(depsgraph.scene.name)
    if reader is not None:
        reader(depsgraph, set_frame)
    return reader is not None


def evaluate_render(
    scene: bpy.types.Scene,
    read: Callable[[bpy.types.Depsgraph], T],
    needed: Sequence[bpy.types.Object] = (),
    frame: int | None = None,
    layer: str = "",
) -> T:
    """What `read` returns for the dependency graph (mode RENDER) of a view layer.

    needed: objects that are evaluated even if they are hidden or excluded. frame: by default the scene's own, with its subframe.
    layer: name of the view layer; empty for the first.
    The scene and its objects keep changes without a key. Raises SnergError where Blender cannot evaluate it, and what `read` raises.
    """
    return _evaluate(scene, lambda depsgraph, _: read(depsgraph), needed, frame, layer)


def evaluate_frames(
    scene: bpy.types.Scene,
    frames: Sequence[int],
    read: Callable[[bpy.types.Depsgraph, int], T],
    needed: Sequence[bpy.types.Object] = (),
    seconds: float = math.inf,
    alone: bool = False,
) -> list[T]:
    """What `read` returns for each of some frames, in one evaluation, which redoes only what changes; else as `evaluate_render`.

    seconds: after which it stops; the rest of the frames are left out, but not the first. alone: whether only `needed` is evaluated, with
    all that it depends on. Simulations without a baked cache need the whole scene, which holds what they collide with.
    """

    def read_all(depsgraph: bpy.types.Depsgraph, set_frame: SetFrame) -> list[T]:
        found: list[T] = []
        until = time.monotonic() + seconds
        for frame in frames:
            if found:  # the first is evaluated already
                if time.monotonic() > until:
                    break
                set_frame(frame, 0.0)
            found.append(read(depsgraph, frame))
        return found

    return _evaluate(scene, read_all, needed, frames[0], "", alone)


def _evaluate(
    scene: bpy.types.Scene,
    read: Callable[[bpy.types.Depsgraph, SetFrame], T],
    needed: Sequence[bpy.types.Object],
    frame: int | None,
    layer: str,
    alone: bool = False,
) -> T:
    """See `evaluate_render` and `evaluate_frames`."""
    found: list[T] = []
    failed: list[Exception] = []

    def reader(depsgraph: bpy.types.Depsgraph, set_frame: SetFrame) -> None:
        try:
            found.append(read(depsgraph, set_frame))
        except Exception as error:  # it would be lost in Blender's render pipeline
            failed.append(error)

    with linked_copy(scene, frame) as copy, temporary_camera() as camera:
        keep_layer(copy, layer)
        if alone:
            unlink_all(copy)
        depend_on(camera, needed)
        copy.collection.objects.link(camera)
        copy.camera, copy.render.engine = camera, engine()
        copy.render.use_compositing = copy.render.use_sequencer = copy.render.use_multiview = copy.render.use_motion_blur = False
        copy.render.use_border = False
        _readers[copy.name] = reader
        try:
            render(copy)
        except RuntimeError as error:
            raise SnergError(
                f"Blender could not evaluate the scene {scene.name!r} ({str(error).strip()}); render it to see why."
            ) from error
        finally:
            del _readers[copy.name]
    if failed:
        raise failed[0]
    if not found:
        raise SnergError(f"Blender did not evaluate the scene {scene.name!r}; render it once by hand to see why.")
    return found[0]


def evaluated_cameras(scene: bpy.types.Scene, cameras: Sequence[bpy.types.Object], frame: int | None = None) -> list[Camera]:
    """The cameras as a render of the scene at a frame uses them. Raises SnergError, see `camera_from_blender`."""
    if not cameras:
        return []

    def read(depsgraph: bpy.types.Depsgraph) -> list[Camera]:
        return [camera_from_blender(camera, scene, depsgraph) for camera in cameras]

    return evaluate_render(scene, read, cameras, frame)


def evaluated_box(scene: bpy.types.Scene, box: bpy.types.Object | None) -> Box:
    """The box at the scene's frame, hidden or not. Raises SnergError, see `box_from_blender`."""
    if box is None or box.type != "EMPTY":
        return box_from_blender(box)
    return evaluate_render(scene, lambda depsgraph: box_from_blender(box, depsgraph), [box])


@contextmanager
def linked_copy(scene: bpy.types.Scene, frame: int | None = None) -> Iterator[bpy.types.Scene]:
    """A linked copy of the scene with one view layer and without camera markers, at `frame` (default: the scene's own)."""
    copy, camera = scene.copy(), scene.camera
    try:
        copy.render.use_persistent_data = False  # the engine would stay, and meet the next scene that Blender puts at the same address
        copy.timeline_markers.clear()  # markers can bind another camera to the frame
        if frame is not None:
            copy.frame_current, copy.frame_subframe = frame, 0.0
        yield copy
    finally:
        scene.camera = camera  # rendering sets every scene to its frame, where a marker may have chosen another camera
        bpy.data.scenes.remove(copy)


def keep_layer(scene: bpy.types.Scene, name: str) -> None:
    """Remove all view layers but one. name: empty for the first. Raises SnergError where there is no such layer."""
    kept = scene.view_layers.get(name) if name else scene.view_layers[0]
    if kept is None:
        there = ", ".join(layer.name for layer in scene.view_layers)
        raise SnergError(f"The scene has no view layer {name!r}; choose one of its own: {there}.")
    for layer in [layer for layer in scene.view_layers if layer != kept]:
        scene.view_layers.remove(layer)
    scene.view_layers[0].use = True


def unlink_all(scene: bpy.types.Scene) -> None:
    """Leave a copy of a scene without objects."""
    for thing in list(scene.collection.objects):
        scene.collection.objects.unlink(thing)
    for collection in list(scene.collection.children):
        scene.collection.children.unlink(collection)


@contextmanager
def temporary_camera() -> Iterator[bpy.types.Object]:
    """A camera object in no scene, deleted at the end."""
    data = bpy.data.cameras.new("SNeRG Rig")
    camera = bpy.data.objects.new("SNeRG Rig", data)
    try:
        yield camera
    finally:
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)


def depend_on(camera: bpy.types.Object, needed: Sequence[bpy.types.Object]) -> None:
    """Make a camera depend on the poses of objects and on the settings of cameras, so that a render evaluates them first."""
    for index, thing in enumerate(needed):
        constraint = camera.constraints.new("COPY_TRANSFORMS")
        constraint.target, constraint.influence = thing, 0.0
        if thing.type == "CAMERA":
            name = f"lens {index}"
            camera[name] = 0.0
            driver = camera.driver_add(f'["{name}"]').driver
            driver.type = "SUM"
            target = driver.variables.new().targets[0]
            target.id_type, target.id, target.data_path = "CAMERA", thing.data, "lens"


def escaped(path: Path) -> str:
    """A path in which Blender fills in nothing: it reads braces as a template."""
    return str(path).replace("{", "{{").replace("}", "}}")


def render(scene: bpy.types.Scene, **options: Any) -> None:
    """Render a scene that no window shows. Raises RuntimeError.

    Afterwards Blender evaluates the context's scene as for a new frame, which undoes changes without a key: that is an empty one here.
    """
    empty = bpy.data.scenes.new("SNeRG Empty")
    empty.frame_current = scene.frame_current  # the operator renders the frame of the context's scene, with the other's subframe
    try:
        with bpy.context.temp_override(scene=empty, view_layer=empty.view_layers[0]):
            bpy.ops.render.render(scene=scene.name, **options)
    finally:
        bpy.data.scenes.remove(empty)
