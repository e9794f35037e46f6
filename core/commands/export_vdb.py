"""`snerg export-vdb`: a scene as an OpenVDB volume."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..artifact import Result, open_scene
from ..errors import SnergError
from ..export.vdb import write_vdb
from ..progress import Progress, silent
from .command import Command
from .options import artifact, path


def export_vdb(scene: Path, out: Path, progress: Progress = silent) -> Result:
    """Write a baked scene as a .vdb file (see write_vdb). Raises SnergError when `out` is no such file, or cannot be written."""
    if out.suffix.lower() != ".vdb" or out.is_dir():
        raise SnergError(f"{out} is no .vdb file; give the volume's file a name that ends in .vdb.")
    return {"out": str(out), "scene": str(scene), **write_vdb(open_scene(scene), out, progress)}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg export-vdb`."""
    parser.add_argument("scene", type=artifact, metavar="SCENE")
    parser.add_argument("--out", type=path, required=True, metavar="FILE.vdb")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg export-vdb`."""
    return export_vdb(options.scene, options.out, progress)


COMMAND = Command("export-vdb", "write a scene as an OpenVDB volume, for Cycles and EEVEE", add_options, run)
