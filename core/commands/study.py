"""`snerg study`: the trade-off between quality, time and bytes."""

from __future__ import annotations

import argparse

from ..artifact import Result
from ..errors import SnergError, needs_jax
from ..progress import Progress
from ..study.pareto import StudyTarget
from ..study.plan import Part, StudySettings
from .command import Command
from .options import artifact, count, path, positive


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg study`."""
    default = StudySettings()
    parser.add_argument("source", type=artifact, metavar="FIELD_OR_DATASET_OR_SCENE")
    parser.add_argument("--out", type=path, required=True, metavar="DIR", help="folder of the report; an earlier study there is continued")
    parser.add_argument("--dataset", type=path, metavar="DATASET", help="to measure on (default: what the field was trained on)")
    for name, kind, letter, about in (
        ("minutes", positive, "M", "time limit of all measurements"),
        ("resolution", count, "N", "voxels along the longest side of the baseline"),
        ("views", count, "N", "largest number of held-out views to measure on"),
        ("repeats", count, "N", "how often each timing is repeated"),
    ):
        parser.add_argument(f"--{name}", type=kind, default=getattr(default, name), metavar=letter, help=f"{about} (default: %(default)s)")
    parser.add_argument("--box", type=path, metavar="BOX.json", help="of the bakes (default: the field's whole domain)")
    parser.add_argument("--paper", action="store_true", help="also train fields of other kinds, for the paper's tables")
    parser.add_argument(
        "--part", type=part, metavar="I/N", help="measure one of N parts only, such as 2/8; run without --part at the end, for the report"
    )
    parser.add_argument(
        "--benchmark", type=path, action="append", default=[], metavar="FILE", help="a benchmark that a web page saved, for the report"
    )
    wanted = parser.add_argument_group("targets", "The cheapest measured configuration that meets all of them is written to DIR/scene.")
    wanted.add_argument("--target-db", type=positive, metavar="DB", help="lowest PSNR on held-out views")
    wanted.add_argument("--target-mb", type=positive, metavar="MB", help="most megabytes of files")
    wanted.add_argument("--target-ms", type=positive, metavar="MS", help="most milliseconds a frame")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg study`. Raises SnergError without JAX or matplotlib."""
    with needs_jax():
        import jax  # noqa: F401  # baking needs it

        from ..study.study import study, study_part
    settings = StudySettings(options.minutes, options.resolution, options.views, options.repeats, options.box, paper=options.paper)
    target = StudyTarget(options.target_db, options.target_mb, options.target_ms)
    if options.part is None:
        return study(options.source, options.out, options.dataset, settings, target, progress, options.benchmark)
    if target or options.paper or options.benchmark:
        raise SnergError("Targets, --paper and --benchmark belong to the whole study; give them to the last run, which has no --part.")
    return study_part(options.source, options.out, options.part, options.dataset, settings, progress)


def part(text: str) -> Part:
    """A part of a study, such as '2/8'. Raises argparse.ArgumentTypeError otherwise."""
    try:
        return Part.read(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no part of a study; give its number and how many there are, such as 2/8") from None


COMMAND = Command("study", "measure the trade-off between quality, time and bytes, and bake what a target needs", add_options, run)
