"""`snerg train`: trains a field on a dataset."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..artifact import Result
from ..data.dataset import Dataset, DatasetOptions
from ..data.load import DEFAULT_OPTIONS, read_dataset
from ..errors import SnergError, needs_jax
from ..io.files import folder_bytes
from ..io.generation import one_generation
from ..io.lock import one_writer
from ..nerf.checkpoint import read_field
from ..nerf.model import VIEWS
from ..progress import Note, Progress, silent
from ..training.config import FINEST_SPACING, PRESETS, TrainSettings, suited
from ..training.config_values import with_values
from ..training.decisions import pixel_size
from ..training.devices import connect
from ..training.training_folder import FINISHED, NEW, UNFINISHED, finish, training_folder

if TYPE_CHECKING:
    from ..nerf.field import Field
from .check_out import check_out
from .command import Command
from .options import add_dataset_options, artifact, count, natural, path, positive
from .training_preview import training_preview


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
    preview: bool = False,
) -> Result:
    """Train a field on a dataset's train split (JAX); an unfinished training with the same settings goes on where it stopped.

    minutes or steps: how long; the preset's own time when neither is given. options: how to read the dataset. values:
    settings by name, in place of the preset's (see with_values). Another field at `out` stays there until this training is
    finished, and takes place beside it until then (see training_folder). preview: keep a coarse bake of the field so far in the
    training's folder while it runs (see training_preview). Raises SnergError on bad input or when the training
    goes wrong, Cancelled when `progress` does; then the field as far as it got is kept, to go on with.
    """
    check_out(out, "field", dataset)
    settings_of(preset, minutes, steps, seed, values or {})  # errors before the images are read
    with needs_jax():
        from ..training.trainer import train, writes
    with one_writer(out, "a training") if writes() else nullcontext():
        views = read_dataset(dataset, "train", options)
        settings = settings_of(preset, minutes, steps, seed, values or {}, pixel_size(views))
        for note in views.remarks():
            progress(0.0, Note(note))
        folder, state = training_folder(out, settings, views)
        if folder != out and state != FINISHED:
            progress(0.0, Note(f"{out} holds another field, which stays as it is until this training is finished."))
        if state == FINISHED:
            field = read_field(folder)
        else:
            with training_preview(folder, preview, progress) if writes() else nullcontext() as show:
                field = train(views, settings, folder, progress, resume=state == UNFINISHED, preview=show)
        if folder != out and writes():
            finish(folder, out)
        return _trained(out, field, dataset, views, resumed=state != NEW)


def _trained(out: Path, field: Field, dataset: Path, views: Dataset, resumed: bool) -> Result:
    """The result of `train_field`."""
    about = field.about
    return {
        "field": str(out),
        "dataset": str(dataset),
        "views": len(views.views),
        "remarks": views.remarks(),
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


def settings_of(
    preset: str, minutes: float | None, steps: int | None, seed: int, values: Mapping[str, str], pixel: float = FINEST_SPACING
) -> TrainSettings:
    """The settings of a preset with other values. pixel: see `suited`. Raises SnergError on unknown names and wrong values."""
    if preset not in PRESETS:
        raise SnergError(f"There is no preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    settings = replace(PRESETS[preset], seed=seed)
    if steps is not None:
        settings = replace(settings, steps=steps, seconds=None)
    elif minutes is not None:
        settings = replace(settings, steps=None, seconds=60 * minutes)
    return with_values(suited(settings, pixel), values)


def background(text: str) -> str:
    """'white', 'black' or 'random' as given, or 'R,G,B' from 0 to 255 as '#rrggbb'. Raises argparse.ArgumentTypeError otherwise."""
    parts = text.split(",")
    if len(parts) == 1:
        return text
    values = [int(part) for part in parts]
    if len(values) != 3 or not all(0 <= value <= 255 for value in values):
        raise argparse.ArgumentTypeError(f"{text} must be three numbers from 0 to 255")
    return "#{:02x}{:02x}{:02x}".format(*values)


def assignment(text: str) -> tuple[str, str]:
    """(name, value) of 'NAME=VALUE'. Raises argparse.ArgumentTypeError otherwise."""
    name, sign, value = text.partition("=")
    if not sign or not name.strip():
        raise argparse.ArgumentTypeError(f"{text} must be NAME=VALUE")
    return name.strip(), value


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg train`."""
    parser.add_argument("dataset", type=artifact, metavar="DATASET", help="folder of a capture (see docs/captures.md)")
    parser.add_argument("--out", type=path, required=True, metavar="FIELD")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="fast", help="kind of field and its settings (default: %(default)s)")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=positive, metavar="M", help="how long to train")
    length.add_argument("--steps", type=count, metavar="N", help="how many steps to train")
    parser.add_argument("--seed", type=natural, default=0, metavar="S", help="of all random numbers (default: %(default)s)")
    parser.add_argument("--view-dependence", choices=("auto", *VIEWS), help="how colours depend on the view direction (default: auto)")
    parser.add_argument("--background", type=background, metavar="COLOUR", help="white, black, random or R,G,B (0 to 255) behind alpha")
    parser.add_argument(
        "--ndc", choices=("auto", "on", "off"), help="normalised device coordinates, for forward-facing captures (default: auto)"
    )
    add_dataset_options(parser, DatasetOptions())
    parser.add_argument("--set", type=assignment, action="append", default=[], metavar="NAME=VALUE", help="any other setting, by its name")
    parser.add_argument(
        "--preview",
        action="store_true",
        help="keep a coarse bake of the field so far in FIELD/preview while training; costs under 5%% of the time",
    )
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="of process 0, where several processes train together")
    parser.add_argument("--processes", type=count, default=1, metavar="N", help="number of processes that train together")
    parser.add_argument("--process", type=natural, default=0, metavar="I", help="index of this process, from 0")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg train`. Raises SnergError for several processes without a coordinator, and for unknown settings."""
    if options.coordinator is None and (options.processes, options.process) != (1, 0):
        raise SnergError("Several processes need to meet; give --coordinator HOST:PORT, the same for each.")
    named = {name: getattr(options, name) for name in ("view_dependence", "background", "ndc")}
    values = dict(options.set) | {name: value for name, value in named.items() if value is not None}
    settings_of(options.preset, options.minutes, options.steps, options.seed, values)  # errors before other processes wait for this one
    if options.coordinator is not None:
        connect(options.coordinator, options.processes, options.process)
    reading = DatasetOptions(options.holdout, options.downscale)
    return train_field(
        options.dataset,
        options.out,
        options.preset,
        options.minutes,
        options.steps,
        options.seed,
        reading,
        values,
        progress,
        options.preview,
    )


COMMAND = Command("train", "train a field on a dataset", add_options, run)
