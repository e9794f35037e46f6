"""The command line: `snerg VERB` outside Blender, `blender --command snerg VERB` inside, and the jobs that operators start.

Progress goes to standard error. With --json the last line of standard output is one JSON object. Exit codes: 0; 2 with
one sentence on standard error when something is wrong with the input; 130 when stopped from the keyboard.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn, TextIO, cast

from .baking.bake import AUTO_SUPERSAMPLING, BakeSettings
from .commands.bake import bake_scene
from .commands.bundle import bundle_scene
from .commands.effects import effects, effects_text
from .commands.estimate import estimate
from .commands.export import export_reference
from .commands.export_vdb import export_vdb
from .commands.import_artifact import import_source
from .commands.info import info
from .commands.render import render_views
from .commands.train import settings_of, train_field
from .data.dataset import DatasetOptions
from .errors import EXIT_ERROR, EXIT_STOPPED, SnergError, clean, needs_jax, printable
from .export.codecs import LOSSLESS, PNG, SUFFIXES, CodecSettings
from .jobs import interrupt
from .jobs.protocol import run_job
from .jobs.task import Outcome
from .nerf.model import VIEWS
from .progress import Progress, ProgressEvent
from .rendering.render import MarchSettings
from .study.evaluate import evaluate
from .study.pareto import Target
from .study.plan import StudySettings
from .training.config import PRESETS
from .training.devices import connect, device_report

LONGEST_PATH = 2**15  # characters, Windows' limit
EVERY_SECONDS = 5.0  # between lines of progress where they cannot be written over
Work = Callable[[argparse.Namespace, Progress], dict[str, Any]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code. arguments: without the program's name; those of the process when None.

    Called in the main thread it listens to Ctrl-C, and ends the process when the work does not stop within a second of it.
    """
    try:
        options = parser().parse_args(sys.argv[1:] if arguments is None else list(arguments))
    except SystemExit as end:  # --help, or arguments that make no sense: inside Blender the process must go on
        return int(end.code or 0)

    def work(progress: Progress) -> dict[str, Any]:
        with refusals():
            return cast("dict[str, Any]", plain(options.work(options, progress)))

    if options.job:
        return run_job(work)
    terminal = Terminal(sys.stderr)
    try:
        result = stoppable(work, terminal)
        terminal.end()
        write_result(json.dumps(result, allow_nan=False) if options.json else options.show(result))
    except (SnergError, MemoryError) as error:
        outcome = Outcome.of_error(error)
        terminal.last(f"snerg: {outcome.error}")
        return EXIT_STOPPED if outcome.state == "cancelled" else EXIT_ERROR
    return 0


