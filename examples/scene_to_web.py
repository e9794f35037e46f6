"""From a Blender scene to a web page: render a dataset, train a field, bake it, export it.

    blender -b scene.blend -P examples/scene_to_web.py -- --minutes 5 --resolution 256

The results lie in the project folder beside the .blend; the panel shows them when the file is opened. `--rig 60` renders from 60
cameras around the box instead of the cameras of the scene.
"""

import argparse
import sys

import bpy


def options() -> argparse.Namespace:
    """What stands after '--'."""
    parser = argparse.ArgumentParser(prog="scene_to_web.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0, help="of training (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=0, help="of training, instead of a time")
    parser.add_argument("--resolution", type=int, default=256, help="voxels along the longest side (default: %(default)s)")
    parser.add_argument("--rig", type=int, default=0, help="cameras around the box, instead of those of the scene")
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


def do(step: str) -> None:
    """Run a step of the panel; end with an error when it fails. Blender prints the reason."""
    try:
        finished = getattr(bpy.ops.snerg, step)() == {"FINISHED"}
    except RuntimeError as error:
        sys.exit(f"{step}: {error}")
    if not finished:
        sys.exit(f"The step {step} did not finish.")


def main() -> None:
    """All steps, in the order of the panel."""
    chosen, scene = options(), bpy.context.scene
    settings = scene.snerg
    settings.minutes, settings.steps, settings.resolution = chosen.minutes, chosen.steps, chosen.resolution
    if settings.box is None:
        bpy.ops.object.select_all(action="DESELECT")  # otherwise the box is fitted around what is selected
        do("add_box")
    if chosen.rig:
        settings.cameras, settings.rig_count = "RIG", chosen.rig
    for step in ("render_dataset", "train", "bake", "export_web"):
        do(step)
    bpy.ops.wm.save_mainfile()


if __name__ == "__main__":
    main()
