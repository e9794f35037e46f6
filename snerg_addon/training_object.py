"""A temporary SNeRG object for each running training that bakes previews: it shows the field so far and goes away with the training.

The timer (operators/watch.py) makes the object when there is a preview; the viewport reads the preview again each time the training
replaces it. F12 does not render it. In a file that is saved meanwhile it stays until the file is opened again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.commands.training_preview import FOLDER
from ..core.export.scene_files import is_scene
from ..core.io.files import discard
from ..core.jobs.runner import Job
from . import activity
from .activity import Activity
from .scene_object import folder_of, make, own_objects
from .viewport.loading import loaded

NAME = "SNeRG Training"
_shown: set[Path] = set()  # previews for which an object was made that nothing but the artist can have removed
_dismissed: set[Path] = set()  # previews whose object the artist deleted


def preview_of(running: Activity) -> Path | None:
    """The folder of the preview that a job keeps while it runs; None where it keeps none."""
    arguments = running.task.arguments if isinstance(running.task, Job) else []
    if "--preview" not in arguments or "--out" not in arguments[:-1]:
        return None
    return Path(arguments[arguments.index("--out") + 1]) / FOLDER


def discard_preview(running: Activity) -> None:
    """Delete the preview of a job that has ended: one that was killed leaves it."""
    if (folder := preview_of(running)) is not None:
        discard(folder)


def temporary_objects() -> Iterator[bpy.types.Object]:
    """The objects of this module in the open file; the artist may have duplicated some."""
    return (thing for thing in own_objects() if thing.snerg.temporary)


def show_trainings() -> None:
    """Make an object for each preview that has none, and remove the objects of trainings that have ended."""
    running = {folder: one for one in activity.current() if (folder := preview_of(one)) is not None}
    remove([thing for thing in temporary_objects() if folder_of(thing) not in running])
    shown = {folder_of(thing) for thing in temporary_objects()}
    _dismissed.update(_shown.intersection(running) - shown)
    for folder in running.keys() - shown - _dismissed:
        scene = bpy.data.scenes.get(running[folder].scene)
        baked = loaded(folder).scene if is_scene(folder) else None
        if scene is not None and baked is not None:
            thing = make(baked, folder, scene.collection, NAME)
            thing.snerg.temporary = thing.hide_render = True
            shown.add(folder)
    _shown.clear()
    _shown.update(shown)
    _dismissed.intersection_update(running)


def remove(things: list[bpy.types.Object]) -> None:
    """Delete objects; later, where the artist is just moving something, which may be one of them."""
    moving = any(one.bl_idname.startswith("TRANSFORM_") for window in bpy.context.window_manager.windows for one in window.modal_operators)
    if not moving:
        bpy.data.batch_remove(things)


def remove_all() -> None:
    """Remove every temporary object; those of running trainings come back."""
    remove(list(temporary_objects()))
    undone()


def undone() -> None:
    """An object that is missing now was not deleted by the artist."""
    _shown.clear()
