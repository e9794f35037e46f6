"""`snerg train`: a dataset to a field."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..artifact import Result
from ..data.dataset import DatasetOptions
from ..data.load import DEFAULT_OPTIONS, read_dataset
from ..errors import SnergError, needs_jax
from ..io.files import folder_bytes
from ..io.generation import one_generation
from ..io.lock import one_writer
from ..nerf.checkpoint import read_field
from ..progress import Note, Progress, silent
from ..training.config import PRESETS, TrainSettings, suited_to_time
from ..training.config_values import with_values
from ..training.training_folder import FINISHED, NEW, UNFINISHED, finish, training_folder

if TYPE_CHECKING:
    from ..nerf.field import Field
from .check_out import check_out


def train_field(
    dataset: Path,
    out: Path,
    preset: str = "fast",
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    options: DatasetOptions = DEFAULT_OPTIONS,
    values: Mapping[str, str] | None = None,
    progress: Progress = silent,
) -> Result:
    """Train a field on a dataset's train split (JAX); an unfinished training with the same settings goes on where it stopped.

    minutes or steps: how long; the preset's own time when neither is given. options: how to read the dataset. values:
    settings by name, in place of the preset's (see with_values). Another field at `out` stays there until this training is
    finished, and takes place beside it until then (see training_folder). Raises SnergError on bad input or when the training
    goes wrong, Cancelled when `progress` does; then the field as far as it got is kept, to go on with.
    """
    check_out(out, "field", dataset)
    settings = settings_of(preset, minutes, steps, seed, values or {})
    with needs_jax():
        from ..training.trainer import train, writes
    with one_writer(out, "a training") if writes() else nullcontext():
        views = read_dataset(dataset, "train", options)
        folder, state = training_folder(out, settings, views)
        if folder != out and state != FINISHED:
            progress(0.0, Note(f"{out} holds another field, which stays as it is until this training is finished."))
        field = read_field(folder) if state == FINISHED else train(views, settings, folder, progress, resume=state == UNFINISHED)
        if folder != out and writes():
            finish(folder, out)
        return _trained(out, field, len(views.views), resumed=state != NEW)


def _trained(out: Path, field: Field, views: int, resumed: bool) -> Result:
    """What there is to say of a training."""
    about = field.about
    return {
        "field": str(out),
        "views": views,
        "resumed": resumed,
        "steps": about.get("steps"),
        "seconds": about.get("seconds"),
        "psnr": about.get("psnr_training_rays"),
        "psnr_held_out": about.get("psnr_held_out_rays"),
        "view_dependence": field.view,
        "ndc": field.ndc is not None,
        "decisions": about.get("decisions", []),
        "bytes": one_generation(out, lambda: folder_bytes(out)),
    }


def settings_of(preset: str, minutes: float | None, steps: int | None, seed: int, values: Mapping[str, str]) -> TrainSettings:
    """A preset with some settings changed. Raises SnergError on a name or a value that there is not."""
    if preset not in PRESETS:
        raise SnergError(f"There is no preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    settings = replace(PRESETS[preset], seed=seed)
    if steps is not None:
        settings = replace(settings, steps=steps, seconds=None)
    elif minutes is not None:
        settings = replace(settings, steps=None, seconds=60 * minutes)
    return with_values(suited_to_time(settings), values)
