"""The project folder: where each step of a scene leaves its work, and what is known of it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..core.describe import folder_bytes, is_dataset
from ..core.errors import SnergError
from ..core.files import json_bytes, read_json, write_bytes


@dataclass(frozen=True)
class Project:
    """`folder` holds everything; `dataset` may lie elsewhere, where the artist brings photographs."""

    folder: Path
    dataset: Path

    @property
    def own_dataset(self) -> Path:
        """Where a rendered dataset goes."""
        return self.folder / "dataset"

    @property
    def field(self) -> Path:
        """The trained or imported field."""
        return self.folder / "field"

    @property
    def scene(self) -> Path:
        """The baked scene."""
        return self.folder / "scene"

    @property
    def reference(self) -> Path:
        """The scene in the reference PNG layout."""
        return self.folder / "reference"

    @property
    def web(self) -> Path:
        """The web bundle."""
        return self.folder / "web"

    @property
    def studies(self) -> Path:
        """Studies, a folder each."""
        return self.folder / "studies"

    @property
    def survey(self) -> Path:
        """The look at the field that estimates are made from."""
        return self.folder / "survey.npz"

    @property
    def box(self) -> Path:
        """The box as the last bake or estimate used it, JSON."""
        return self.folder / "box.json"

    @property
    def cameras(self) -> Path:
        """The cameras of the last export, as a transforms file."""
        return self.folder / "cameras.json"

    @property
    def _notes(self) -> Path:
        return self.folder / "status.json"

    def has(self, step: str) -> bool:
        """Whether the work of 'dataset', 'field', 'scene', 'reference' or 'web' is there."""
        if step == "dataset":
            return is_dataset(self.dataset)
        marks = {
            "field": self.field / "field.npz",
            "scene": self.scene / "scene.json",
            "reference": self.reference / "scene_params.json",
            "web": self.web / "index.html",
        }
        return marks[step].is_file()

    def note(self, step: str, facts: dict[str, Any]) -> None:
        """Remember what a step came to, for the panels. Raises SnergError when the folder cannot be written."""
        notes = {**self.notes(), step: {**facts, "when": time.strftime("%Y-%m-%d %H:%M")}}
        write_bytes(self._notes, json_bytes(notes))

    def notes(self) -> dict[str, Any]:
        """What `note` remembered, a step a key; read again only when the file changed. Never raises."""
        try:
            stamp = self._notes.stat().st_mtime_ns
        except OSError:
            return {}
        cached = _cache.get(self._notes)
        if cached is None or cached[0] != stamp:
            try:
                value = read_json(self._notes)
            except SnergError:
                value = {}
            cached = _cache[self._notes] = (stamp, value if isinstance(value, dict) else {})
        return cached[1]


_cache: dict[Path, tuple[int, dict[str, Any]]] = {}


def project_of(scene: bpy.types.Scene) -> Project:
    """The scene's project: its folder as set, next to the .blend; in Blender's temporary folder until that is saved."""
    settings = scene.snerg
    folder = _absolute(settings.folder or "//snerg", scene)
    return Project(folder, _absolute(settings.dataset, scene) if settings.dataset else folder / "dataset")


def is_temporary(scene: bpy.types.Scene) -> bool:
    """Whether the project would be lost with the session."""
    return not bpy.data.filepath and scene.snerg.folder.startswith("//")


def _absolute(path: str, scene: bpy.types.Scene) -> Path:
    if path.startswith("//") and not bpy.data.filepath:
        return Path(bpy.app.tempdir) / path[2:]
    linked = scene.path_resolve("library")  # the .blend that the scene is linked from, None where it is this one's own
    return Path(os.path.abspath(bpy.path.abspath(path, library=linked)))


def remember(project: Project, step: str, folder: Path, facts: dict[str, Any], **more: Any) -> None:
    """Note a step's simple facts, `more` that are JSON values of any kind, and the size of what it left."""
    simple = {key: value for key, value in facts.items() if isinstance(value, str | int | float | bool)}
    project.note(step, {**simple, **more, "bytes": folder_bytes(folder)})
