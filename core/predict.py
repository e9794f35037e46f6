"""What a path calls for, and what the next stage will take: `snerg effects` and `snerg estimate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .capture.dataset import DatasetOptions, read_dataset
from .describe import Result, any_field, any_scene, kind_of
from .errors import SnergError, needs_jax
from .export.scene import PNG, codec_of, is_scene
from .field.settings import TrainSettings
from .grid.bake import BakeSettings
from .grid.box import Box
from .progress import Progress, silent
from .study.effects import Effect, of_dataset, of_field, of_scene

if TYPE_CHECKING:
    from .study.survey import Survey

USUAL = BakeSettings()
EIGHTH = DatasetOptions()


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
    stored = snerg.quantised and is_scene(folder)
    return of_scene(snerg, codec_of(folder) if stored else PNG if kind == "reference scene" else None)


def effects_text(result: Result) -> str:
    """The effects for people, a paragraph each."""
    lines = []
    for value in result["effects"]:
        effect = Effect.from_json(value)
        lines += [effect.decision.text(), f"    costs: {effect.costs} Left out, it saves: {effect.saves}"]
    return "\n".join(lines)


def estimate(
    path: Path,
    training: TrainSettings,
    settings: BakeSettings = USUAL,
    box: Path | None = None,
    refine: bool = True,
    size: tuple[int, int] = (800, 800),
    options: DatasetOptions = EIGHTH,
    survey: Path | None = None,
    progress: Progress = silent,
) -> Result:
    """What training a dataset, or baking, exporting and previewing a field will take on this machine (JAX).

    survey: a file where the look at a field is kept, and found again as long as the field is the same.
    Raises SnergError when the path is neither, or the field cannot be baked.
    """
    kind = kind_of(path)
    if kind not in ("dataset", "field", "checkpoint"):
        raise SnergError(f"{path} is a {kind}, which is baked already; give a dataset or a field.")
    with needs_jax():
        import jax  # noqa: F401  # what is timed is compiled
    if kind == "dataset":
        from .study.estimate import training as train

        return {"kind": kind, "path": str(path), **train(read_dataset(path, "train", options), training)}
    from .study.estimate import estimate as bake

    volume = Box.read(box) if box is not None else None
    looked = _looked(path, survey, progress)
    told = bake(looked, volume or looked.field.domain.world_box(), settings, refine, size)
    return {"kind": kind, "path": str(path), "survey_seconds": round(looked.seconds, 2), **told.to_json()}


def _looked(path: Path, kept: Path | None, progress: Progress) -> Survey:
    """The survey of a field: the one that is kept, or a new one, which then is."""
    from .study.kept_survey import check_survey, read_survey, stamp, write_survey
    from .study.survey import survey

    if kept is not None:
        check_survey(kept)
    mark, field = stamp(path), any_field(path)
    looked = read_survey(kept, mark, lambda: field) if kept is not None else None
    if looked is None:
        progress(0.1, "Looking at the field")
        looked = survey(field)
        if kept is not None:
            write_survey(kept, looked, mark)
    return looked