def parser() -> argparse.ArgumentParser:
    """Every verb and its options."""
    top = _Parser(prog="snerg", description="Bake radiance fields into sparse grids that render in Blender and on the web.")
    subparsers = top.add_subparsers(dest="verb", required=True, metavar="VERB", parser_class=_Parser)

    def verb(name: str, about: str, work: Work) -> argparse.ArgumentParser:
        sub = subparsers.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
        sub.add_argument("--json", action="store_true", help="print one JSON object as the last line of standard output")
        sub.add_argument("--job", action="store_true", help=argparse.SUPPRESS)
        sub.set_defaults(work=work, show=table)
        return sub

    train = verb("train", "train a field on a dataset", _train)
    train.add_argument("dataset", type=path, metavar="DATASET", help="folder with transforms.json, poses_bounds.npy or a COLMAP model")
    train.add_argument("--out", type=path, required=True, metavar="FIELD")
    train.add_argument("--preset", choices=tuple(PRESETS), default="fast", help="what to train; see the README (default: %(default)s)")
    length = train.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=positive, metavar="M", help="how long to train")
    length.add_argument("--steps", type=count, metavar="N", help="how many steps to train")
    train.add_argument("--seed", type=natural, default=0, metavar="S", help="of everything random (default: %(default)s)")
    train.add_argument("--view-dependence", choices=("auto", *VIEWS), help="how colours may change with the direction (default: auto)")
    train.add_argument("--background", type=background, metavar="COLOUR", help="white, black, random or R,G,B (0 to 255) behind alpha")
    train.add_argument("--ndc", choices=("auto", "on", "off"), help="device coordinates, for forward-facing captures (default: auto)")
    _reading(train, DatasetOptions())
    train.add_argument("--set", type=assignment, action="append", default=[], metavar="NAME=VALUE", help="any other setting, by its name")
    train.add_argument("--coordinator", metavar="HOST:PORT", help="of process 0, where several processes train together")
    train.add_argument("--processes", type=count, default=1, metavar="N", help="how many there are")
    train.add_argument("--process", type=natural, default=0, metavar="I", help="which of them this is, from 0")

    bring = verb("import", "bring in a checkpoint, field or baked scene", lambda o, p: import_source(o.source, o.out, p))
    bring.add_argument("source", type=path, metavar="SOURCE")
    bring.add_argument("--out", type=path, required=True, metavar="PATH")

    bake = verb("bake", "bake a field into a scene", _bake)
    bake.add_argument("field", type=path, metavar="FIELD")
    bake.add_argument("--out", type=path, required=True, metavar="SCENE")
    _baking(bake)
    _storing(bake, "png")
    compare = bake.add_argument_group("to compare with", "Each leaves out a part of the method, as the tables of the paper do.")
    compare.add_argument("--no-visibility", dest="visibility", action="store_false", help="keep what no camera sees")
    compare.add_argument("--no-network", dest="network", action="store_false", help="no view dependence, and no features for it")
    compare.add_argument("--float", dest="quantise", action="store_false", help="32 bits a value in place of 8")

    measure = verb("eval", "measure a field or a scene on views that training did not see", _evaluate)
    measure.add_argument("target", type=path, metavar="FIELD_OR_SCENE")
    measure.add_argument("dataset", type=path, nargs="?", metavar="DATASET", help="default: what the field was trained on")
    measure.add_argument("--dataset", type=path, dest="named_dataset", metavar="DATASET", help="the same, by name")
    measure.add_argument("--split", metavar="SPLIT", help="train, val or test (default: test, else val)")
    _reading(measure, None)
    measure.add_argument("--out", type=path, metavar="DIR", help="write the pictures there, and a sheet of them beside the truth")
    _marching(measure)

    render = verb(
        "render",
        "render a scene from cameras",
        lambda o, p: render_views(o.scene, o.cameras, o.out, o.width, o.height, p, _march(o)),
    )
    render.add_argument("scene", type=path, metavar="SCENE")
    render.add_argument("--cameras", type=path, required=True, metavar="TRANSFORMS.json")
    render.add_argument("--out", type=path, required=True, metavar="DIR")
    render.add_argument("--width", type=count, metavar="W", help="pixels, in place of the cameras' own")
    render.add_argument("--height", type=count, metavar="H")
    _marching(render)

    export = verb("export", "write a scene in the reference PNG layout", lambda o, p: export_reference(o.scene, o.out, p))
    export.add_argument("scene", type=path, metavar="SCENE")
    export.add_argument("--out", type=path, required=True, metavar="DIR")

    volume = verb("export-vdb", "write a scene as an OpenVDB volume, for Cycles and EEVEE", lambda o, p: export_vdb(o.scene, o.out, p))
    volume.add_argument("scene", type=path, metavar="SCENE")
    volume.add_argument("--out", type=path, required=True, metavar="FILE.vdb")

    bundle = verb(
        "bundle", "write a scene as a web page", lambda o, p: bundle_scene(o.scene, o.out, o.cameras, o.single_file, p, _codec(o))
    )
    bundle.add_argument("scene", type=path, metavar="SCENE")
    bundle.add_argument("--out", type=path, required=True, metavar="DIR")
    bundle.add_argument("--cameras", type=path, metavar="FILE", help="a transforms file whose cameras the page lists")
    bundle.add_argument("--single-file", action="store_true", help="one self-contained .html that opens from the disk")
    _storing(bundle, "the scene's own")

    called = verb("effects", "say which optional effects a scene calls for, and why", lambda o, p: effects(o.path, p))
    called.add_argument("path", type=path, metavar="PATH")
    called.set_defaults(show=effects_text)

    ahead = verb("estimate", "say what training a dataset, or baking a field, will take on this machine", _estimate)
    ahead.add_argument("path", type=path, metavar="DATASET_OR_FIELD")
    baking = ahead.add_argument_group("of a field", "What a bake, its files and a preview take.")
    _baking(baking)
    baking.add_argument("--survey", type=path, metavar="FILE", help="where the look at the field is kept for the next estimate")
    baking.add_argument("--width", type=count, default=800, metavar="W", help="pixels of the preview (default: %(default)s)")
    baking.add_argument("--height", type=count, default=800, metavar="H", help="(default: %(default)s)")
    learning = ahead.add_argument_group("of a dataset", "What a training takes.")
    learning.add_argument("--preset", choices=tuple(PRESETS), default="fast", help="(default: %(default)s)")
    learning.add_argument("--minutes", type=positive, metavar="M", help="how many steps so long a training has")
    learning.add_argument("--steps", type=count, metavar="N", help="how long so many steps take")

    sweep = verb("study", "measure what accuracy costs in time and bytes, and bake what a target calls for", _study)
    sweep.add_argument("source", type=path, metavar="FIELD_OR_DATASET_OR_SCENE")
    sweep.add_argument("--out", type=path, required=True, metavar="DIR", help="the report and its rows; given again, the study goes on")
    sweep.add_argument("--dataset", type=path, metavar="DATASET", help="to measure on (default: what the field was trained on)")
    usual = StudySettings()
    for name, kind, letter, about in (
        ("minutes", positive, "M", "that measuring may take"),
        ("resolution", count, "N", "of the usual configuration"),
        ("views", count, "N", "held-out views that are measured on"),
        ("repeats", count, "N", "how often what is timed is done"),
    ):
        default = getattr(usual, name)
        sweep.add_argument(f"--{name}", type=kind, default=default, metavar=letter, help=f"{about} (default: %(default)s)")
    sweep.add_argument("--box", type=path, metavar="BOX.json", help="of the bakes (default: all that the field holds)")
    sweep.add_argument("--paper", action="store_true", help="also train fields of other kinds, for the paper's tables")
    wanted = sweep.add_argument_group("targets", "The cheapest configuration measured that has them all is written to DIR/scene.")
    wanted.add_argument("--target-db", type=positive, metavar="DB", help="at least so good on held-out views")
    wanted.add_argument("--target-mb", type=positive, metavar="MB", help="at most so many megabytes")
    wanted.add_argument("--target-ms", type=positive, metavar="MS", help="at most so long a frame")

    facts = verb("info", "say what a dataset, field, checkpoint or scene is, or what trains here", _info)
    facts.add_argument("path", type=path, nargs="?", metavar="PATH")
    facts.add_argument("--devices", action="store_true", help="which devices training would use")
    return top


