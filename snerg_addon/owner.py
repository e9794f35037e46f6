"""Which folder a scene's project has, and whose a folder is.

- A project belongs to one scene of one .blend file: its `project.json` names both, and an id that the scene keeps too.
- A saved file has its projects beside it, in `NAME.snerg/SCENE`, unless the artist set another folder.
- A file that was never saved has them in Blender's folder for data files, from where they move when it is saved.
- Save As takes the project along: it belongs to the file that the artist goes on with. Save a Copy, a file copied elsewhere and a
  copied scene get projects of their own; the panel names the other one and offers it.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.io.files import cannot_write, json_bytes, read_json, write_bytes

OWNER = "project.json"
OLD_FOLDER = "//snerg"  # of projects made before they had owners
LONGEST = 60  # characters of a scene's name in its folder's

_cache: dict[Path, tuple[tuple[int, int], dict[str, Any]]] = {}


def cached_json(path: Path) -> dict[str, Any]:
    """A JSON object, read again only when its file changed; {} where there is none. Never raises."""
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


def absolute(path: str, scene: bpy.types.Scene) -> Path:
    """A path as Blender's settings have it; `//` is the folder of the .blend file that holds the scene."""
    if path.startswith("//") and not bpy.data.filepath:
        return unsaved_folder(scene) / path[2:]
    linked = scene.path_resolve("library")  # the .blend that the scene is linked from, None where it is this one's own
    return Path(os.path.abspath(bpy.path.abspath(path, library=linked)))


def folder_of(scene: bpy.types.Scene) -> Path:
    """The scene's project folder. It need not be there yet."""
    waiting = unsaved_folder(scene)
    explicit = scene.snerg.folder
    if not bpy.data.filepath:
        return waiting if not explicit or explicit.startswith("//") else absolute(explicit, scene)
    if scene.snerg.project_id and (waiting / OWNER).is_file():
        return waiting  # made before the file was saved, and not moved yet
    if explicit and not other_owner(absolute(explicit, scene), scene):
        return absolute(explicit, scene)
    return automatic_folder(scene)


def unsaved_folder(scene: bpy.types.Scene) -> Path:
    """Where the project of a scene lies whose file was never saved: it outlives the session, unlike Blender's temporary folder."""
    folder = unsaved_root() / (plain(scene.snerg.project_id) or "new")
    return unsaved_root() / "new" if other_owner(folder, scene) and not bpy.data.filepath else folder


def unsaved_root() -> Path:
    """The folder of all projects whose files were never saved."""
    return Path(bpy.utils.user_resource("DATAFILES", path=os.path.join("snerg", "unsaved")))


def automatic_folder(scene: bpy.types.Scene, blend: str = "", empty: bool = False) -> Path:
    """`NAME.snerg/SCENE` beside a saved file, with a number behind it where that is another's.

    blend: in place of the open file. empty: for a project that moves there, where nothing may be yet.
    """
    linked = scene.path_resolve("library")
    file = Path(blend or (bpy.path.abspath(linked.filepath) if linked else bpy.data.filepath)).absolute()
    base = file.with_name(f"{file.stem}.snerg") / (plain(scene.name)[:LONGEST] or "Scene")
    folder, number = base, 2
    while other_owner(folder, scene, str(file)) or (empty and holds_files(folder)):
        folder, number = base.with_name(f"{base.name}-{number}"), number + 1
    return folder


def holds_files(folder: Path) -> bool:
    """Whether there is anything in a folder."""
    return folder.is_dir() and any(folder.iterdir())


