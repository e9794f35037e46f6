"""The camera's move over the frame range, as a path that a web page plays: what a render of each frame would look from."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar, cast

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.export.scene_json import read_scene_json
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from ..core.geometry.camera_path import CameraPath, Shot, path_bytes
from ..core.geometry.thin_path import drained, thin_steps
from ..core.io.guard import reading
from ..core.units import file_size
from .bridge import camera_from_blender
from .render_evaluation import evaluate_frames
from .shots import active_at
from .simulations import unbaked

T = TypeVar("T")
SLICE_SECONDS = 0.1  # that the window waits for a part of the evaluation, where no frame takes longer by itself
_counted: dict[int, tuple[Any, str]] = {}  # by the scene: what was counted, and for which settings


def camera_move(scene: bpy.types.Scene, box: Box | None) -> CameraPath:
    """The path of the active camera, or of those that markers bind, from the scene's first frame to its last.

    box: of the baked scene, which the path shows within thin_path.TOLERANCE of where a render would; None: everything between the
    camera's clip planes. Every frame is evaluated, and the frame after the last, so that a loop has no gap.
    Raises SnergError where there is no camera, or one is panoramic or cannot be used.
    """
    return drained(camera_move_steps(scene, box))


def camera_move_steps(scene: bpy.types.Scene, box: Box | None, seconds: float = math.inf) -> Generator[tuple[float, str], None, CameraPath]:
    """`camera_move` in steps, which yield how far it is, in [0, 1], and a few words. Between two of them the scene is the artist's own.

    seconds: that a step takes about, where the scene itself takes no longer to evaluate, and no unbaked simulation wants all in one.
    """
    frames = range(scene.frame_start, scene.frame_end + 1)
    active = {frame: camera for frame in frames if (camera := active_at(scene, frame)) is not None}
    if len(active) < len(frames):
        raise SnergError("The scene has no active camera; make one active, or leave the camera move out.")
    after = scene.frame_end + 1
    wanted = {frame: list(dict.fromkeys([active.get(frame - 1), active.get(frame)])) for frame in [*frames, after]}

    def read(depsgraph: bpy.types.Depsgraph, frame: int) -> dict[str, Camera]:
        there = [thing for thing in wanted[frame] if thing is not None]
        return {thing.name_full: camera_from_blender(thing, depsgraph.scene_eval, depsgraph) for thing in there}

    simulated = any(unbaked(scene, after))  # such a simulation goes on from the frame before: no slices
    found: list[dict[str, Camera]] = []
    pace = math.inf if simulated else seconds
    while len(found) < len(wanted):
        left, began = list(wanted)[len(found) :], time.monotonic()
        found += evaluate_frames(scene, left, read, list(dict.fromkeys(active.values())), pace, alone=not simulated)
        # Each evaluation begins with all that the cameras depend on: where that takes long, half as much time for frames follows it.
        pace = max(seconds, (time.monotonic() - began - pace) / 2)
        yield 0.9 * len(found) / len(wanted), f"frame {len(found)} of {len(wanted)}"
    by_frame = dict(zip(wanted, found, strict=True))
    shots = []
    for name, run in groupby(frames, lambda frame: active[frame].name_full):
        shown = list(run)
        keys = [(frame, by_frame[frame][name]) for frame in [*shown, shown[-1] + 1]]
        for first, last in same_kind([camera for _, camera in keys]):
            shots.append((yield from told(thin(keys[first:last], box), (0.95, "leaving out keys"))))
    render = scene.render
    return CameraPath(tuple(shots), scene.frame_start, scene.frame_end, render.fps / render.fps_base)


def same_kind(cameras: Sequence[Camera]) -> Iterator[tuple[int, int]]:
    """The parts [first, last) of a camera's keys between which it becomes another kind; the last one, after the shot, begins no part."""
    first = 0
    for index in range(1, len(cameras)):
        if cameras[index].projection != cameras[first].projection:
            yield first, index
            first = index
    if first < len(cameras) - 1:
        yield first, len(cameras)


