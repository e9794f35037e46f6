"""Which datasets outside a project were imported or trained on: notes in the project's status.json."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from .project import Project

KEY = "dataset "  # before the path of such a dataset, among the project's notes


def note_dataset(project: Project, path: Path, facts: dict[str, Any]) -> None:
    """Record that a dataset outside the project was imported or trained on. Raises SnergError when the folder cannot be written."""
    if path == project.own_dataset:
        return
    known = noted_datasets(project).get(path, {})
    with suppress(ValueError):  # on another drive
        known = {**known, "relative": Path(os.path.relpath(path, project.folder)).as_posix()}
    project.note(f"{KEY}{path.as_posix()}", {**known, **facts})


def noted_datasets(project: Project) -> dict[Path, dict[str, Any]]:
    """The facts about each dataset outside the project that was recorded, the oldest first. Never raises.

    One that is not at its path any more is at the same place relative to the project: both were moved together.
    """
    found = {}
    for key, facts in project.notes().items():
        if key.startswith(KEY):
            path = Path(key.removeprefix(KEY))
            found[path if path.exists() else Path(os.path.normpath(project.folder / str(facts.get("relative", ""))))] = facts
    return found
