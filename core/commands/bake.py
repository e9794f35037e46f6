"""`snerg bake`: bakes a field inside a box into a scene."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..artifact import Result
from ..baking.bake import BakeSettings, check_voxel_size
from ..data.dataset import Dataset
from ..data.load import read_dataset
from ..errors import SnergError
from ..export.codecs import PNG, CodecSettings
from ..export.scene_files import check_storable, write_scene
from ..geometry.box import Box
from ..io.files import discard
from ..io.lock import writes_out
from ..nerf.checkpoint import read_field
from ..progress import Progress, silent, within
from ..training.provenance import options_of, trained
from .info import info

if TYPE_CHECKING:
    from ..nerf.field import Field
from ..baking.bake_field import bake_field
from ..baking.finish import Finishing
from .check_out import check_out
from .command import Command
from .options import add_bake_options, add_codec_options, artifact, codec_settings, path

DEFAULT_BAKE = BakeSettings()


@writes_out("a bake")
def bake_scene(
    field: Path,
    out: Path,
    settings: BakeSettings = DEFAULT_BAKE,
    box: Path | None = None,
    refine: bool = True,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
    fit: bool = False,
    prune: float = 0.0,
) -> Result:
    """Bake a field inside a box into a scene (JAX), then finish it on the training images.

    box: a JSON file (see Box.from_json); the field's whole domain when None. refine: fine-tune the view-dependence network. fit, prune:
    see Finishing. Raises SnergError on bad input, and for settings that change nothing in this field; Cancelled when `progress` does.
    Then `out` is as it was, and what the bake itself finished lies in a folder beside it (.NAME.bake), from which the same bake resumes.
    """
    check_out(out, "scene", field)
    check_storable(settings.quantise, codec)
    source = read_field(field)
    check_settings(settings, source)
    volume = Box.read(box) if box is not None else source.domain.world_box()
    finishing = Finishing(refine and settings.network, fit, prune)
    dataset = training_images(source, finishing)
    unfinished = out.absolute().with_name(f".{out.absolute().name}.bake")
    snerg, seconds = bake_field(source, volume, settings, dataset, progress, unfinished, finishing, codec.half_features)
    write_scene(snerg, out, within(progress, 0.97, 1.0), codec)
    discard(unfinished)
    about = snerg.about
    done = {"refined": "psnr_after" in about.get("refine", {}), "fitted": "psnr_after" in about.get("fit", {})}
    result = {"seconds": seconds, **done, **info(out)}
    return result | ({"warning": about["bake"]["warning"]} if "warning" in about.get("bake", {}) else {})


def check_settings(settings: BakeSettings, field: Field) -> None:
    """Raise SnergError for settings that the field cannot be baked with, or that change nothing in it."""
    check_voxel_size(settings, field)
    if not settings.network and field.network is None:
        raise SnergError("The field is diffuse: it has no network to leave out; bake it without --no-network.")
    if not settings.visibility and not field.cameras:
        raise SnergError("The field has no cameras, so that nothing is culled; bake it without --no-visibility.")


def training_images(field: Field, finishing: Finishing) -> Dataset | None:
    """The images that a field was trained on; None where the finishing does not need them.

    Raises SnergError where they are missing, and where an imported field has none to be fitted to or pruned by.
    """
    stages = finishing.stages(field.network is not None)
    if not field.dataset and ("fit" in stages or "prune" in stages):
        raise SnergError("The field was imported, and does not say what it was trained on; bake it without --fit and --prune.")
    if not stages or not field.dataset:
        return None
    if not Path(field.dataset).exists():
        instead = "with --no-refine" if stages == ("refine",) else "with --no-refine and without --fit and --prune"
        raise SnergError(f"The dataset that the field was trained on is no longer at {field.dataset}; put it back, or bake {instead}.")
    return read_dataset(Path(field.dataset), "train", options_of(trained(field.about)))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg bake`."""
    parser.add_argument("field", type=artifact, metavar="FIELD")
    parser.add_argument("--out", type=path, required=True, metavar="SCENE")
    add_bake_options(parser)
    add_codec_options(parser, "png")
    compared = parser.add_argument_group("ablations", "Each leaves out a part of the method, as in the tables of the paper.")
    compared.add_argument("--no-visibility", dest="visibility", action="store_false", help="keep voxels that no camera sees")
    compared.add_argument("--no-network", dest="network", action="store_false", help="no view dependence: store no features")
    compared.add_argument("--float", dest="quantise", action="store_false", help="32 bits a value in place of 8")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg bake`."""
    settings = BakeSettings(
        resolution=options.resolution,
        supersampling=options.samples,
        voxel_size=options.voxel_size,
        visibility=options.visibility,
        quantise=options.quantise,
        network=options.network,
    )
    codec = codec_settings(options) or PNG
    refine, fit, prune = options.refine, options.fit, options.prune
    return bake_scene(options.field, options.out, settings, options.box, refine, progress, codec, fit, prune)


COMMAND = Command("bake", "bake a field into a scene", add_options, run)
