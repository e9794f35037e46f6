"""The project: the folder that belongs to a scene of a .blend file, with the results of every step.

A project folder holds `project.json` (its owner, and which versions of field and scene are in use), `status.json` (facts about each
result), `fields/001`, `fields/002`, ... and `scenes/001`, ... (a training or a bake never replaces an earlier version), the rendered
dataset, studies, exports and jobs. owner.py says which folder belongs to a scene.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..core.artifact import is_dataset
from ..core.io.files import cannot_write, folder_bytes, write_bytes
from ..core.io.json_files import json_bytes
from .owner import OWNER, absolute_path, cached_json, project_folder

VERSIONS = {"field": ("fields", "field.npz"), "scene": ("scenes", "scene.json")}
"""The steps with versions: the folder of the versions, and the file that each version holds."""


@dataclass(frozen=True)
class Project:
    """The paths and facts of a project. folder: the project folder. dataset: to train on, which may lie elsewhere."""

    folder: Path
    dataset: Path

    @property
    def own_dataset(self) -> Path:
        """The rendered dataset."""
        return self.folder / "dataset"

    @property
    def field(self) -> Path:
        """The version of the field that is in use."""
        return self.in_use("field")

    @property
    def scene(self) -> Path:
        """The version of the baked scene that is in use."""
        return self.in_use("scene")

    @property
    def reference(self) -> Path:
        """The export in the PNG layout of the reference implementation."""
        return self.folder / "reference"

    @property
    def web(self) -> Path:
        """The exported web page."""
        return self.folder / "web"

    @property
    def studies(self) -> Path:
        """The folder of the studies."""
        return self.folder / "studies"

    @property
    def survey(self) -> Path:
        """The field probe, from which estimates are made."""
        return self.folder / "survey.npz"

    @property
    def box(self) -> Path:
        """The box of the last bake or estimate, JSON."""
        return self.folder / "box.json"

    @property
    def cameras(self) -> Path:
        """The cameras of the last web page, as a transforms.json."""
        return self.folder / "cameras.json"

    @property
    def camera_path(self) -> Path:
        """The camera path of the last web page."""
        return self.folder / "camera_path.json"

    @property
    def annotations(self) -> Path:
        """The annotations of the last web page."""
        return self.folder / "annotations.json"

    @property
    def _notes(self) -> Path:
        return self.folder / "status.json"

    def has(self, step: str) -> bool:
        """Whether the result of a step exists: 'dataset', 'field', 'scene', 'reference' or 'web'."""
        if step == "dataset":
            return is_dataset(self.dataset)
        if step in VERSIONS:
            return (self.in_use(step) / VERSIONS[step][1]).is_file()
        marks = {"reference": self.reference / "scene_params.json", "web": self.web / "index.html"}
        return marks[step].is_file()

    def versions(self, step: str) -> list[Path]:
        """The versions of 'field' or 'scene', the oldest first. Version 0.1 had only one, in the folder `field` or `scene`."""
        name, mark = VERSIONS[step]
        try:
            named = sorted(path for path in (self.folder / name).iterdir() if not path.name.startswith("."))  # what is being written
        except OSError:
            named = []
        return [path for path in (self.folder / step, *named) if (path / mark).is_file()]

    def in_use(self, step: str) -> Path:
        """The version in use: chosen by the artist, or made last; the newest where that was deleted. It may not exist yet."""
        there = self.versions(step)
        chosen = self.chosen(step)
        return chosen if chosen in there else there[-1] if there else self.folder / step

    def chosen(self, step: str) -> Path | None:
        """The version of 'field' or 'scene' that was chosen or made last, whether it is still there or not; None where none was."""
        used = self._used().get(step)
        return self.folder / str(used) if used else None

    def use(self, step: str, version: Path) -> None:
        """Choose the version of 'field' or 'scene' that is in use. Raises SnergError when the folder cannot be written."""
        self._write_owner(use={**self._used(), step: self.key(version)})

    def use_newest(self, step: str) -> None:
        """Use the newest version of 'field' or 'scene' from now on. Raises SnergError when the folder cannot be written."""
        self._write_owner(use={key: value for key, value in self._used().items() if key != step})

    def new_version(self, step: str) -> Path:
        """Make an empty folder for a new version, with the next number. Raises SnergError when it cannot be made."""
        while True:
            path = self.next_version(step)
            try:
                path.mkdir(parents=True)
                return path
            except FileExistsError:  # another Blender was quicker
                continue
            except OSError as error:
                raise cannot_write(path, error) from error

    def next_version(self, step: str) -> Path:
        """The folder that the next version of 'field' or 'scene' would have; it is not made."""
        folder = self.folder / VERSIONS[step][0]
        number = 1 + max((int(path.name) for path in folder.glob("*") if path.name.isdigit()), default=0)
        return folder / f"{number:03d}"

    def version_made(self, step: str, path: str) -> Path:
        """The folder of a version that a job wrote to `path`, which the project may have left since."""
        name = Path(path).name
        return self.folder / step if name == step else self.folder / VERSIONS[step][0] / name

    def name_of(self, version: Path) -> str:
        """The name that the artist gave a version; its number where there is none."""
        names = cached_json(self.folder / OWNER).get("names")
        name = names.get(self.key(version)) if isinstance(names, Mapping) else None
        return str(name)[:80] if name else version.name

    def rename(self, version: Path, name: str) -> None:
        """Give a version a name; '' removes it. Raises SnergError when the folder cannot be written."""
        names = cached_json(self.folder / OWNER).get("names")
        kept = dict(names) if isinstance(names, Mapping) else {}
        self._write_owner(names={**kept, self.key(version): name.strip()})

    def note_settings(self, version: Path, arguments: list[str]) -> None:
        """Record the command-line options that a version is made with. Raises SnergError when the folder cannot be written."""
        self.note(f"settings of {self.key(version)}", {"arguments": arguments})

    def settings_of(self, version: Path) -> str:
        """'preset fast, seed 0, minutes 5': the options that a version was made with; '' where they are not known. Never raises."""
        note = cached_json(self._notes).get(f"settings of {self.key(version)}")
        arguments = note.get("arguments") if isinstance(note, dict) else None
        words = " ".join(str(part) for part in arguments) if isinstance(arguments, list) else ""
        options = [option.strip().replace("-", " ") for option in re.split(r"(?:^|\s)--", words)]
        return ", ".join(option for option in options if option)

    def key(self, path: Path) -> str:
        """The path of a result within the project, which is its key in status.json."""
        return path.relative_to(self.folder).as_posix() if path.is_relative_to(self.folder) else path.as_posix()

    def _used(self) -> dict[str, Any]:
        used = cached_json(self.folder / OWNER).get("use")
        return dict(used) if isinstance(used, Mapping) else {}

    def _write_owner(self, **changes: Any) -> None:
        write_bytes(self.folder / OWNER, json_bytes({**cached_json(self.folder / OWNER), **changes}))

    def note(self, step: str, facts: dict[str, Any]) -> None:
        """Record facts about a step's result in status.json, with the time. Raises SnergError when the folder cannot be written."""
        notes = {**cached_json(self._notes), step: {**facts, "when": time.strftime("%Y-%m-%d %H:%M")}}
        write_bytes(self._notes, json_bytes(notes))

    def note_remarks(self, dataset: Path, remarks: Sequence[str]) -> None:
        """Record what the reader of a dataset passed over or repaired. Raises SnergError when the folder cannot be written."""
        self.note("remarks", {"dataset": self.key(dataset), "sentences": list(remarks)})

    def remarks(self) -> list[str]:
        """What the reader passed over or repaired in the dataset in use, as it was last imported or trained on. Never raises."""
        note = cached_json(self._notes).get("remarks")
        sentences = note.get("sentences") if isinstance(note, dict) and note.get("dataset") == self.key(self.dataset) else None
        return [str(sentence) for sentence in sentences] if isinstance(sentences, list) else []

    def note_of(self, version: Path) -> dict[str, Any]:
        """The facts that `remember` recorded about a version; {} where there are none, as for a stopped training. Never raises."""
        found = cached_json(self._notes).get(self.key(version))
        return found if isinstance(found, dict) else {}

    def notes(self) -> dict[str, Any]:
        """The facts about each step's result, by step; for 'field' and 'scene' about the version in use. Never raises."""
        notes = {key: value for key, value in cached_json(self._notes).items() if isinstance(value, dict)}
        for step in VERSIONS:
            if known := self.note_of(self.in_use(step)):
                notes[step] = known
            else:
                notes.pop(step, None)
        return notes


def no_dataset(project: Project, name: str = "") -> str:
    """A sentence that says why the folder to train on is no dataset; '' where it is one. name: shown in place of its path."""
    if project.has("dataset"):
        return ""
    return f"{name or project.dataset} holds no dataset: no transforms.json, poses_bounds.npy, COLMAP model or other known export is there"


def project_of(scene: bpy.types.Scene) -> Project:
    """The project of a scene."""
    folder = project_folder(scene)
    return Project(folder, absolute_path(scene.snerg.dataset, scene) if scene.snerg.dataset else folder / "dataset")


def remember(project: Project, step: str, folder: Path, facts: dict[str, Any], **more: Any) -> None:
    """Record a result in `folder`: the strings, numbers and booleans among `facts`, the JSON values `more`, and its size in bytes.

    A version of 'field' or 'scene' is in use from now on. Raises SnergError when the project cannot be written.
    """
    simple = {key: value for key, value in facts.items() if isinstance(value, str | int | float | bool)}
    noted = {**simple, **more, "bytes": folder_bytes(folder)}
    if step in VERSIONS:
        project.note(project.key(folder), noted)
        project.use(step, folder)
    else:
        project.note(step, noted)