def _reading(verb: argparse.ArgumentParser, defaults: DatasetOptions | None) -> None:
    """How a dataset is read. defaults: None where they come from the training."""
    told = ("as in training",) * 2 if defaults is None else (defaults.holdout, defaults.downscale)
    verb.add_argument("--holdout", type=natural, metavar="N", help=f"every n-th view is not trained on; 0: none (default: {told[0]})")
    verb.add_argument("--downscale", type=count, metavar="N", help=f"read pictures this many times smaller (default: {told[1]})")
    if defaults is not None:
        verb.set_defaults(holdout=defaults.holdout, downscale=defaults.downscale)


def _baking(verb: argparse._ActionsContainer) -> None:
    """How a field is baked."""
    usual, fineness = BakeSettings(), verb.add_mutually_exclusive_group()
    fineness.add_argument(
        "--resolution", type=count, default=usual.resolution, metavar="N", help="voxels along the longest side (default: %(default)s)"
    )
    fineness.add_argument("--voxel-size", type=positive, metavar="SIZE", help="in units of the scene, in place of the resolution")
    verb.add_argument("--box", type=path, metavar="BOX.json", help='{"min": [x, y, z], "max": [x, y, z]}, or an oriented box')
    verb.add_argument(
        "--samples", type=samples, default=usual.supersampling, metavar="K", help="a voxel; auto (default): what is worth its time"
    )
    verb.add_argument("--no-refine", dest="refine", action="store_false", help="leave the view-dependence network as it was trained")


