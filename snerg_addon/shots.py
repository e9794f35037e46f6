"""The views of a dataset: cameras, cameras at frames, and where all of these are when they are rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.geometry.camera import Camera
from .bridge import camera_from_blender
from .render_evaluation import evaluate_render
from .simulations import listed, simulation_warning

SHIFT = 1e-5  # of an object between two frames, relative to its own size, that counts as movement; float32 rounding gives less


@dataclass(frozen=True)
class Moment:
    """A camera object at a frame."""

    camera: bpy.types.Object
    frame: int


Shot: TypeAlias = bpy.types.Object | Moment | Camera


def camera_of(shot: Shot) -> bpy.types.Object | None:
    """The camera object of a shot; None for a core camera."""
    return shot.camera if isinstance(shot, Moment) else None if isinstance(shot, Camera) else shot


def frame_of(shot: Shot) -> int | None:
    """The frame of a shot; None for the scene's own."""
    return shot.frame if isinstance(shot, Moment) else None


def active_at(scene: bpy.types.Scene, frame: int) -> bpy.types.Object | None:
    """The camera that renders a frame: the last marker's before it that has one, else the first such marker's, else the scene's.

    As in Blender, cameras that are hidden in renders are passed over at markers.
    """
    bound = [marker for marker in scene.timeline_markers if marker.camera is not None and not marker.camera.hide_render]
    bound.sort(key=lambda marker: marker.frame)
    before = [marker.camera for marker in bound if marker.frame <= frame]
    return before[-1] if before else bound[0].camera if bound else scene.camera


def evaluated_shots(scene: bpy.types.Scene, shots: Sequence[Shot]) -> tuple[list[Camera], list[str]]:
    """(the shots as core cameras, where a render has them; sentences about what a dataset will not show as the artist may expect).

    The scene is evaluated once for each frame. Raises SnergError where there are no shots, or one is no camera that can be used.
    """
    if not shots:
        raise SnergError("There is no camera to render from; add cameras to the scene, select some, or use the rig.")
    cameras: dict[int, Camera] = {index: shot for index, shot in enumerate(shots) if isinstance(shot, Camera)}
    places: list[dict[str, np.ndarray]] = []
    blurred: set[str] = set()
    for frame in dict.fromkeys(frame_of(shot) for shot in shots if not isinstance(shot, Camera)):
        some = {index: thing for index, shot in enumerate(shots) if frame_of(shot) == frame and (thing := camera_of(shot)) is not None}

        def read(depsgraph: bpy.types.Depsgraph, some: dict[int, bpy.types.Object] = some, frame: int | None = frame) -> None:
            for index, thing in some.items():
                camera = camera_from_blender(thing, depsgraph.scene_eval, depsgraph)
                cameras[index] = camera if frame is None else replace(camera, name=f"{camera.name}, frame {frame}")
                if thing.evaluated_get(depsgraph).data.dof.use_dof:
                    blurred.add(thing.name)
            places.append(places_in(depsgraph) if frame is not None else {})

        evaluate_render(scene, read, list(dict.fromkeys(some.values())), frame)
    check_engine(scene, [cameras[index] for index in range(len(shots))])
    said = [blur_warning(sorted(blurred)), movement_warning(places), simulation_warning(scene, [frame_of(shot) for shot in shots])]
    return [cameras[index] for index in range(len(shots))], [sentence for sentence in said if sentence]


def check_engine(scene: bpy.types.Scene, cameras: Sequence[Camera]) -> None:
    """Raise SnergError where one of the cameras is panoramic and the scene's engine would render it as something else."""
    wide = [camera.name for camera in cameras if camera.is_wide]
    if wide and scene.render.engine != "CYCLES":
        raise SnergError(f"The camera {wide[0]!r} is panoramic, which only Cycles renders here; choose Cycles, or leave the camera out.")


def blur_warning(names: Sequence[str]) -> str:
    """A sentence about cameras with depth of field; '' where there are none."""
    if not names:
        return ""
    return f"The dataset is rendered without the depth of field of {listed(names)}: a field is trained on sharp pictures."


def movement_warning(places: Sequence[dict[str, np.ndarray]]) -> str:
    """A sentence about objects that are not the same in all of the `places_in` frames; '' where all are."""
    moved = {name for later in places[1:] for name in places[0].keys() | later.keys() if not same(places[0].get(name), later.get(name))}
    if not moved:
        return ""
    verb = "moves or changes" if len(moved) == 1 else "move or change"
    return f"{listed(sorted(moved))} {verb} while the frames pass; a field shows one moment, so render one frame or hold them still."


def same(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    """Whether an object is in the same place. None: it is not there."""
    if one is None or other is None:
        return one is other
    scale = max(float(np.ptp(one[:-1], axis=0).max()), 1e-6) if len(one) > 1 else 1.0
    return one.shape == other.shape and bool(np.abs(one - other).max() <= SHIFT * max(scale, float(np.abs(one).max())))


def places_in(depsgraph: bpy.types.Depsgraph) -> dict[str, np.ndarray]:
    """For each object that renders, and each light, points [N, 3] that tell where it is and what shape it has, in world units."""
    found: dict[str, list[np.ndarray]] = {}
    for instance in depsgraph.object_instances:
        thing = instance.object
        if thing.type in ("CAMERA", "EMPTY", "ARMATURE", "LATTICE", "SPEAKER") or not instance.show_self:
            continue
        name = instance.parent.name if instance.is_instance and instance.parent else thing.name
        matrix = np.array(instance.matrix_world, np.float64)
        points = np.concatenate([bounds(thing), centroid(thing)])
        if thing.type == "LIGHT":
            points = np.eye(4)[:, :3]
        found.setdefault(name, []).append(points @ matrix[:3, :3].T + matrix[:3, 3])
    return {name: np.concatenate(points) for name, points in found.items()}


def bounds(thing: bpy.types.Object) -> np.ndarray:
    """The corners [8, 3] of an object's bounding box, in its own space."""
    return np.array([list(corner) for corner in thing.bound_box], np.float64)


def centroid(thing: bpy.types.Object) -> np.ndarray:
    """The mean [1, 3] and the mean square [1, 3] of a mesh's vertices, in its own space; [0, 3] for other objects."""
    if thing.type != "MESH" or not len(thing.data.vertices):
        return np.empty((0, 3))
    points = np.empty(len(thing.data.vertices) * 3, np.float32)
    thing.data.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3).astype(np.float64)
    return np.stack([points.mean(axis=0), np.sqrt((points**2).mean(axis=0))])
