"""Bake several parts of one field: each empty of the file whose name starts with 'Box' becomes a scene and a web page.

    blender -b scene.blend -P examples/bake_boxes.py -- --field scene.snerg/Scene/fields/001 --out baked

An empty is a box as the panel adds it: displayed as a cube, moved, rotated and scaled. Writes OUT/NAME/scene and OUT/NAME/web.
"""

import argparse
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np


def options() -> argparse.Namespace:
    """What stands after '--'."""
    parser = argparse.ArgumentParser(prog="bake_boxes.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", type=Path, required=True, help="folder of the trained field")
    parser.add_argument("--out", type=Path, required=True, help="folder for the scenes and pages")
    parser.add_argument("--resolution", type=int, default=256, help="voxels along the longest side of each box (default: %(default)s)")
    parser.add_argument("--prefix", default="Box", help="of the empties' names (default: %(default)s)")
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


def find_snerg() -> ModuleType:
    """The installed extension, or the package `snerg` where Blender is a Python module."""
    for name in (addon.module for addon in bpy.context.preferences.addons):
        if name.endswith(".snerg_addon"):
            return import_module(name)
    return import_module("snerg")


def box_of(empty: bpy.types.Object, snerg: ModuleType) -> object:
    """The cube that an empty displays, as a Box: a rigid pose and the lengths of its sides in world units."""
    place, rotation, scale = empty.matrix_world.decompose()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.to_matrix(), place
    return snerg.Box(pose, 2 * empty.empty_display_size * np.abs(scale))


def main() -> None:
    """One bake after another."""
    chosen, snerg = options(), find_snerg()
    field = snerg.open_artifact(chosen.field)
    boxes = [thing for thing in bpy.context.scene.objects if thing.type == "EMPTY" and thing.name.startswith(chosen.prefix)]
    if not boxes:
        sys.exit(f"The file has no empty whose name starts with {chosen.prefix!r}.")
    for empty in sorted(boxes, key=lambda thing: thing.name):
        folder = chosen.out / bpy.path.clean_name(empty.name)
        scene = snerg.bake(field, folder / "scene", box=box_of(empty, snerg), resolution=chosen.resolution)
        snerg.export_web(scene, folder / "web")
        print(f"{empty.name}: {folder / 'web'}")


if __name__ == "__main__":
    main()
