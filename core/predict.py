"""Which effects a path calls for: `snerg effects`."""

from __future__ import annotations

from pathlib import Path

from .capture.dataset import read_dataset
from .describe import Result, any_field, any_scene, kind_of
from .export.scene import PNG, codec_of, is_float, is_scene
from .progress import Progress, silent
from .study.effects import Effect, of_dataset, of_field, of_scene


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
        return of_field(any_field(path))
    snerg, folder = any_scene(path), path / "scene" if kind == "page" else path
    stored = not is_float(snerg) and is_scene(folder)
    return of_scene(snerg, codec_of(folder) if stored else PNG if kind == "reference scene" else None)


def effects_text(result: Result) -> str:
    """The effects for people, a paragraph each."""
    lines = []
    for value in result["effects"]:
        chosen = ("yes" if value["chosen"] else "no") if isinstance(value["chosen"], bool) else value["chosen"]
        said = ", as the settings say" if value["overridden"] else ""
        lines += [
            f"{value['effect']}: {chosen}{said}. {value['evidence']}",
            f"    costs: {value['costs']} Left out, it saves: {value['saves']}",
        ]
    return "\n".join(lines)
