"""`snerg estimate`: what training or baking will take on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..artifact import Result, kind_of, open_field
from ..baking.bake import BakeSettings
from ..baking.finish import DEFAULT_FINISHING, Finishing
from ..data.dataset import DatasetOptions
from ..data.load import DEFAULT_OPTIONS, read_dataset
from ..errors import SnergError, needs_jax
from ..export.codecs import LOSSLESS, PNG, CodecSettings
from ..geometry.box import Box
from ..progress import Progress, silent, within
from ..training.config import PRESETS, TrainSettings
from .command import Command, table
from .options import add_bake_options, add_codec_options, artifact, codec_settings, count, positive
from .options import path as path_argument
from .train import settings_of

if TYPE_CHECKING:
    from ..study.field_probe import FieldProbe


DEFAULT_BAKE = BakeSettings()


def estimate(
    path: Path,
    training: TrainSettings,
    settings: BakeSettings = DEFAULT_BAKE,
    box: Path | None = None,
    finishing: Finishing = DEFAULT_FINISHING,
    size: tuple[int, int] = (800, 800),
    options: DatasetOptions = DEFAULT_OPTIONS,
    probe: Path | None = None,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
) -> Result:
    """The estimated time and memory of training a dataset, or of baking, storing and previewing a field, on this machine (JAX).

    size: pixels of the preview (width, height). probe: a file that keeps the field probe; it is used again while the field and the
    machine are the same. Returns JSON values: of a dataset as `training_cost.training`, of a field as `Estimate.to_json`.
    codec: of the scene's images. Raises SnergError when the path is neither, the field cannot be baked, or the codec is lossy.
    """
    if not codec.lossless:
        raise SnergError(f"The size of a scene as {codec.text} is not estimated: it depends on the images; choose {', '.join(LOSSLESS)}.")
    kind = kind_of(path)
    if kind not in ("dataset", "field", "checkpoint"):
        raise SnergError(f"{path} is a {kind}, which is baked already; give a dataset or a field.")
    with needs_jax():
        import jax  # noqa: F401  # timing compiles
    from ..study import cost_model, training_cost

    if kind == "dataset":
        return {"kind": kind, "path": str(path), **training_cost.training(read_dataset(path, "train", options), training)}
    found = _field_probe(path, probe, progress)
    volume = Box.read(box) if box is not None else found.field.domain.world_box()
    result = cost_model.estimate(found, volume, settings, finishing, size, codec=codec)
    return {"kind": kind, "path": str(path), "survey_seconds": round(found.seconds, 2), **result.to_json()}


def _field_probe(path: Path, kept: Path | None, progress: Progress) -> FieldProbe:
    """The field probe in the file `kept`, where it is of this field; else a new one, which is written there."""
    from ..study.field_probe import probe_field
    from ..study.field_probe_file import check_field_probe, read_field_probe, stamp, write_field_probe

    if kept is not None:
        check_field_probe(kept)
    mark, field = stamp(path), open_field(path)
    probe = read_field_probe(kept, mark, lambda: field) if kept is not None else None
    if probe is None:
        probe = probe_field(field, progress=within(progress, 0.1, 1.0))
        if kept is not None:
            write_field_probe(kept, probe, mark)
    return probe


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg estimate`."""
    parser.add_argument("path", type=artifact, metavar="DATASET_OR_FIELD")
    baked = parser.add_argument_group("of a field", "What a bake, its files and a preview take.")
    add_bake_options(baked)
    add_codec_options(baked, "png")
    baked.add_argument(
        "--probe", "--survey", type=path_argument, metavar="FILE", help="where the field probe is kept for the next estimate"
    )
    baked.add_argument("--width", type=count, default=800, metavar="W", help="pixels of the preview (default: %(default)s)")
    baked.add_argument("--height", type=count, default=800, metavar="H", help="(default: %(default)s)")
    trained = parser.add_argument_group("of a dataset", "What a training takes.")
    trained.add_argument("--preset", choices=tuple(PRESETS), default="fast", help="(default: %(default)s)")
    trained.add_argument("--minutes", type=positive, metavar="M", help="of training: estimate its steps")
    trained.add_argument("--steps", type=count, metavar="N", help="of training: estimate its time")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg estimate`."""
    training = settings_of(options.preset, options.minutes, options.steps, 0, {})
    settings = BakeSettings(resolution=options.resolution, voxel_size=options.voxel_size, supersampling=options.samples)
    size = options.width, options.height
    finishing, codec = Finishing(options.refine, options.fit, options.prune), codec_settings(options) or PNG
    return estimate(options.path, training, settings, options.box, finishing, size, probe=options.probe, progress=progress, codec=codec)


def text(result: Result) -> str:
    """The table, in which the times of the preview are named as such."""
    return table({f"{key}_seconds" if key in ("preview", "tables") else key: value for key, value in result.items()})


COMMAND = Command("estimate", "estimate the time and memory of a training or a bake on this machine", add_options, run, text)
