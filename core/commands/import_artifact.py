"""`snerg import`: copies a field, a checkpoint or a scene into SNeRG's own layout."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..artifact import Result, artifact_at, kind_of, open_field, open_scene
from ..errors import SnergError
from ..export.scene_files import write_scene
from ..io.files import new_folder
from ..io.lock import writes_out
from ..nerf.checkpoint import write_field
from ..progress import Progress, silent, within
from .check_out import check_out
from .command import Command
from .info import info
from .options import artifact, path


@writes_out("an import")
def import_source(source: Path, out: Path, progress: Progress = silent) -> Result:
    """Write the field at `source` (SNeRG's own, or a reference checkpoint) or the scene (SNeRG's own, a web page's, or in the
    reference layout) to `out`. Returns the description of `info`, with the kind of the source.

    Raises SnergError when `source` is neither, or damaged.
    """
    source = artifact_at(source)
    kind = kind_of(source)
    check_out(out, {"reference scene": "scene", "page": "scene", "checkpoint": "field"}.get(kind, kind), source)
    if kind in ("scene", "page", "reference scene"):
        write_scene(open_scene(source, within(progress, 0, 0.5)), out, within(progress, 0.5, 1))
    elif kind in ("field", "checkpoint"):
        field = open_field(source)
        with new_folder(out) as folder:  # a new folder, so that the log of an earlier training there is replaced with its field
            write_field(field, folder)
    else:
        raise SnergError(f"{source} is a {kind}, which needs no import; give a field, a checkpoint or a baked scene.")
    progress(1.0, "Imported")
    return {"imported": kind, "to": str(out), **info(out)}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg import`."""
    parser.add_argument("source", type=artifact, metavar="SOURCE")
    parser.add_argument("--out", type=path, required=True, metavar="PATH")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg import`."""
    return import_source(options.source, options.out, progress)


COMMAND = Command("import", "import a checkpoint, field or baked scene", add_options, run)
