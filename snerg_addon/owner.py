"""Which folder is a scene's project, and which scene owns a folder.

- A project belongs to one scene of one .blend file. Its `project.json` holds both names, and an id that the scene stores too.
- The projects of a saved file lie beside it, in `NAME.snerg/SCENE`, unless the artist chose another folder or pattern.
- The projects of a file that was never saved lie in Blender's folder for data files. They move when the file is saved.
- After Save As, the project belongs to the new file, with which the artist continues. A file made by Save Copy, a file copied outside
  Blender and a copied scene get projects of their own; the panel names the original project and offers to use it.
"""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.io.files import cannot_write, write_bytes
from ..core.io.json_files import json_bytes, read_json
from ..core.progress import Progress, silent
from .folder_pattern import folder_of_pattern, safe_name
from .preferences import project_pattern

OWNER = "project.json"
OLD_FOLDER = "//snerg"  # where version 0.1 put every project, without a project.json

_cache: dict[Path, tuple[tuple[int, int], dict[str, Any]]] = {}


def cached_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file, read again only when the file changed; {} where there is none. Never raises."""
    try:
        status = path.stat()
    except OSError:
        return {}
    stamp = (status.st_mtime_ns, status.st_ino)
    if path not in _cache or _cache[path][0] != stamp:
        try:
            value = read_json(path)
        except SnergError:
            value = {}
        _cache[path] = (stamp, value if isinstance(value, dict) else {})
    return _cache[path][1]


def absolute_path(path: str, scene: bpy.types.Scene) -> Path:
    """The absolute path for a path from Blender's settings, where `//` is the folder of the .blend file that holds the scene."""
    if path.startswith("//") and not bpy.data.filepath:
        return unsaved_folder(scene) / path[2:]
    linked = scene.path_resolve("library")  # the library that the scene is linked from; None where it is local
    return Path(os.path.abspath(bpy.path.abspath(path, library=linked)))


def project_folder(scene: bpy.types.Scene) -> Path:
    """The scene's project folder, which may not exist yet."""
    unsaved, chosen = unsaved_folder(scene), scene.snerg.folder
    if not bpy.data.filepath:
        return unsaved if not chosen or chosen.startswith("//") else absolute_path(chosen, scene)
    if scene.snerg.project_id and (unsaved / OWNER).is_file():
        return unsaved  # made before the file was saved, and not moved yet
    if chosen and not other_owner(absolute_path(chosen, scene), scene):
        return absolute_path(chosen, scene)
    return automatic_folder(scene)


def unsaved_folder(scene: bpy.types.Scene) -> Path:
    """The project folder of a scene whose file was never saved. Unlike Blender's temporary folder it outlives the session."""
    folder = unsaved_root() / (safe_name(scene.snerg.project_id) or "new")
    return unsaved_root() / "new" if other_owner(folder, scene) and not bpy.data.filepath else folder


def unsaved_root() -> Path:
    """The folder of all projects whose files were never saved."""
    return Path(bpy.utils.user_resource("DATAFILES", path=os.path.join("snerg", "unsaved")))


def automatic_folder(scene: bpy.types.Scene, blend: str = "", empty: bool = False) -> Path:
    """The folder of the preferences' pattern, with a number appended where another scene owns that folder.

    A project that is where the default pattern puts it keeps its place. blend: the file's path, by default the open file's. empty: whether
    the folder must be empty or absent, so that a project can move there.
    """
    linked = scene.path_resolve("library")
    file = Path(blend or (bpy.path.abspath(linked.filepath) if linked else bpy.data.filepath)).absolute()
    usual = folder_of_pattern("", file, scene.name)
    if not empty and (usual / OWNER).is_file() and not other_owner(usual, scene, str(file)):
        return usual
    base = folder_of_pattern(project_pattern(), file, scene.name)
    folder, number = base, 2
    while other_owner(folder, scene, str(file)) or (empty and holds_files(folder)):
        folder, number = base.with_name(f"{base.name}-{number}"), number + 1
    return folder


def holds_files(folder: Path) -> bool:
    """Whether the folder exists and is not empty."""
    return folder.is_dir() and any(folder.iterdir())


def other_owner(folder: Path, scene: bpy.types.Scene, blend: str = "") -> str:
    """'NAME.blend, SCENE' of the owner where that is another file or scene; '' where the scene owns the folder, or nobody does.

    The names of file and scene decide. The project's id, which the scene stores too, tells a renamed scene from a copied one.
    """
    owner = cached_json(folder / OWNER)
    if not owner.get("blend"):  # without an owner, or of a file that was never saved
        other = bpy.data.scenes.get(str(owner.get("scene", "")))
        return f"the scene {other.name}" if _is_copy(other, scene, owner) else ""
    own_blend = Path(blend or bpy.data.filepath).absolute()
    owner_blend, owner_scene = Path(os.path.abspath(folder / owner["blend"])), str(owner.get("scene"))
    same_id = owner.get("id") == scene.snerg.project_id
    if owner_blend == own_blend:
        usable = scene == _owning_scene(str(owner.get("id")), owner_scene)
    else:
        usable = same_id and not owner_blend.is_file()  # the file was renamed or moved
    return "" if usable else f"{owner_blend.name}, {owner_scene}"


