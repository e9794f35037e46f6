"""`snerg eval`: the quality of a field or a scene on held-out views."""

from __future__ import annotations

import argparse

from ..artifact import Result
from ..progress import Progress
from ..study.evaluate import evaluate
from .command import Command
from .options import add_dataset_options, add_march_options, artifact, march_settings, path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg eval`."""
    parser.add_argument("target", type=artifact, metavar="FIELD_OR_SCENE")
    parser.add_argument("dataset", type=path, nargs="?", metavar="DATASET", help="default: what the field was trained on")
    parser.add_argument("--dataset", type=path, dest="named_dataset", metavar="DATASET", help="the same, by name")
    parser.add_argument("--split", metavar="SPLIT", help="train, val or test (default: test, else val)")
    add_dataset_options(parser, None)
    parser.add_argument("--out", type=path, metavar="DIR", help="folder for the rendered views and a contact sheet with the truth")
    add_march_options(parser)


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg eval`."""
    dataset, settings = options.dataset or options.named_dataset, march_settings(options)
    return evaluate(options.target, dataset, options.split, options.holdout, options.downscale, options.out, progress, settings)


COMMAND = Command("eval", "measure a field or a scene on held-out views", add_options, run)
