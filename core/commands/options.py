"""Options that several commands share, and the types of arguments."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from ..artifact import artifact_at
from ..baking.bake import AUTO_SUPERSAMPLING, BakeSettings
from ..baking.finish import Finishing
from ..data.dataset import DatasetOptions
from ..errors import SnergError
from ..export.codecs import LOSSLESS, SUFFIXES, CodecSettings
from ..rendering.render import MarchSettings

LONGEST_PATH = 2**15  # characters, Windows' limit


def path(text: str) -> Path:
    """A path no longer than LONGEST_PATH. Raises argparse.ArgumentTypeError otherwise."""
    if len(text) > LONGEST_PATH:
        raise argparse.ArgumentTypeError(f"a path of {len(text)} characters is longer than any system has")
    return Path(text)


def artifact(text: str) -> Path:
    """The path of a dataset, field or scene; given as one of its files, that of its folder. Raises as `path` does."""
    return artifact_at(path(text))


def count(text: str) -> int:
    """An integer of 1 or more. Raises argparse.ArgumentTypeError or ValueError otherwise."""
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text} must be 1 or more")
    return value


def natural(text: str) -> int:
    """An integer of 0 or more. Raises argparse.ArgumentTypeError or ValueError otherwise."""
    if (value := int(text)) < 0:
        raise argparse.ArgumentTypeError(f"{text} must be 0 or more")
    return value


def positive(text: str) -> float:
    """A finite number above 0. Raises argparse.ArgumentTypeError or ValueError otherwise."""
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} must be a number above 0")
    return value


def fraction(text: str) -> float:
    """A number in [0, 1]. Raises argparse.ArgumentTypeError or ValueError otherwise."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} must be a number from 0 to 1")
    return value


def samples(text: str) -> int:
    """Samples a voxel: an integer of 0 or more, or 'auto'. Raises argparse.ArgumentTypeError or ValueError otherwise."""
    return AUTO_SUPERSAMPLING if text == "auto" else natural(text)


def add_dataset_options(parser: argparse.ArgumentParser, defaults: DatasetOptions | None) -> None:
    """Add --holdout and --downscale. defaults: None where those of the field's training are used."""
    holdout, downscale = ("as in training",) * 2 if defaults is None else (defaults.holdout, defaults.downscale)
    parser.add_argument("--holdout", type=natural, metavar="N", help=f"hold out every n-th view; 0: none (default: {holdout})")
    parser.add_argument("--downscale", type=count, metavar="N", help=f"divide the images' width and height by N (default: {downscale})")
    if defaults is not None:
        parser.set_defaults(holdout=defaults.holdout, downscale=defaults.downscale)


def add_bake_options(parser: argparse._ActionsContainer) -> None:
    """Add the options of a bake that `bake` and `estimate` share."""
    default, voxels = BakeSettings(), parser.add_mutually_exclusive_group()
    voxels.add_argument(
        "--resolution", type=count, default=default.resolution, metavar="N", help="voxels along the longest side (default: %(default)s)"
    )
    voxels.add_argument("--voxel-size", type=positive, metavar="SIZE", help="in units of the scene, in place of the resolution")
    parser.add_argument("--box", type=path, metavar="BOX.json", help='{"min": [x, y, z], "max": [x, y, z]}, or an oriented box')
    parser.add_argument(
        "--samples",
        type=samples,
        default=default.supersampling,
        metavar="K",
        help="samples a voxel; auto (default): doubled until the error stops falling",
    )
    parser.add_argument("--no-refine", dest="refine", action="store_false", help="do not fine-tune the view-dependence network")
    parser.add_argument("--fit", action="store_true", help="fit the voxels to the training images: higher quality, most on coarse grids")
    parser.add_argument(
        "--prune",
        type=fraction,
        default=Finishing.prune,
        metavar="SHARE",
        help="drop voxels with a smaller share of every training pixel, such as 0.004: fewer bytes (default: %(default)g, none)",
    )


def add_codec_options(parser: argparse._ActionsContainer, default: str) -> None:
    """Add --codec and --quality. default: of the codec, as the help shows it."""
    parser.add_argument(
        "--codec", choices=tuple(SUFFIXES), help=f"of the scene's images; png, webp and jxl are lossless (default: {default})"
    )
    parser.add_argument("--quality", type=count, metavar="Q", help=f"of lossy codecs, 1 to 100 (default: {CodecSettings.quality})")
    parser.add_argument(
        "--half-features", action="store_true", help="store features at half the resolution, in a sixth of their bytes; needs --codec"
    )


def codec_settings(options: argparse.Namespace) -> CodecSettings | None:
    """The codec of parsed options, None where none is given. Raises SnergError for a quality without a lossy codec, and for half_features
    without a codec."""
    if options.quality is not None and options.codec in (None, *LOSSLESS):
        raise SnergError("A quality needs a lossy codec; give --codec jpeg, avif or h264 with it.")
    if options.codec is None:
        if options.half_features:
            raise SnergError("--half-features needs a codec; give --codec webp with it, for instance.")
        return None
    quality = CodecSettings.quality if options.quality is None else options.quality
    return CodecSettings(options.codec, quality, options.half_features)


def add_march_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ray marching that `eval` and `render` share."""
    default = MarchSettings()
    parser.add_argument(
        "--tolerance",
        type=fraction,
        default=default.tolerance,
        metavar="E",
        help="largest error of a pixel's value, 0 to 1 (default: %(default)s)",
    )
    parser.add_argument(
        "--per-sample-network", action="store_true", help="evaluate view dependence at every sample, not once a pixel, for comparison"
    )


def march_settings(options: argparse.Namespace) -> MarchSettings:
    """The settings of parsed options."""
    return MarchSettings(tolerance=options.tolerance, per_sample_network=options.per_sample_network)