def _storing(verb: argparse.ArgumentParser, default: str) -> None:
    """How a scene's pictures are stored."""
    verb.add_argument("--codec", choices=tuple(SUFFIXES), help=f"of the scene's pictures; png and webp lose nothing (default: {default})")
    verb.add_argument("--quality", type=count, metavar="Q", help=f"of lossy codecs, 1 to 100 (default: {CodecSettings.quality})")


def _marching(verb: argparse.ArgumentParser) -> None:
    """How a scene is marched."""
    usual = MarchSettings()
    verb.add_argument(
        "--tolerance",
        type=portion,
        default=usual.tolerance,
        metavar="E",
        help="error that a value of a pixel may have, 0 to 1 (default: %(default)s)",
    )
    verb.add_argument(
        "--per-sample-network", action="store_true", help="view dependence at every sample, not once a pixel, to compare with"
    )


def _march(options: argparse.Namespace) -> MarchSettings:
    return MarchSettings(tolerance=options.tolerance, per_sample_network=options.per_sample_network)


def _codec(options: argparse.Namespace) -> CodecSettings | None:
    if options.quality is not None and options.codec in (None, *LOSSLESS):
        raise SnergError("A quality needs a lossy codec; give --codec jpeg, avif or h264 with it.")
    if options.codec is None:
        return None
    return CodecSettings(options.codec, CodecSettings.quality if options.quality is None else options.quality)


