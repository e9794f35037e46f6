"""A baked scene's files within the .blend, so that one file holds everything."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import bpy

from ..core.artifact import SCENES, kind_of
from ..core.errors import SnergError
from ..core.export.reference import reference_files
from ..core.export.scene_files import scene_files
from ..core.io.files import new_folder
from ..core.io.guard import reading
from .viewport.loading import has_scene, stamp_of

KEY = "snerg_packed"  # the object's custom property: a zip of the folder's files, stored without compressing them again
DIGEST = "snerg_packed_digest"  # another: which zip that is, so that redraws need not read it
MAX_BYTES = 2**31 - 1  # that a property of Blender can hold

_compared: dict[tuple[str, Path, int], bool] = {}  # by the packed zip's digest, a folder and its stamp: whether both hold the same


def pack(thing: bpy.types.Object, folder: Path) -> int:
    """Keep a copy of the files of the object's scene in the .blend; returns its bytes. Raises SnergError where they cannot be read."""
    buffer = io.BytesIO()
    with reading(folder, "bake or import the scene again", f"The scene {folder}"):
        files = files_of(folder)
        if sum(file.stat().st_size for file in files) > MAX_BYTES:
            raise SnergError(
                f"The scene {folder} takes more than 2 GB, which a .blend file cannot hold; bake it coarser or keep the folder."
            )
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
            for file in files:
                archive.write(file, file.name)
    data = buffer.getvalue()
    thing[KEY], thing[DIGEST] = data, hashlib.sha256(data).hexdigest()[:16]
    return len(data)


def files_of(folder: Path) -> list[Path]:
    """The files of the scene in a folder. Raises SnergError where there is none."""
    kind = kind_of(folder)
    if kind not in SCENES:
        raise SnergError(f"There is no baked scene in {folder} but a {kind}; choose the folder of a baked scene.")
    inside = folder / "scene" if kind == "page" else folder
    return reference_files(inside) if kind == "reference scene" else scene_files(inside)


def is_packed(thing: bpy.types.Object) -> bool:
    """Whether the .blend holds a copy of the object's scene."""
    return KEY in thing


def discard(thing: bpy.types.Object) -> None:
    """Keep no copy any more."""
    for key in (KEY, DIGEST):
        if key in thing:
            del thing[key]


def contents(thing: bpy.types.Object) -> dict[str, bytes]:
    """{file name: bytes} of the copy. Raises SnergError where it is damaged."""
    with (
        reading(Path(bpy.data.filepath), "pack the scene again", f"The scene that is packed in {thing.name}"),
        zipfile.ZipFile(io.BytesIO(thing[KEY])) as archive,
    ):
        return {info.filename: archive.read(info) for info in archive.infolist() if info.filename == Path(info.filename).name}


def holds_copy(thing: bpy.types.Object, folder: Path) -> bool:
    """Whether the scene in a folder is the one that is packed. Compared once for each change of the folder. Raises SnergError as
    `contents` does."""
    key = str(thing[DIGEST]), folder, stamp_of(folder)
    if key[2] and key not in _compared:
        try:
            there = {file.name: file for file in files_of(folder)}
            packed = contents(thing)
            _compared[key] = there.keys() == packed.keys() and all(there[name].read_bytes() == data for name, data in packed.items())
        except OSError:
            return False
    return _compared.get(key, False)


def unpack(thing: bpy.types.Object, folder: Path) -> None:
    """Write the copy to a folder, whole or not at all; nothing where that holds it already.

    Raises SnergError where the copy is damaged, the folder holds other files, or it cannot be written.
    """
    packed = contents(thing)
    if has_scene(folder):
        if holds_copy(thing, folder):
            return
        raise SnergError(
            f"{folder} holds another scene than the one that is packed; choose a new folder for the object and unpack there, or pack again."
        )
    with new_folder(folder) as made:
        for name, content in packed.items():
            (made / name).write_bytes(content)


def source_of(thing: bpy.types.Object, folder: Path) -> Path:
    """Where to read an object's scene from: its folder, or where that has no scene and the .blend holds a copy, a copy in the folder
    for temporary files of this session, which nobody else writes.

    Raises SnergError as `unpack` does.
    """
    if not is_packed(thing) or has_scene(folder):
        return folder
    copy = Path(bpy.app.tempdir) / f"snerg-unpacked-{thing[DIGEST]}"
    if not has_scene(copy):
        unpack(thing, copy)
    return copy


def state_of(thing: bpy.types.Object, folder: Path) -> str:
    """How the packed copy and the folder differ, one sentence; '' where they do not, or nothing is packed. Raises SnergError as
    `contents` does."""
    if not is_packed(thing) or holds_copy(thing, folder):
        return ""
    if has_scene(folder):
        return "The packed copy holds another scene than the folder, which is shown. Pack again to replace it"
    return f"There is no scene in {folder}; the packed copy is shown"
