"""The SNeRG object: an empty that stands for a baked scene's folder, where the artist puts it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
from .viewport.loading import cached, has_scene
from .viewport.view import even_scale

NAME = "SNeRG"
UNEVEN = "{} is scaled unevenly, sheared or mirrored, which a baked scene cannot be; clear its scale, or scale it alike on all axes."


_chosen = True  # whether a folder that is set now is another choice, and not another way to write the same


def folder_chosen(settings: SNERG_PG_object, _context: bpy.types.Context) -> None:
    """The artist, or a script, chose another folder: the object's box becomes that of its scene, moved as the old one was.

    Where it cannot be read, the box stays as it was, and the object's panel says why."""
    thing = settings.id_data
    if _chosen and is_snerg_object(thing):
        with suppress(SnergError):
            take_box(thing, cached(source_of(thing)))


@contextmanager
def same_folders() -> Iterator[None]:
    """Within it, the folders of objects are written in another way, as a file that is saved elsewhere needs them."""
    global _chosen
    before, _chosen = _chosen, False
    try:
        yield
    finally:
        _chosen = before


class SNERG_PG_object(bpy.types.PropertyGroup):
    """What makes an empty a SNeRG object."""

    folder: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Scene",
        description="The folder of the baked scene that this object shows; relative to the .blend file",
        subtype="DIR_PATH",
        options=RELATIVE_PATHS,
        update=folder_chosen,
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
    point_at(thing, scene, folder)
    thing.matrix_world = thing.matrix_basis  # before the next evaluation too
    collection.objects.link(thing)
    return thing


def show_scene(scene: bpy.types.Scene, project: Project, folder: Path, before: Path) -> bpy.types.Object | None:
    """Show a new version of the project's baked scene: by the objects that show the version that was in use `before`, all of them; where
    there are none, by those of any version. Returns a new object where the scene has none of these, else None, as where the folder cannot
    be read. The objects' own moves, turns and scales are kept."""
    try:
        baked = cached(folder)
    except SnergError:
        return None
    lasting = [thing for thing in own_objects() if not thing.snerg.temporary]
    ours = [thing for thing in lasting if folder_of(thing).is_relative_to(project.folder)]
    followers = [thing for thing in ours if folder_of(thing) == before] or ours
    for thing in followers:
        point_at(thing, baked, folder)
    return None if any(thing.name in scene.objects for thing in followers) else make(baked, folder, scene.collection)


def placement(thing: bpy.types.Object) -> np.ndarray:
    """[4, 4] float64: where the box of an object's scene stood when it was baked."""
    return np.array(thing.snerg.baked_at, np.float64).reshape(4, 4)


def point_at(thing: bpy.types.Object, scene: Scene, folder: Path) -> None:
    """Make an object show a baked scene, moved as the one before was."""
    with same_folders():
        thing.snerg.folder = blend_path(folder)
    take_box(thing, scene)


def take_box(thing: bpy.types.Object, scene: Scene) -> None:
    """Make an object's box that of a baked scene, moved, turned and scaled as the box before was."""
    old, new = placement(thing), scene.box.box_to_world
    if not np.allclose(old, new, rtol=1e-6, atol=1e-6):  # else the artist's numbers stay as they are
        thing.matrix_basis = Matrix((np.array(thing.matrix_basis, np.float64) @ np.linalg.inv(old) @ new).tolist())
        thing.snerg.baked_at = new.ravel().tolist()
    thing.snerg.size = scene.box.size.tolist()


def is_snerg_object(thing: bpy.types.Object | None) -> bool:
    """Whether an object shows a baked scene."""
    return thing is not None and thing.type == "EMPTY" and bool(thing.snerg.folder)


def snerg_objects(holder: bpy.types.ViewLayer | bpy.types.Scene | bpy.types.BlendData) -> Iterator[bpy.types.Object]:
    """The SNeRG objects among the `objects` of a view layer, a scene or the file."""
    return (thing for thing in holder.objects if is_snerg_object(thing))


def own_objects() -> Iterator[bpy.types.Object]:
    """The SNeRG objects of this file: not linked from a library, nor overrides of such."""
    return (thing for thing in snerg_objects(bpy.data) if is_own(thing))


def is_own(thing: bpy.types.Object) -> bool:
    """Whether an object is the file's own: not linked from a library, nor an override of such a one."""
    return thing.library is None and thing.override_library is None


def link_beside(child: bpy.types.Object, thing: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Put an object into the collections of another one: those that can be changed, or else the scene's."""
    own = [one for one in thing.users_collection if one.library is None and one.override_library is None]
    for collection in own or [scene.collection]:
        collection.objects.link(child)


def folder_of(thing: bpy.types.Object) -> Path:
    """The folder of an object's scene; of a linked object, and of an override of one, relative to the file that it comes from.

    A duplicate of a linked object, and one that was made local, have kept a path that is relative to the library: where the file's own
    place has no scene, it is the one of the libraries that has.
    """
    origin, path = thing, thing.snerg.folder
    while origin.override_library is not None and origin.override_library.reference is not None:
        origin = origin.override_library.reference
    folder = absolute(path, origin.library)
    if not path.startswith("//") or not is_own(thing) or not bpy.data.libraries or has_scene(folder):
        return folder
    others = {other for library in bpy.data.libraries if has_scene(other := absolute(path, library))}
    return others.pop() if len(others) == 1 else folder


def absolute(path: str, library: bpy.types.Library | None) -> Path:
    """The absolute path of one of Blender's, where `//` is the folder of a library; of the open file where that is None."""
    return Path(os.path.abspath(bpy.path.abspath(path, library=library)))


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


def box_corners(thing: bpy.types.Object, matrix: np.ndarray | None = None) -> np.ndarray | None:
    """[8, 3], the corners in the world of the box that was baked; None where it is not known. matrix: [4, 4], of an instance."""
    if not all(thing.snerg.size):
        return None
    matrix = np.array(thing.matrix_world, np.float64) if matrix is None else matrix
    return Box(np.eye(4), np.array(thing.snerg.size)).corners() @ matrix[:3, :3].T + matrix[:3, 3]
