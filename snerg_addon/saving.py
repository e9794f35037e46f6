"""What saving, opening and undo do to the projects of a .blend file (owner.py says which project belongs to which scene)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..core.errors import SnergError
from ..core.jobs.folder import live_jobs
from . import activity
from .owner import (
    OWNER,
    absolute_path,
    automatic_folder,
    blend_path,
    cached_json,
    holds_files,
    move_project,
    other_owner,
    project_folder,
    unsaved_folder,
    unsaved_root,
    write_owner,
)
from .scene_object import absolute, folder_of, is_own, is_snerg_object, own_objects, same_folders
from .training_object import remove_all, undone
from .viewport.loading import has_scene

_old_folders: dict[str, str] = {}  # the folder setting of each scene in which a save changed it
_old_paths: dict[str, str] = {}  # the scene folder of each SNeRG object in which a save changed it
_settings_before_undo: dict[int, tuple[str, str]] = {}  # (project id, folder) by session_uid
_rewritten: dict[str, str] = {}  # what saving made of the path of an object, by what it was: undo brings the old one back
_failed_moves: set[Path] = set()  # folders that could not be moved; tried again when a file is saved or opened
_path_before_save = ""  # of the open file, while it is being saved


def local_scenes() -> Iterator[bpy.types.Scene]:
    """The scenes of this file that are not linked from a library."""
    return (scene for scene in bpy.data.scenes if scene.path_resolve("library") is None)


@persistent
def before_saving(filepath: Any, *_unused: Any) -> None:
    """Set the project folders as the file to be written needs them: relative to it, and beside it if it was never saved before."""
    global _path_before_save
    _old_folders.clear()
    _old_paths.clear()
    _path_before_save = bpy.data.filepath
    path = str(filepath or "")
    if not path:
        return
    start, moves = os.path.dirname(os.path.abspath(path)), {}
    for scene in local_scenes():
        old = scene.snerg.folder
        if not bpy.data.filepath:
            if (unsaved_folder(scene) / OWNER).is_file() and (not old or old.startswith("//")):
                moves[unsaved_folder(scene)] = target = automatic_folder(scene, path, empty=True)
                _old_folders[scene.name], scene.snerg.folder = old, blend_path(target, start)
        elif old.startswith("//") and os.path.dirname(bpy.data.filepath) != start:
            _old_folders[scene.name], scene.snerg.folder = old, blend_path(absolute_path(old, scene), start)
    for thing in own_objects():
        old, folder = thing.snerg.folder, folder_of(thing)
        moved = next((target / folder.relative_to(source) for source, target in moves.items() if folder.is_relative_to(source)), None)
        elsewhere = os.path.dirname(bpy.data.filepath) != start or folder != absolute(old, None)  # or its path is still a library's
        if moved is not None or (old.startswith("//") and elsewhere):
            _old_paths[thing.name] = old
            write_path(thing, blend_path(moved or folder, start))


@persistent
def after_saving(*_unused: Any) -> None:
    """After Save As the projects belong to the new file; after Save Copy all settings are restored."""
    copy = bpy.data.filepath == _path_before_save
    for name, old in _old_folders.items():
        if copy and name in bpy.data.scenes:
            bpy.data.scenes[name].snerg.folder = old
    _old_folders.clear()
    for name, old in _old_paths.items():
        if (copy or not _path_before_save) and name in bpy.data.objects:  # a project that moves takes its objects' paths along
            write_path(bpy.data.objects[name], old)
    _old_paths.clear()
    if not copy:
        for scene in local_scenes():
            if _path_before_save and scene.snerg.folder:
                transfer_project(scene, Path(_path_before_save))
    _failed_moves.clear()
    move_saved_projects()


def write_path(thing: bpy.types.Object, path: str) -> None:
    """Write the path of an object's folder in another way; the folder is the same."""
    if thing.snerg.folder != path:
        _rewritten[thing.snerg.folder] = path
    with same_folders():
        thing.snerg.folder = path


def transfer_project(scene: bpy.types.Scene, old_file: Path) -> None:
    """After Save As: make the new file the owner of a project that the scene owned in the old file."""
    folder = absolute_path(scene.snerg.folder, scene)
    owner = cached_json(folder / OWNER)
    if owner.get("id") == scene.snerg.project_id and Path(os.path.abspath(folder / str(owner.get("blend")))) == old_file:
        try:
            write_owner(folder, scene)
        except SnergError as error:
            activity.report(project_folder(scene), str(error), False)


@persistent
def after_loading(*_unused: Any) -> None:
    """Another file was opened: move its projects that are still waiting to be moved, as after a crash. A file that was saved while a
    training ran has the training's object, which the timer makes again if the training still runs."""
    remove_all()
    _failed_moves.clear()
    _rewritten.clear()
    move_saved_projects()


