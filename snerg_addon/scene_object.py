"""The SNeRG object: an empty that stands for a baked scene's folder, where the artist puts it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from ..core.scene.scene import Scene
from . import packing
from .owner import blend_path
from .project import Project
from .properties import RELATIVE_PATHS
from .viewport.loading import cached
from .viewport.view import even_scale

NAME = "SNeRG"
UNEVEN = "{} is scaled unevenly, sheared or mirrored, which a baked scene cannot be; clear its scale, or scale it alike on all axes."


class SNERG_PG_object(bpy.types.PropertyGroup):
    """What makes an empty a SNeRG object."""

    folder: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Scene",
        description="The folder of the baked scene that this object shows; relative to the .blend file",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
    )
    size: bpy.props.FloatVectorProperty(  # type: ignore[valid-type]
        name="Box",
        description="Sides of the box that was baked, in units of the scene as it was baked",
        size=3,
        subtype="XYZ_LENGTH",
    )
    temporary: bpy.props.BoolProperty(options={"HIDDEN"})  # type: ignore[valid-type]  # see training_object.py
    baked_at: bpy.props.FloatVectorProperty(size=16, default=np.eye(4).ravel().tolist(), options={"HIDDEN"})  # type: ignore[valid-type]


def make(scene: Scene, folder: Path, collection: bpy.types.Collection, name: str = NAME) -> bpy.types.Object:
    """An object that shows a baked scene, where the scene's box stood."""
    thing = bpy.data.objects.new(name, None)
    thing.empty_display_type, thing.empty_display_size = "PLAIN_AXES", float(max(scene.box.size)) / 2
    thing.matrix_world = Matrix(scene.box.box_to_world.tolist())
    point_at(thing, scene, folder)
    collection.objects.link(thing)
    return thing


def show_scene(scene: bpy.types.Scene, project: Project, folder: Path) -> bpy.types.Object | None:
    """Show a new version of the project's baked scene: by the object that showed the version before, where there is one, else by a new
    object. Returns None where the folder cannot be read; the object's own moves, turns and scale are kept."""
    try:
        baked = cached(folder)
    except SnergError:
        return None
    for thing in snerg_objects(scene):
        if folder_of(thing).is_relative_to(project.folder) and not thing.snerg.temporary:
            moved = np.array(thing.matrix_world, np.float64) @ np.linalg.inv(placement(thing)) @ baked.box.box_to_world
            point_at(thing, baked, folder)
            thing.matrix_world = Matrix(moved.tolist())
            return thing
    return make(baked, folder, scene.collection)


def placement(thing: bpy.types.Object) -> np.ndarray:
    """[4, 4] float64: where the box of an object's scene stood when it was baked."""
    return np.array(thing.snerg.baked_at, np.float64).reshape(4, 4)


def point_at(thing: bpy.types.Object, scene: Scene, folder: Path) -> None:
    """Make an object show a baked scene."""
    thing.snerg.folder = blend_path(folder)
    thing.snerg.size = scene.box.size.tolist()
    thing.snerg.baked_at = scene.box.box_to_world.ravel().tolist()


def is_snerg_object(thing: bpy.types.Object | None) -> bool:
    """Whether an object shows a baked scene."""
    return thing is not None and thing.type == "EMPTY" and bool(thing.snerg.folder)


def snerg_objects(holder: bpy.types.ViewLayer | bpy.types.Scene | bpy.types.BlendData) -> Iterator[bpy.types.Object]:
    """The SNeRG objects among the `objects` of a view layer, a scene or the file."""
    return (thing for thing in holder.objects if is_snerg_object(thing))


def folder_of(thing: bpy.types.Object) -> Path:
    """The folder of an object's scene; of a linked object relative to its own file."""
    return Path(os.path.abspath(bpy.path.abspath(thing.snerg.folder, library=thing.library)))


def placed_camera(name: str, scene: Scene, matrix: np.ndarray, camera: Camera) -> tuple[Camera, float]:
    """A camera of the world as it stands to a scene whose object has the world matrix [4, 4], in the world in which the scene was baked;
    and how much larger the object is than it was baked. Raises SnergError where the object is not evenly scaled."""
    scale = even_scale(matrix)
    if scale is None:
        raise SnergError(UNEVEN.format(name))
    return camera.moved(rigid_similarity(scene.box.box_to_world @ np.linalg.inv(matrix))), scale


def rigid_similarity(matrix: np.ndarray) -> np.ndarray:
    """A similarity [4, 4] whose rotation is exact, from one that Blender kept in float32."""
    u, sizes, v = np.linalg.svd(matrix[:3, :3])
    found = matrix.copy()
    found[:3, :3] = (u @ v) * sizes.mean()
    return found


def source_of(thing: bpy.types.Object) -> Path:
    """Where an object's scene is read from (see packing.source_of). Raises SnergError where a packed one is damaged."""
    return packing.source_of(thing, folder_of(thing))


def problem_of(thing: bpy.types.Object) -> str:
    """Why an object cannot be shown as it stands, one sentence; '' where it can."""
    return UNEVEN.format(thing.name) if even_scale(np.array(thing.matrix_world, np.float64)) is None else ""


def box_corners(thing: bpy.types.Object) -> np.ndarray | None:
    """[8, 3], the corners in the world of the box that was baked; None where it is not known."""
    if not all(thing.snerg.size):
        return None
    matrix = np.array(thing.matrix_world, np.float64)
    return Box(np.eye(4), np.array(thing.snerg.size)).corners() @ matrix[:3, :3].T + matrix[:3, 3]
