"""`snerg estimate`: what training or baking will take on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..artifact import Result, kind_of, open_field
from ..baking.bake import BakeSettings
from ..data.dataset import DatasetOptions
from ..data.load import DEFAULT_OPTIONS, read_dataset
from ..errors import SnergError, needs_jax
from ..geometry.box import Box
from ..progress import Progress, silent
from ..training.config import TrainSettings

if TYPE_CHECKING:
    from ..study.field_probe import FieldProbe


DEFAULT_BAKE = BakeSettings()


def estimate(
    path: Path,
    training: TrainSettings,
    settings: BakeSettings = DEFAULT_BAKE,
    box: Path | None = None,
    refine: bool = True,
    size: tuple[int, int] = (800, 800),
    options: DatasetOptions = DEFAULT_OPTIONS,
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
        from ..study.cost_model import training as train

        return {"kind": kind, "path": str(path), **train(read_dataset(path, "train", options), training)}
    from ..study.cost_model import estimate as bake

    volume = Box.read(box) if box is not None else None
    looked = _looked(path, survey, progress)
    told = bake(looked, volume or looked.field.domain.world_box(), settings, refine, size)
    return {"kind": kind, "path": str(path), "survey_seconds": round(looked.seconds, 2), **told.to_json()}


def _looked(path: Path, kept: Path | None, progress: Progress) -> FieldProbe:
    """The survey of a field: the one that is kept, or a new one, which then is."""
    from ..study.field_probe import survey
    from ..study.field_probe_file import check_survey, read_survey, stamp, write_survey

    if kept is not None:
        check_survey(kept)
    mark, field = stamp(path), open_field(path)
    looked = read_survey(kept, mark, lambda: field) if kept is not None else None
    if looked is None:
        progress(0.1, "Looking at the field")
        looked = survey(field)
        if kept is not None:
            write_survey(kept, looked, mark)
    return looked
