"""Runs inside Blender without a window: every step of the panel on the demo's scene, for the pictures that pictures.py takes.

`blender -b --python picture_scene.py -- FILE DATASET MINUTES`: saves FILE, trains MINUTES on a copy of DATASET, bakes and exports.
"""

from __future__ import annotations

import shutil
import sys
from importlib import import_module
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parent.parent
RESOLUTION = 320  # voxels, as the demo's
EXTENSION = "bl_ext.user_default.snerg_addon"


def main() -> None:
    """Make the file and its project."""
    file, dataset, minutes = sys.argv[sys.argv.index("--") + 1 :]
    sys.path.insert(0, str(ROOT / "demo"))
    import build_scene

    scene = build_scene.build()
    bpy.ops.wm.save_as_mainfile(filepath=file)
    take_dataset(scene, Path(dataset))
    scene.snerg.minutes, scene.snerg.view_dependence, scene.snerg.resolution = float(minutes), "deferred", RESOLUTION
    for step in ("train", "estimate", "bake", "preview", "export_web"):
        if getattr(bpy.ops.snerg, step)() != {"FINISHED"}:
            sys.exit(f"The step {step} failed.")
    bpy.ops.wm.save_mainfile()


def take_dataset(scene: bpy.types.Scene, dataset: Path) -> None:
    """Put a rendered dataset into the scene's project as if it had been rendered there."""
    project = import_module(f"{EXTENSION}.snerg_addon.project")
    owner = import_module(f"{EXTENSION}.snerg_addon.owner")
    owner.assign_project(scene)
    mine = project.project_of(scene)
    shutil.copytree(dataset, mine.own_dataset)
    counts = {split: len(list((mine.own_dataset / split).glob("*.png"))) for split in ("train", "test")}
    size = {"width": scene.render.resolution_x, "height": scene.render.resolution_y}
    project.remember(mine, "dataset", mine.own_dataset, {**counts, **size})


if __name__ == "__main__":
    main()