@persistent
def after_appending(context: Any, *_unused: Any) -> None:
    """Paths of objects that were appended from another file are relative to that file, which Blender does not know of our property."""
    for item in context.import_items:
        thing, source = item.id, item.source_library
        appended = source is not None and isinstance(thing, bpy.types.Object) and is_snerg_object(thing) and is_own(thing)
        if appended and thing.snerg.folder.startswith("//"):
            write_path(thing, blend_path(Path(bpy.path.abspath(thing.snerg.folder, library=source))))


@persistent
def before_undo(*_unused: Any) -> None:
    """Remember the project settings, which are not part of an undo step: jobs and operators set them."""
    _settings_before_undo.clear()
    for scene in local_scenes():
        if scene.snerg.project_id:
            _settings_before_undo[scene.session_uid] = (scene.snerg.project_id, scene.snerg.folder)


@persistent
def after_undo(*_unused: Any) -> None:
    """Restore the project settings that undo took away, so that a scene keeps its project; show trainings again."""
    for scene in local_scenes():
        project_id, folder = _settings_before_undo.get(scene.session_uid, ("", ""))
        if project_id:
            scene.snerg.project_id = project_id
            if bpy.data.filepath and not scene.snerg.folder:
                scene.snerg.folder = folder
    undone()
    for thing in own_objects():
        follow_saving(thing)


def follow_saving(thing: bpy.types.Object) -> None:
    """Where undo brought back a path from before the file was saved elsewhere, at which no scene is any more: write it as saving did."""
    tried, found = [thing.snerg.folder], has_scene(folder_of(thing))
    while not found and (path := _rewritten.get(tried[-1])) and path not in tried:
        tried.append(path)
        found = has_scene(Path(bpy.path.abspath(path)))
    if found and len(tried) > 1:
        with same_folders():
            thing.snerg.folder = tried[-1]


def move_saved_projects() -> None:
    """Move the projects of a file that was never saved before beside it; projects with running jobs when these have ended."""
    if bpy.data.filepath:
        for scene in local_scenes():
            move_saved_project(scene)


def move_saved_project(scene: bpy.types.Scene) -> None:
    """Move the scene's project beside the file, if it is not there yet and nothing runs in it. The panel reports the outcome."""
    source = unsaved_folder(scene)
    if source in _failed_moves:
        return
    if not scene.snerg.project_id or not (source / OWNER).is_file() or live_jobs(source) or activity.current(source):
        return
    chosen = scene.snerg.folder
    target = absolute_path(chosen, scene) if chosen and not other_owner(absolute_path(chosen, scene), scene) else automatic_folder(scene)
    if holds_files(target):
        target = automatic_folder(scene, empty=True)
    manager = bpy.context.window_manager
    manager.progress_begin(0, 100)
    try:
        move_project(source, target, lambda fraction, message: manager.progress_update(100 * fraction))
        scene.snerg.folder = blend_path(target)
        follow_move(source, target)
        write_owner(target, scene)
        activity.report(target, f"The project was moved to {target}.", True)
    except SnergError as error:
        _failed_moves.add(source)
        activity.report(source, f"The project stays in {source}: {error}", False)
    finally:
        manager.progress_end()


def follow_move(source: Path, target: Path) -> None:
    """Make the objects that show scenes of a moved project show them where they are now."""
    for thing in own_objects():
        if (folder := folder_of(thing)).is_relative_to(source):
            write_path(thing, blend_path(target / folder.relative_to(source)))


def orphaned_projects() -> list[Path]:
    """The project folders of files that were never saved and are not open, the newest first."""
    open_ids = {scene.snerg.project_id for scene in bpy.data.scenes}
    try:
        folders = [path for path in unsaved_root().iterdir() if (path / OWNER).is_file() and path.name not in open_ids]
    except OSError:
        return []
    return sorted(folders, key=lambda path: (path / OWNER).stat().st_mtime, reverse=True)


HANDLERS = (
    (bpy.app.handlers.blend_import_post, after_appending),
    (bpy.app.handlers.save_pre, before_saving),
    (bpy.app.handlers.save_post, after_saving),
    (bpy.app.handlers.load_post, after_loading),
    (bpy.app.handlers.undo_pre, before_undo),
    (bpy.app.handlers.redo_pre, before_undo),
    (bpy.app.handlers.undo_post, after_undo),
    (bpy.app.handlers.redo_post, after_undo),
)


def register() -> None:
    """Add the handlers."""
    for handlers, handler in HANDLERS:
        handlers.append(handler)


def unregister() -> None:
    """Remove the handlers."""
    for handlers, handler in HANDLERS:
        if handler in handlers:
            handlers.remove(handler)
