"""`snerg effects`: which optional effects a dataset, a field or a scene calls for, and why."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..artifact import Result, kind_of, open_field, open_scene
from ..data.load import read_dataset
from ..export.scene_files import PNG, codec_of, is_scene
from ..progress import Progress, silent
from ..study.effects import Effect, of_dataset, of_field, of_scene
from .command import Command
from .options import path as path_argument


def effects(path: Path, progress: Progress = silent) -> Result:
    """{"kind", "path", "effects"}: each optional effect of a dataset, field, checkpoint or scene, as Effect.to_json.

    Raises SnergError when it is none of these, or its images cannot be read.
    """
    kind = kind_of(path)
    return {"kind": kind, "path": str(path), "effects": [effect.to_json() for effect in _found(path, kind, progress)]}


def _found(path: Path, kind: str, progress: Progress) -> list[Effect]:
    if kind == "dataset":
        return of_dataset(read_dataset(path), progress)
    if kind in ("field", "checkpoint"):
        return of_field(open_field(path))
    snerg, folder = open_scene(path), path / "scene" if kind == "page" else path
    stored = snerg.quantised and is_scene(folder)
    return of_scene(snerg, codec_of(folder) if stored else PNG if kind == "reference scene" else None)


def effects_text(result: Result) -> str:
    """The effects for people, a paragraph each."""
    lines = []
    for value in result["effects"]:
        effect = Effect.from_json(value)
        lines += [effect.decision.text(), f"    costs: {effect.costs} Left out, it saves: {effect.saves}"]
    return "\n".join(lines)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg effects`."""
    parser.add_argument("path", type=path_argument, metavar="PATH")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg effects`."""
    return effects(options.path, progress)


COMMAND = Command("effects", "list which optional effects a scene needs, and why", add_options, run, effects_text)