def _bake(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    settings = BakeSettings(
        resolution=options.resolution,
        supersampling=options.samples,
        voxel_size=options.voxel_size,
        visibility=options.visibility,
        quantise=options.quantise,
        network=options.network,
    )
    return bake_scene(options.field, options.out, settings, options.box, options.refine, progress, _codec(options) or PNG)


def _train(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if options.coordinator is None and (options.processes, options.process) != (1, 0):
        raise SnergError("Several processes need to meet; give --coordinator HOST:PORT, the same for each.")
    named = {name: getattr(options, name) for name in ("view_dependence", "background", "ndc")}
    values = dict(options.set) | {name: value for name, value in named.items() if value is not None}
    settings_of(options.preset, options.minutes, options.steps, options.seed, values)  # before others wait for this one
    if options.coordinator is not None:
        connect(options.coordinator, options.processes, options.process)
    reading = DatasetOptions(options.holdout, options.downscale)
    return train_field(
        options.dataset, options.out, options.preset, options.minutes, options.steps, options.seed, reading, values, progress
    )


def _evaluate(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    dataset = options.dataset or options.named_dataset
    return evaluate(options.target, dataset, options.split, options.holdout, options.downscale, options.out, progress, _march(options))


def _estimate(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    training = settings_of(options.preset, options.minutes, options.steps, 0, {})
    settings = BakeSettings(resolution=options.resolution, voxel_size=options.voxel_size, supersampling=options.samples)
    size = options.width, options.height
    return estimate(options.path, training, settings, options.box, options.refine, size, survey=options.survey, progress=progress)


def _study(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    with needs_jax():
        from .study.study import study
    settings = StudySettings(options.minutes, options.resolution, options.views, options.repeats, options.box, paper=options.paper)
    target = Target(options.target_db, options.target_mb, options.target_ms)
    return study(options.source, options.out, options.dataset, settings, target, progress)


def _info(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if options.devices:
        return device_report()
    if options.path is None:
        raise SnergError("There is nothing to describe; give a path, or --devices.")
    return info(options.path, progress)


@contextmanager
def refusals() -> Iterator[None]:
    """What the system refuses, whatever was asked of it, as a sentence: a folder that may not be searched, a path too long."""
    try:
        yield
    except OSError as error:
        if error.filename is None or not error.strerror:
            raise
        raise SnergError(f"The system refuses {error.filename} ({error.strerror}); check the path and its permissions.") from error


def stoppable(work: Callable[[Progress], dict[str, Any]], terminal: Terminal) -> dict[str, Any]:
    """`work(progress)`, stopped by Ctrl-C within a second (see interrupt.deadline); a second Ctrl-C does not wait even for saving.

    Elsewhere than in the main thread the keyboard is not ours to listen to.
    """
    if threading.current_thread() is not threading.main_thread():
        return work(terminal)
    asked = threading.Event()

    def leave() -> NoReturn:
        interrupt.leave(EXIT_STOPPED, lambda: terminal.last("snerg: Stopped."))

    def waiting() -> None:
        terminal.last("snerg: Saving what is finished; press Ctrl-C again to leave without it.")

    with interrupt.keyboard(asked, leave), interrupt.deadline(asked, leave, waiting):
        return work(interrupt.watched(terminal, asked))


def write_result(text: str) -> None:
    """A line or more on standard output. Raises SnergError when nobody reads it, or a disk is full."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    text = "\n".join(printable(line) for line in text.split("\n"))
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        with suppress(OSError, ValueError, AttributeError):  # or what is still held back would fail once more at the very end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SnergError(f"The result cannot be written to standard output ({error.strerror}); what was asked for is done.") from error


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_ERROR, f"snerg: {clean(message)}; see '{self.prog} --help'.\n")


def path(text: str) -> Path:
    """A path, of a length that some system has."""
    if len(text) > LONGEST_PATH:
        raise argparse.ArgumentTypeError(f"a path of {len(text)} characters is longer than any system has")
    return Path(text)


def count(text: str) -> int:
    """A whole number above 0."""
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text} must be 1 or more")
    return value


def natural(text: str) -> int:
    """A whole number from 0."""
    if (value := int(text)) < 0:
        raise argparse.ArgumentTypeError(f"{text} must be 0 or more")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} must be a number above 0")
    return value


def portion(text: str) -> float:
    """A number from 0 to 1."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} must be a number from 0 to 1")
    return value


def samples(text: str) -> int:
    """A whole number of samples a voxel, or 'auto'."""
    return AUTO_SUPERSAMPLING if text == "auto" else natural(text)


def background(text: str) -> str:
    """'white', 'black', 'random', or red, green and blue from 0 to 255 as '#rrggbb'."""
    parts = text.split(",")
    if len(parts) == 1:
        return text
    values = [int(part) for part in parts]
    if len(values) != 3 or not all(0 <= value <= 255 for value in values):
        raise argparse.ArgumentTypeError(f"{text} must be three numbers from 0 to 255")
    return "#{:02x}{:02x}{:02x}".format(*values)


def assignment(text: str) -> tuple[str, str]:
    """NAME=VALUE."""
    name, sign, value = text.partition("=")
    if not sign or not name.strip():
        raise argparse.ArgumentTypeError(f"{text} must be NAME=VALUE")
    return name.strip(), value


class Terminal:
    """Progress for people: one line written over on a terminal, else a line every few seconds. Sticky texts stay."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.over = stream.isatty()
        self.told = -math.inf if self.over else time.monotonic()
        self.message = ""

    def __call__(self, fraction: float, message: str, /) -> None:
        """Show where the work is."""
        event = ProgressEvent.of(fraction, message)
        if event.sticky:
            self.write(f"\r\x1b[K{clean(event.text)}\n" if self.over else f"{clean(event.text)}\n")
            return
        now = time.monotonic()
        if now - self.told < (0.1 if self.over else EVERY_SECONDS):
            return
        self.told = now
        line = f"{100 * fraction:3.0f}%  {clean(message)}"
        self.write(f"\r\x1b[K{line[:100]}" if self.over else f"{line}\n")
        self.message = message

    def end(self) -> None:
        """Leave a clean line behind."""
        if self.over and self.message:
            self.write("\r\x1b[K")
            self.message = ""

    def last(self, sentence: str) -> None:
        """A sentence after the progress."""
        self.end()
        self.write(f"{sentence}\n")

    def write(self, text: str) -> None:
        """Show text; that nobody can see it is no reason to stop the work."""
        with suppress(OSError, ValueError):
            self.stream.write(text)
            self.stream.flush()


def plain(value: Any) -> Any:
    """JSON values only: paths as text, NumPy numbers as Python's, and None for what is not finite."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool) or value is None else str(value)


def table(result: dict[str, Any]) -> str:
    """A result for people, a value a line; what is long is left to --json."""
    width = max((len(key) for key in result), default=0)
    lines = []
    for key, value in result.items():
        text = json.dumps(value) if isinstance(value, dict | list) else "—" if value is None else str(value)
        lines.append(f"{key.replace('_', ' '):<{width}}  {text if len(text) <= 160 else '… (see --json)'}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
