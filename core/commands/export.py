"""`snerg export`: writes a scene in the reference PNG layout."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..artifact import Result, kind_of, open_scene
from ..export.reference import reference_files, write_reference
from ..export.scene_files import is_scene, scene_files
from ..io.generation import one_generation
from ..io.lock import writes_out
from ..progress import Progress, silent
from ..scene.scene import Scene
from .check_out import check_out
from .command import Command
from .info import info
from .options import artifact, path


@writes_out("an export")
def export_reference(scene: Path, out: Path, progress: Progress = silent) -> Result:
    """Write a scene in the reference PNG layout, which the published viewer opens."""
    check_out(out, "reference scene", scene)
    write_reference(published(scene), out, None, progress)
    return {"out": str(out), **info(out)}


def published(scene: Path) -> Scene:
    """Read a baked scene to be published, in any format: a scene's folder, a web page's, or a reference scene's.

    Raises SnergError when it cannot be read, or one of its files is a link to another folder, whose contents must not be published.
    """

    def read() -> Scene:
        for folder in (scene, scene / "scene"):  # a folder of ours, a web page's
            if is_scene(folder):
                scene_files(folder)
        if kind_of(scene) == "reference scene":
            reference_files(scene)
        return open_scene(scene)

    return one_generation(scene, read)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg export`."""
    parser.add_argument("scene", type=artifact, metavar="SCENE")
    parser.add_argument("--out", type=path, required=True, metavar="DIR")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg export`."""
    return export_reference(options.scene, options.out, progress)


COMMAND = Command("export", "write a scene in the reference PNG layout", add_options, run)
