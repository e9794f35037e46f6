"""The project: the folder that belongs to a scene of a .blend file, and what each step left there.

A project folder holds `project.json` (whose it is, and which version of field and scene is in use), `status.json` (what is known of
each result), `fields/001`, `fields/002`, ... and `scenes/001`, ... (a training or a bake never replaces an earlier one), the rendered
dataset, studies, exports and jobs. owner.py says which folder a scene has.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..core.artifact import is_dataset
from ..core.io.files import cannot_write, folder_bytes, json_bytes, write_bytes
from .owner import OWNER, absolute, cached_json, folder_of

VERSIONS = {
    "field": ("fields", "field.npz"),
    "scene": ("scenes", "scene.json"),
}  # folder, and a version's mark


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
        """The trained or imported field that is in use."""
        return self.in_use("field")

    @property
    def scene(self) -> Path:
        """The baked scene that is in use."""
        return self.in_use("scene")

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
        if step in VERSIONS:
            return (self.in_use(step) / VERSIONS[step][1]).is_file()
        marks = {"reference": self.reference / "scene_params.json", "web": self.web / "index.html"}
        return marks[step].is_file()

    def versions(self, step: str) -> list[Path]:
        """Every version of 'field' or 'scene', the oldest first; one that an earlier SNeRG left in `field` or `scene` comes before all."""
        name, mark = VERSIONS[step]
        try:
            numbered = sorted(path for path in (self.folder / name).iterdir() if path.name.isdigit())
        except OSError:
            numbered = []
        return [path for path in (self.folder / step, *numbered) if (path / mark).is_file()]

    def in_use(self, step: str) -> Path:
        """The version that the artist or the last finished work chose; the newest where that is gone. It need not be there."""
        there = self.versions(step)
        chosen = self.folder / str(self._used().get(step, ""))
        return chosen if chosen in there else there[-1] if there else self.folder / step

    def use(self, step: str, version: Path) -> None:
        """Put a version of 'field' or 'scene' in use. Raises SnergError when the folder cannot be written."""
        self._write_owner(use={**self._used(), step: self.key(version)})

    def new_version(self, step: str) -> Path:
        """An empty folder for a new version, behind all others. Raises SnergError when it cannot be made."""
        folder = self.folder / VERSIONS[step][0]
        number = 1 + max((int(path.name) for path in folder.glob("*") if path.name.isdigit()), default=0)
        while True:
            path = folder / f"{number:03d}"
            try:
                path.mkdir(parents=True)
                return path
            except FileExistsError:
                number += 1
            except OSError as error:
                raise cannot_write(path, error) from error

    def version_made(self, step: str, path: str) -> Path:
        """Where a version lies that a job wrote to `path`: the project may have been moved since."""
        name = Path(path).name
        return self.folder / step if name == step else self.folder / VERSIONS[step][0] / name

    def name_of(self, version: Path) -> str:
        """What the artist calls a version; its number where it has no name."""
        names = cached_json(self.folder / OWNER).get("names")
        name = names.get(self.key(version)) if isinstance(names, Mapping) else None
        return str(name)[:80] if name else version.name

    def rename(self, version: Path, name: str) -> None:
        """Call a version something; '' takes its name back. Raises SnergError when the folder cannot be written."""
        names = cached_json(self.folder / OWNER).get("names")
        kept = dict(names) if isinstance(names, Mapping) else {}
        self._write_owner(names={**kept, self.key(version): name.strip()})

    def note_settings(self, version: Path, arguments: list[str]) -> None:
        """Remember the options of the command line that a version is made with. Raises SnergError when the folder cannot be written."""
        self.note(f"settings of {self.key(version)}", {"arguments": arguments})

    def settings_of(self, version: Path) -> str:
        """'preset fast, seed 0, minutes 5': what a version was made with; '' where that is not known. Never raises."""
        note = cached_json(self._notes).get(f"settings of {self.key(version)}")
        arguments = note.get("arguments") if isinstance(note, dict) else None
        words = " ".join(str(part) for part in arguments) if isinstance(arguments, list) else ""
        options = [option.strip().replace("-", " ") for option in re.split(r"(?:^|\s)--", words)]
        return ", ".join(option for option in options if option)

    def key(self, path: Path) -> str:
        """A result's path within the project, by which its facts are noted."""
        return path.relative_to(self.folder).as_posix() if path.is_relative_to(self.folder) else path.as_posix()

    def _used(self) -> dict[str, Any]:
        used = cached_json(self.folder / OWNER).get("use")
        return dict(used) if isinstance(used, Mapping) else {}

    def _write_owner(self, **changes: Any) -> None:
        write_bytes(self.folder / OWNER, json_bytes({**cached_json(self.folder / OWNER), **changes}))

    def note(self, step: str, facts: dict[str, Any]) -> None:
        """Remember what a step came to, for the panels. Raises SnergError when the folder cannot be written."""
        notes = {**cached_json(self._notes), step: {**facts, "when": time.strftime("%Y-%m-%d %H:%M")}}
        write_bytes(self._notes, json_bytes(notes))

    def note_of(self, version: Path) -> dict[str, Any]:
        """What `remember` noted of a version, {} where it noted nothing: it was stopped, or is not from here. Never raises."""
        found = cached_json(self._notes).get(self.key(version))
        return found if isinstance(found, dict) else {}

    def notes(self) -> dict[str, Any]:
        """What `note` remembered, a step a key: of 'field' and 'scene' that of the version in use. Never raises."""
        notes = {key: value for key, value in cached_json(self._notes).items() if isinstance(value, dict)}
        for step in VERSIONS:
            if known := self.note_of(self.in_use(step)):
                notes[step] = known
            else:
                notes.pop(step, None)
        return notes


def no_dataset(project: Project, name: str = "") -> str:
    """What is wrong with the folder to train on, in a sentence; '' where it holds a dataset. name: what to call it; its path where ''."""
    if project.has("dataset"):
        return ""
    return f"{name or project.dataset} holds no dataset: no transforms.json, poses_bounds.npy or COLMAP model is there"


def project_of(scene: bpy.types.Scene) -> Project:
    """The scene's project (see owner.py for its folder)."""
    folder = folder_of(scene)
    return Project(folder, absolute(scene.snerg.dataset, scene) if scene.snerg.dataset else folder / "dataset")


def remember(project: Project, step: str, folder: Path, facts: dict[str, Any], **more: Any) -> None:
    """Note a result's simple facts, `more` that are JSON values of any kind, and the size of what is in `folder`.

    A version of 'field' or 'scene' is in use from here on. Raises SnergError when the project cannot be written.
    """
    simple = {key: value for key, value in facts.items() if isinstance(value, str | int | float | bool)}
    noted = {**simple, **more, "bytes": folder_bytes(folder)}
    if step in VERSIONS:
        project.note(project.key(folder), noted)
        project.use(step, folder)
    else:
        project.note(step, noted)
