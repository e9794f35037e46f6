"""A baked scene's files within the .blend, so that one file holds everything."""

from __future__ import annotations

import hashlib
import io
import tempfile
import zipfile
from pathlib import Path

import bpy

from ..core.artifact import kind_of
from ..core.errors import SnergError
from ..core.export.reference import reference_files
from ..core.export.scene_files import scene_files
from ..core.io.files import new_folder
from ..core.io.guard import reading

KEY = "snerg_packed"  # the object's custom property: a zip of the folder's files, stored without compressing them again
DIGEST = "snerg_packed_digest"  # another: which zip that is, so that redraws need not read it
MAX_BYTES = 2**31 - 1  # that a property of Blender can hold


def pack(thing: bpy.types.Object, folder: Path) -> int:
    """Keep a copy of the files of the object's scene in the .blend; returns its bytes. Raises SnergError where they cannot be read."""
    kind = kind_of(folder)
    inside = folder / "scene" if kind == "page" else folder
    files = reference_files(inside) if kind == "reference scene" else scene_files(inside)
    if sum(file.stat().st_size for file in files) > MAX_BYTES:
        raise SnergError(f"The scene {folder} takes more than 2 GB, which a .blend file cannot hold; bake it coarser, or keep its folder.")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for file in files:
            archive.write(file, file.name)
    data = buffer.getvalue()
    thing[KEY], thing[DIGEST] = data, hashlib.sha256(data).hexdigest()[:16]
    return len(data)


def is_packed(thing: bpy.types.Object) -> bool:
    """Whether the .blend holds a copy of the object's scene."""
    return KEY in thing


def discard(thing: bpy.types.Object) -> None:
    """Keep no copy any more."""
    for key in (KEY, DIGEST):
        if key in thing:
            del thing[key]


def unpack(thing: bpy.types.Object, folder: Path) -> None:
    """Write the copy to a folder, whole or not at all. Raises SnergError where it is damaged, or the folder cannot be written."""
    with (
        reading(folder, "pack the scene again", f"The scene that is packed in {thing.name}"),
        zipfile.ZipFile(io.BytesIO(thing[KEY])) as archive,
    ):
        names = [info.filename for info in archive.infolist() if info.filename == Path(info.filename).name]
        contents = {name: archive.read(name) for name in names}
    with new_folder(folder) as made:
        for name, content in contents.items():
            (made / name).write_bytes(content)


def source_of(thing: bpy.types.Object, folder: Path) -> Path:
    """Where to read an object's scene from: its folder, or where that is gone and the .blend holds a copy, a copy in the temporary folder.

    Raises SnergError as `unpack` does.
    """
    if folder.is_dir() or not is_packed(thing):
        return folder
    copy = Path(tempfile.gettempdir()) / f"snerg-unpacked-{thing[DIGEST]}"
    if not copy.is_dir():
        unpack(thing, copy)
    return copy