def plain(name: str) -> str:
    """A data-block's name as the name of a folder."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._ ")


def other_owner(folder: Path, scene: bpy.types.Scene, blend: str = "") -> str:
    """'NAME.blend, SCENE' where a folder belongs to another file or scene; '' where it is this one's or nobody's.

    The file and the scene's name decide; the id, which the scene keeps too, tells a renamed one from a copy.
    """
    owner = cached_json(folder / OWNER)
    if not owner.get("blend"):  # nobody's, or a file's that was never saved and is not open any more
        other = bpy.data.scenes.get(str(owner.get("scene", "")))
        return f"the scene {other.name}" if _copied(other, scene, owner) else ""
    ours = Path(blend or bpy.data.filepath).absolute()
    theirs, owned, same = Path(os.path.abspath(folder / owner["blend"])), str(owner.get("scene")), owner.get("id") == scene.snerg.project_id
    if theirs == ours:
        free = scene == _holder(str(owner.get("id")), owned)
    else:
        free = same and not theirs.is_file()
    return "" if free else f"{theirs.name}, {owned}"


def _holder(project_id: str, name: str) -> bpy.types.Scene | None:
    """Which scene of this file a project is for that was made in a scene of that name: of those that keep its id (a renamed one, or
    copies) the one so called, else the first; where none keeps it, as in a file that was closed without saving, the name decides."""
    holders = [scene for scene in bpy.data.scenes if project_id and scene.snerg.project_id == project_id]
    named = [scene for scene in holders if scene.name == name]
    return (named or holders or [bpy.data.scenes.get(name)])[0]


def _copied(other: bpy.types.Scene | None, scene: bpy.types.Scene, owner: dict[str, Any]) -> bool:
    return other is not None and other != scene and owner.get("id") == other.snerg.project_id == scene.snerg.project_id


def claim(scene: bpy.types.Scene) -> None:
    """Fix which folder is the scene's project, whatever the scene and the file are called later; nothing is written."""
    settings = scene.snerg
    copied = any(other != scene and other.snerg.project_id == settings.project_id for other in bpy.data.scenes)
    if bpy.data.filepath:
        folder = folder_of(scene)
        taken = bool(settings.folder) and absolute(settings.folder, scene) != folder and folder.parent != unsaved_root()
        if not settings.project_id or taken:
            settings.project_id = str(cached_json(folder / OWNER).get("id") or uuid.uuid4().hex)
        if folder.parent != unsaved_root():
            settings.folder = shown(folder)
    elif not settings.project_id or (copied and not (unsaved_folder(scene) / OWNER).is_file()):
        settings.project_id = uuid.uuid4().hex


def write_owner(folder: Path, scene: bpy.types.Scene) -> None:
    """Note that a folder is this scene's. Raises SnergError when it cannot be written."""
    blend = os.path.relpath(bpy.data.filepath, folder) if bpy.data.filepath and _same_drive(folder) else bpy.data.filepath
    whose = {"format": "snerg-project", "version": 1, "id": scene.snerg.project_id, "blend": blend, "scene": scene.name}
    write_bytes(folder / OWNER, json_bytes({**cached_json(folder / OWNER), **whose}))


def _same_drive(folder: Path) -> bool:
    return os.path.splitdrive(folder)[0] == os.path.splitdrive(bpy.data.filepath)[0]


def shown(path: Path, start: str = "") -> str:
    """A path relative to the .blend where that is possible, as Blender's settings have it. start: the .blend's folder."""
    try:
        return bpy.path.relpath(str(path), start=start or None) if start or bpy.data.filepath else str(path)
    except ValueError:  # another drive
        return str(path)


def adopt(scene: bpy.types.Scene, folder: Path) -> None:
    """Make an existing project this scene's. The other file, if there is one, then sees it as another's. Raises SnergError."""
    settings = scene.snerg
    settings.project_id = str(cached_json(folder / OWNER).get("id") or uuid.uuid4().hex)
    settings.folder = shown(folder)
    write_owner(folder, scene)


def offered(scene: bpy.types.Scene) -> tuple[Path, str] | None:
    """(folder, whose) of a project that the artist may mean: the one set, but another's, or one of an earlier SNeRG; None where none is."""
    if not bpy.data.filepath:
        return None
    if scene.snerg.folder:
        folder = absolute(scene.snerg.folder, scene)
        owner = other_owner(folder, scene)
        return (folder, owner) if owner else None
    old = absolute(OLD_FOLDER, scene)
    if (old / "status.json").is_file() and not (old / OWNER).is_file():
        return old, "an earlier version of SNeRG"
    return None


def move(source: Path, target: Path, progress: Callable[[float, str], None] = lambda fraction, message: None) -> None:
    """A project to another place: at every moment it is whole in one of them. Raises SnergError, Cancelled when `progress` does."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.is_dir() and not holds_files(target):
            target.rmdir()
        try:
            os.rename(source, target)
            return
        except OSError as error:
            if error.errno != errno.EXDEV:  # another disk: what is to be moved is copied first
                raise
        part = target.with_name(f".{target.name}.moving")
        shutil.rmtree(part, ignore_errors=True)
        _copy(source, part, progress)
        os.rename(part, target)
        moved = source.with_name(f".{source.name}.moved")
        os.rename(source, moved)  # in one step: no half of it is ever taken for the project
    except OSError as error:
        raise cannot_write(target, error) from error
    shutil.rmtree(moved, ignore_errors=True)


def _copy(source: Path, part: Path, progress: Callable[[float, str], None]) -> None:
    files = [path for path in source.rglob("*") if path.is_file() and not path.is_symlink()]
    for index, path in enumerate(files):
        progress(index / len(files), f"Moving file {index + 1} of {len(files)}")
        to = part / path.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, to)
        with open(to, "rb+") as file:
            os.fsync(file.fileno())  # what is copied is on the disk before the original goes
