"""Rendering a dataset in another process, from a copy of the file: the side of the window, and the side of the process."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import bpy

from ..core.data.rig import RigSettings, rig_cameras
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.io.files import write_bytes
from ..core.io.json_files import json_bytes, read_json
from ..core.jobs import folder as folders
from ..core.jobs.protocol import job_reporter, own_folder, run_job
from ..core.jobs.runner import LAUNCHER, Job, job_environment
from ..core.progress import Progress
from ..launcher import RENDER
from .bridge import resolution
from .capture import render_dataset
from .capture_scene import CaptureSettings
from .shots import Moment, Shot, camera_of, frame_of

COPY, ORDER = "scene.blend", "render.json"


def render_job(
    scene: bpy.types.Scene, shots: list[Shot] | RigSettings, folder: Path, settings: CaptureSettings, box: Box | None, resume: bool
) -> Job:
    """A job that renders what `capture.render_dataset` would render now. shots: cameras of the scene, or a rig round the box.

    `begin` saves a copy of the file with all unsaved changes, and of painted images that were not saved. It raises SnergError where
    these cannot be written.
    """
    order: dict[str, Any] = {
        "scene": scene.name,
        "folder": str(folder),
        "settings": vars(settings),
        "goes_on": resume,
        "box": box.to_json() if box else None,
        "scripts": not bpy.app.autoexec_fail,  # whether scripts run in this file now
    }
    if isinstance(shots, RigSettings):
        order["rig"] = vars(shots)
    else:
        order["cameras"] = [(camera.name_full, frame_of(shot)) for shot in shots if (camera := camera_of(shot)) is not None]

    def prepare(job: Path) -> None:
        source = job / folders.INPUT
        source.mkdir()
        write_bytes(source / ORDER, json_bytes({**order, "images": save_painted(source)}))
        save_copy(source / COPY)

    return Job([*interpreter(), str(LAUNCHER), *(["--"] if bpy.app.binary_path else []), RENDER], job_environment(), prepare)


def interpreter() -> list[str]:
    """The command that runs a script with bpy: this Blender in background mode, or Python where bpy is a module."""
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "--background", "-noaudio", "--python-exit-code", "2", "--python"]
    return [sys.executable]


def save_copy(path: Path) -> None:
    """Save a copy of the file with its unsaved changes and with its relative paths adapted. Raises SnergError."""
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, relative_remap=True, check_existing=False)
    except RuntimeError as error:
        raise SnergError(
            f"A copy of the file could not be saved to render from ({str(error).strip()}); see whether the disk is full."
        ) from error


def save_painted(folder: Path) -> dict[str, str]:
    """Save painted images with unsaved changes, which a copy of the file lacks. Returns {name: file in `folder`}. Raises SnergError."""
    saved: dict[str, str] = {}
    for image in bpy.data.images:
        if image.is_dirty and image.users and image.library is None:
            if image.source == "TILED":
                raise SnergError(f"The image {image.name!r} has changes that are not saved; save it (Image, Save), then render again.")
            name = f"painted-{len(saved)}"
            try:
                image.save(filepath=str(folder / name), save_copy=True)
            except RuntimeError as error:
                raise SnergError(
                    f"The image {image.name!r} could not be saved ({str(error).strip()}); save or pack it, then render again."
                ) from error
            saved[image.name] = name
    return saved


def main() -> int:
    """The process's exit code; called by launcher.py."""
    reporter = job_reporter()
    reporter.last_words = "Stopped as you asked; the views that were rendered are kept."
    return run_job(render)


def render(progress: Progress) -> dict[str, Any]:
    """Open the copy and render it. Returns what `capture.render_dataset` does."""
    folder = own_folder()
    assert folder is not None
    source = folder / folders.INPUT
    try:
        order = read_json(source / ORDER)
        progress(0.0, "Opening the copy of the file")
        bpy.ops.wm.open_mainfile(filepath=str(source / COPY), load_ui=False, use_scripts=order["scripts"])
        load_painted(source, order["images"])
        scene = bpy.data.scenes[order["scene"]]
        box = Box.from_json(order["box"]) if order["box"] else None
        chosen: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in order["settings"].items()}
        settings = CaptureSettings(**chosen)
        return render_dataset(scene, ordered_shots(scene, order, box), Path(order["folder"]), settings, box, progress, order["goes_on"])
    finally:
        shutil.rmtree(source, ignore_errors=True)


def ordered_shots(scene: bpy.types.Scene, order: dict[str, Any], box: Box | None) -> list[Shot]:
    """The cameras that were chosen when the job was started."""
    if "rig" in order and box is not None:
        return list(rig_cameras(box, RigSettings(**order["rig"]), *resolution(scene)))
    named = {thing.name_full: thing for thing in scene.objects}
    return [named[name] if frame is None else Moment(named[name], frame) for name, frame in order["cameras"]]


def load_painted(folder: Path, images: dict[str, str]) -> None:
    """Load the images that `save_painted` saved, {name: file in `folder`}."""
    for name, file in images.items():
        image = bpy.data.images[name]
        if image.packed_file:
            image.unpack(method="REMOVE")
        image.source, image.filepath = "FILE", str(folder / file)
        image.reload()
