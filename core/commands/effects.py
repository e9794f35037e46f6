"""`snerg effects`: the optional effects of a dataset, a field or a scene, with the evidence for each."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..artifact import Result, kind_of, open_field, open_scene
from ..data.load import read_dataset
from ..export.codecs import PNG
from ..export.scene_files import codec_of, is_scene
from ..progress import Progress, silent
from ..study.effects import Effect, of_dataset, of_field, of_scene
from .command import Command
from .options import artifact


def effects(path: Path, progress: Progress = silent) -> Result:
    """The optional effects of what is at a path: {"kind", "path", "effects": values of Effect.to_json}.

    Raises SnergError when it is not a dataset, field, checkpoint or scene, or its images cannot be read.
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
    """The effects in words, two lines each. result: of `effects`."""
    lines = []
    for value in result["effects"]:
        effect = Effect.from_json(value)
        lines += [effect.decision.text(), f"    costs: {effect.costs} Left out, it saves: {effect.saves}"]
    return "\n".join(lines)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg effects`."""
    parser.add_argument("path", type=artifact, metavar="PATH")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg effects`."""
    return effects(options.path, progress)


COMMAND = Command("effects", "list which optional effects a scene needs, and why", add_options, run, effects_text)