def _owning_scene(project_id: str, name: str) -> bpy.types.Scene | None:
    """The scene of this file that owns a project with this id, made in a scene of this name.

    Several scenes store the id where one was copied: of these the one with the name, else the first. Where none stores it, because the
    file was closed without saving, the scene with the name; None where there is none.
    """
    holders = [scene for scene in bpy.data.scenes if project_id and scene.snerg.project_id == project_id]
    named = [scene for scene in holders if scene.name == name]
    return (named or holders or [bpy.data.scenes.get(name)])[0]


def _is_copy(other: bpy.types.Scene | None, scene: bpy.types.Scene, owner: dict[str, Any]) -> bool:
    """Whether `scene` stores the project's id only because it is a copy of `other`."""
    return other is not None and other != scene and owner.get("id") == other.snerg.project_id == scene.snerg.project_id


def assign_project(scene: bpy.types.Scene) -> None:
    """Store the project's id and folder in the scene, so that renaming the scene or the file changes nothing. Writes no file."""
    settings = scene.snerg
    copied = any(other != scene and other.snerg.project_id == settings.project_id for other in bpy.data.scenes)
    if bpy.data.filepath:
        folder = project_folder(scene)
        occupied = bool(settings.folder) and absolute_path(settings.folder, scene) != folder and folder.parent != unsaved_root()
        if not settings.project_id or occupied:
            settings.project_id = str(cached_json(folder / OWNER).get("id") or uuid.uuid4().hex)
        chosen = bool(settings.folder) and absolute_path(settings.folder, scene) == folder  # then it stays as the artist wrote it
        if folder.parent != unsaved_root() and not chosen:
            settings.folder = blend_path(folder)
    elif not settings.project_id or (copied and not (unsaved_folder(scene) / OWNER).is_file()):
        settings.project_id = uuid.uuid4().hex


def write_owner(folder: Path, scene: bpy.types.Scene) -> None:
    """Write into project.json that the scene owns the folder. Raises SnergError when it cannot be written."""
    blend = os.path.relpath(bpy.data.filepath, folder) if bpy.data.filepath and _same_drive(folder) else bpy.data.filepath
    owner = {"format": "snerg-project", "version": 1, "id": scene.snerg.project_id, "blend": blend, "scene": scene.name}
    write_bytes(folder / OWNER, json_bytes({**cached_json(folder / OWNER), **owner}))


def _same_drive(folder: Path) -> bool:
    return os.path.splitdrive(folder)[0] == os.path.splitdrive(bpy.data.filepath)[0]


def blend_path(path: Path, start: str = "") -> str:
    """A path for Blender's settings, relative to the .blend file (`//...`) where possible. start: the folder of that file."""
    try:
        return bpy.path.relpath(str(path), start=start or None) if start or bpy.data.filepath else str(path)
    except ValueError:  # another drive
        return str(path)


def adopt(scene: bpy.types.Scene, folder: Path) -> None:
    """Make the scene the owner of an existing project. Its former owner starts a new one. Raises SnergError when it cannot be written."""
    settings = scene.snerg
    settings.project_id = str(cached_json(folder / OWNER).get("id") or uuid.uuid4().hex)
    settings.folder = blend_path(folder)
    write_owner(folder, scene)


def adoptable_project(scene: bpy.types.Scene) -> tuple[Path, str] | None:
    """(folder, owner) of a project that the panel offers: the chosen folder if another scene owns it, or one of version 0.1; or None."""
    if not bpy.data.filepath:
        return None
    if scene.snerg.folder:
        folder = absolute_path(scene.snerg.folder, scene)
        owner = other_owner(folder, scene)
        return (folder, owner) if owner else None
    old = absolute_path(OLD_FOLDER, scene)
    if (old / "status.json").is_file() and not (old / OWNER).is_file():
        return old, "an earlier version of SNeRG"
    return None


def move_project(source: Path, target: Path, progress: Progress = silent) -> None:
    """Move a project. At every moment it is complete in one of the two places. Raises SnergError, and Cancelled when `progress` does."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.is_dir() and not holds_files(target):
            target.rmdir()
        try:
            os.rename(source, target)
            return
        except OSError as error:
            if error.errno != errno.EXDEV:  # EXDEV: another disk, where the files have to be copied
                raise
        part = target.with_name(f".{target.name}.moving")
        shutil.rmtree(part, ignore_errors=True)
        _copy(source, part, progress)
        os.rename(part, target)
        moved = source.with_name(f".{source.name}.moved")
        os.rename(source, moved)  # in one step, so that a project is never half deleted
    except OSError as error:
        raise cannot_write(target, error) from error
    shutil.rmtree(moved, ignore_errors=True)


def _copy(source: Path, part: Path, progress: Progress) -> None:
    files = [path for path in source.rglob("*") if path.is_file() and not path.is_symlink()]
    for index, path in enumerate(files):
        progress(index / len(files), f"Moving file {index + 1} of {len(files)}")
        to = part / path.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, to)
        with open(to, "rb+") as file:
            os.fsync(file.fileno())  # the copy is on the disk before the original is deleted
