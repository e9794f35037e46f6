"""What saving a .blend does to its projects (owner.py says which belong to whom)."""

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
    absolute,
    automatic_folder,
    cached_json,
    folder_of,
    holds_files,
    move,
    other_owner,
    shown,
    unsaved_folder,
    unsaved_root,
    write_owner,
)

_before: dict[str, str] = {}  # of each scene whose setting a save changed: what it was
_set: dict[int, tuple[str, str]] = {}  # of each scene before an undo, by its session_uid: its project's id and folder
_refused: set[Path] = set()  # projects that could not be moved; tried again when the file is saved or opened
_path = ""  # of the file before the save under way


def own_scenes() -> Iterator[bpy.types.Scene]:
    """The scenes that this file holds itself."""
    return (scene for scene in bpy.data.scenes if scene.path_resolve("library") is None)


@persistent
def before_saving(filepath: Any, *_unused: Any) -> None:
    """Let the file that is written know where its projects are, from where it lies: a file never saved before gets a place for them."""
    global _path
    _before.clear()
    _path = bpy.data.filepath
    path = str(filepath or "")
    if not path:
        return
    start = os.path.dirname(os.path.abspath(path))
    for scene in own_scenes():
        old = scene.snerg.folder
        if not bpy.data.filepath:
            if (unsaved_folder(scene) / OWNER).is_file() and (not old or old.startswith("//")):
                _before[scene.name], scene.snerg.folder = old, shown(automatic_folder(scene, path, empty=True), start)
        elif old.startswith("//") and os.path.dirname(bpy.data.filepath) != start:
            _before[scene.name], scene.snerg.folder = old, shown(absolute(old, scene), start)


@persistent
def after_saving(*_unused: Any) -> None:
    """Take the projects along where the artist goes on with the new file; where it was a copy, everything is as it was."""
    copy = bpy.data.filepath == _path
    for name, old in _before.items():
        if copy and name in bpy.data.scenes:
            bpy.data.scenes[name].snerg.folder = old
    _before.clear()
    if not copy:
        for scene in own_scenes():
            if _path and scene.snerg.folder:
                take_along(scene, Path(_path))
    _refused.clear()
    settle_all()


def take_along(scene: bpy.types.Scene, old_file: Path) -> None:
    """After Save As: a project of the scene in the old file is the new file's."""
    folder = absolute(scene.snerg.folder, scene)
    owner = cached_json(folder / OWNER)
    if owner.get("id") == scene.snerg.project_id and Path(os.path.abspath(folder / str(owner.get("blend")))) == old_file:
        try:
            write_owner(folder, scene)
        except SnergError as error:
            activity.report(folder_of(scene), str(error), False)


@persistent
def after_loading(*_unused: Any) -> None:
    """Another file is open. What a crash kept from moving moves now."""
    _refused.clear()
    settle_all()


@persistent
def before_undo(*_unused: Any) -> None:
    """What a job or an operator sets is no step of undo: see what is set now."""
    _set.clear()
    _set.update({scene.session_uid: (scene.snerg.project_id, scene.snerg.folder) for scene in own_scenes() if scene.snerg.project_id})


@persistent
def after_undo(*_unused: Any) -> None:
    """An undo to before a scene had a project takes nothing but settings away: the project stays the scene's."""
    for scene in own_scenes():
        project_id, folder = _set.get(scene.session_uid, ("", ""))
        if project_id:
            scene.snerg.project_id = project_id
            if bpy.data.filepath and not scene.snerg.folder:
                scene.snerg.folder = folder


def settle_all() -> None:
    """Move the projects of a file that was saved to beside it; those with jobs that run, when these have ended."""
    if bpy.data.filepath:
        for scene in own_scenes():
            settle(scene)


def settle(scene: bpy.types.Scene) -> None:
    """Move one project."""
    waiting = unsaved_folder(scene)
    if waiting in _refused:
        return
    if not scene.snerg.project_id or not (waiting / OWNER).is_file() or live_jobs(waiting) or activity.current(waiting):
        return
    explicit = scene.snerg.folder
    target = absolute(explicit, scene) if explicit and not other_owner(absolute(explicit, scene), scene) else automatic_folder(scene)
    if holds_files(target):
        target = automatic_folder(scene, empty=True)
    manager = bpy.context.window_manager
    manager.progress_begin(0, 100)
    try:
        move(waiting, target, lambda fraction, message: manager.progress_update(100 * fraction))
        scene.snerg.folder = shown(target)
        write_owner(target, scene)
        activity.report(target, f"The project was moved to {target}.", True)
    except SnergError as error:
        _refused.add(waiting)
        activity.report(waiting, f"The project stays in {waiting}: {error}", False)
    finally:
        manager.progress_end()


def forgotten() -> list[Path]:
    """Projects of files that were never saved and are not open, the newest first."""
    ours = {scene.snerg.project_id for scene in bpy.data.scenes}
    try:
        folders = [path for path in unsaved_root().iterdir() if (path / OWNER).is_file() and path.name not in ours]
    except OSError:
        return []
    return sorted(folders, key=lambda path: (path / OWNER).stat().st_mtime, reverse=True)


HANDLERS = (
    (bpy.app.handlers.save_pre, before_saving),
    (bpy.app.handlers.save_post, after_saving),
    (bpy.app.handlers.load_post, after_loading),
    (bpy.app.handlers.undo_pre, before_undo),
    (bpy.app.handlers.redo_pre, before_undo),
    (bpy.app.handlers.undo_post, after_undo),
    (bpy.app.handlers.redo_post, after_undo),
)


def register() -> None:
    """Listen to saving and loading."""
    for handlers, handler in HANDLERS:
        handlers.append(handler)


def unregister() -> None:
    """Listen no more."""
    for handlers, handler in HANDLERS:
        if handler in handlers:
            handlers.remove(handler)