def told(steps: Generator[Any, None, T], said: tuple[float, str]) -> Generator[tuple[float, str], None, T]:
    """The steps, each of which says the same."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(T, end.value)
        yield said


def thin(keys: Sequence[tuple[int, Camera]], box: Box | None) -> Generator[None, None, Shot]:
    """A shot with as few keys as its tolerance allows, in steps. Raises SnergError where the camera is panoramic."""
    shot = Shot(tuple(float(frame) for frame, _ in keys), tuple(camera for _, camera in keys))
    corners = None if box is None else box.corners()
    depths = []
    for camera in shot.cameras:
        depths.append(depths_of(camera, corners))
        yield
    return (yield from thin_steps(shot, np.array(depths), shot.cameras[0].position if box is None else box.box_to_world[:3, 3]))


def depths_of(camera: Camera, corners: np.ndarray | None) -> tuple[float, float]:
    """The depths of the nearest and the farthest point that a camera shows of a box with corners [8, 3]."""
    low = max(camera.near, 1e-6)
    far = camera.far if np.isfinite(camera.far) else 1e3 * low
    if corners is None:
        return low, max(far, 1.001 * low)
    depth = camera.project(corners)[1]
    near = max(float(depth.min()), low)
    return near, max(min(float(depth.max()), far), 1.001 * near)


def scene_box(folder: Path) -> Box | None:
    """The box of a baked scene's grid; None where it is forward-facing and has none. Raises SnergError where it cannot be read."""
    value = read_scene_json(folder)
    with reading(folder / "scene.json", "bake it again"):
        if value["ndc"] is not None:
            return None
        size, pose = np.array(value["shape"], np.float64) * value["voxel_size"], np.array(value["grid_to_world"], np.float64)
        pose[:3, 3] += pose[:3, :3] @ (size / 2)
        return Box(pose, size)


def may_move(scene: bpy.types.Scene) -> bool:
    """Whether the camera may move or change within the frame range: a quick look, which asks for nothing to be evaluated."""
    bound = {active_at(scene, marker.frame) for marker in scene.timeline_markers if marker.camera is not None}
    cameras = {camera for camera in (*bound, active_at(scene, scene.frame_start)) if camera is not None}
    return scene.frame_end > scene.frame_start and (len(cameras) > 1 or any(is_animated(camera) for camera in cameras))


def is_animated(thing: bpy.types.ID | None, seen: set[bpy.types.ID] | None = None) -> bool:
    """Whether an object, its data, a parent or a target of its constraints has keys, drivers, physics or modifiers."""
    seen = set() if seen is None else seen
    if thing is None or thing in seen:
        return False
    seen.add(thing)
    data = getattr(thing, "animation_data", None)
    if data is not None and (data.action is not None or len(data.drivers) or len(data.nla_tracks)):
        return True
    if not isinstance(thing, bpy.types.Object):
        return False
    if thing.rigid_body is not None or (thing.modifiers and seen != {thing}):  # a camera has none: it is followed
        return True
    targets = [target for constraint in thing.constraints for target in (getattr(constraint, "target", None), constraint)]
    return any(is_animated(other, seen) for other in (thing.data, thing.parent, *targets) if isinstance(other, bpy.types.ID))


def summary(path: CameraPath) -> str:
    """'12 keyframes, 3 KB'."""
    return f"{path.keys} keyframe{'' if path.keys == 1 else 's'}, {file_size(len(path_bytes(path)))}"


def remember_count(scene: bpy.types.Scene, path: CameraPath) -> None:
    """Keep the `summary` of a path for the panel."""
    _counted[scene.session_uid] = settings_of(scene), summary(path)


def counted(scene: bpy.types.Scene) -> str:
    """The `summary` that was kept; '' where there is none for these settings of the scene."""
    stamp, text = _counted.get(scene.session_uid, (None, ""))
    return text if stamp == settings_of(scene) else ""


def settings_of(scene: bpy.types.Scene) -> tuple[Any, ...]:
    """What a path depends on and is quickly read."""
    render = scene.render
    markers = tuple((marker.frame, marker.camera and marker.camera.name_full) for marker in scene.timeline_markers)
    size = render.resolution_x, render.resolution_y, render.resolution_percentage, render.fps, render.fps_base
    return scene.frame_start, scene.frame_end, scene.camera and scene.camera.name_full, markers, size
