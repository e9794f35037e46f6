"""`make demo`: from a scene in Blender to a web page, every stage timed and measured on cameras that training never saw.

Writes to build/demo: dataset/, field/, scene/, reference/, web/, report.json and contact.png.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from build_scene import CAMERAS, SAMPLES, SIZE, build

import snerg
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.fine_tune import RefineSettings, refine
from snerg.core.cli import Terminal
from snerg.core.data.dataset import Dataset
from snerg.core.data.load import read_dataset
from snerg.core.export.bundle import write_bundle
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.box import Box
from snerg.core.io.files import folder_bytes, write_bytes
from snerg.core.io.images import over, write_png
from snerg.core.io.json_files import json_bytes
from snerg.core.nerf.field import Field
from snerg.core.nerf.render import render_field
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene
from snerg.core.study.contact_sheet import contact_sheet, error_picture
from snerg.core.study.evaluate import Score
from snerg.core.training.config import PRESETS
from snerg.core.training.trainer import train
from snerg.snerg_addon.bridge import box_from_blender
from snerg.snerg_addon.capture import evaluated, render_dataset

OUT = Path(__file__).resolve().parent.parent / "build" / "demo"
COLUMNS = ("truth", "field", "preview", "error x 10")
Pictures = list[np.ndarray]


class Stopwatch:
    """Seconds of each stage, and progress on the terminal."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.progress = Terminal(sys.stderr)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; one of the same name adds to it."""
        print(f"{name} ...", file=sys.stderr, flush=True)
        began = time.perf_counter()
        yield
        self.progress.end()
        self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - began, 2)


def main() -> int:
    """Run the demo; the exit code is 0 when every stage is done."""
    options = arguments()
    watch = Stopwatch()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    with watch.stage("render"), quiet():
        capture(options, watch)
    if options.dataset_only:
        return 0
    views, held_out = read_dataset(options.out / "dataset", "train"), read_dataset(options.out / "dataset", "test")
    with watch.stage("train"):
        # So short a training hardly gains by view dependence here, and 'auto' would leave it out: the demo shows the whole method.
        settings = replace(PRESETS["fast"], seconds=60 * options.minutes, view_dependence="deferred")
        field = train(views, settings, options.out / "field", watch.progress)
    with watch.stage("bake"):
        baked = bake(field, views.suggested_box(), field.cameras, BakeSettings(resolution=options.resolution), watch.progress)
    with watch.stage("refine"):
        refined, _ = refine(baked, views, RefineSettings(), watch.progress)
    with watch.stage("preview"):
        preview = [render_scene(refined, camera).over() for camera in held_out.cameras]
    with watch.stage("export"):
        write_scene(refined, options.out / "scene")
        write_reference(refined, options.out / "reference", held_out.cameras[0])
        write_bundle(refined, (*held_out.cameras, *views.cameras), options.out / "web")
    with watch.stage("measure"):
        report(options.out, watch, held_out, field, baked, preview)
    return 0


def arguments() -> argparse.Namespace:
    """The defaults fit ten minutes on two cores; smaller ones are for trying the demo itself."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--size", type=int, default=SIZE, help="pixels a side (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="of Cycles a pixel (default: %(default)s)")
    parser.add_argument("--cameras", type=int, default=CAMERAS, help="every eighth is held out (default: %(default)s)")
    parser.add_argument("--minutes", type=float, default=3.0, help="of training (default: %(default)s)")
    parser.add_argument("--resolution", type=int, default=320, help="voxels along the longest side (default: %(default)s)")
    parser.add_argument("--dataset-only", action="store_true", help="render the dataset and stop")
    return parser.parse_args()


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Blender's line for every tile and file, which it prints from C, off the screen."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def capture(options: argparse.Namespace, watch: Stopwatch) -> None:
    """Build the scene in Blender and render a dataset from its cameras."""
    snerg.register()
    scene = build(size=options.size, samples=options.samples, cameras=options.cameras)
    bpy.context.view_layer.update()
    shots = sorted((thing for thing in scene.objects if thing.type == "CAMERA"), key=lambda thing: thing.name)
    box: Box = box_from_blender(scene.snerg.box, evaluated(scene))
    render_dataset(scene, shots, options.out / "dataset", box=box, progress=watch.progress)


def report(out: Path, watch: Stopwatch, held_out: Dataset, field: Field, baked: Scene, preview: Pictures) -> None:
    """Measure the three stages against the held-out renders; write report.json and contact.png; print the table."""
    truth = [over(held_out.read(index)) for index in range(len(held_out.views))]
    stages = {
        "field": [render_field(field, camera).over() for camera in held_out.cameras],
        "bake": [render_scene(baked, camera).over() for camera in held_out.cameras],
        "refined": preview,
    }
    quality = {name: measure(pictures, truth) for name, pictures in stages.items()}
    seconds = {name: watch.seconds[name] for name in ("render", "train", "bake", "refine", "preview", "export")}
    value = {
        "seconds": seconds,
        "psnr": {name: quality[name]["psnr"] for name in quality},
        "ssim": {name: quality[name]["ssim"] for name in quality},
        "bytes": {"scene": folder_bytes(out / "scene"), "web": folder_bytes(out / "web")},
    }
    write_bytes(out / "report.json", json_bytes(value))
    columns = zip(truth, stages["field"], preview, strict=True)
    rows = [(c.name, [*p, error_picture(p[0], p[2])]) for c, p in zip(held_out.cameras, columns, strict=True)]
    write_png(out / "contact.png", contact_sheet(rows, COLUMNS))
    print(table(json.loads((out / "report.json").read_text())))
    print(f"\nPictures of the cameras that were held out: {out / 'contact.png'}")
    print("To open the page, run this and visit http://localhost:8000")
    print(f"  {sys.executable} -m http.server --directory {out / 'web'} 8000")


def measure(pictures: Pictures, truth: Pictures) -> dict[str, float]:
    """Mean PSNR and mean SSIM of the views."""
    score = Score()
    for picture, wanted in zip(pictures, truth, strict=True):
        score.add(picture, wanted)
    return score.result()


def table(value: dict[str, dict[str, float]]) -> str:
    """The report for people."""
    seconds, psnr, ssim = value["seconds"], value["psnr"], value["ssim"]
    lines = ["", "stage     seconds"] + [f"{name:<8} {seconds[name]:8.1f}" for name in seconds]
    lines += [f"{'total':<8} {sum(seconds.values()):8.1f}", "", "mean of held-out views  PSNR    SSIM"]
    lines += [f"{name:<20} {psnr[name]:7.2f} {ssim[name]:7.4f}" for name in psnr]
    return "\n".join([*lines, ""] + [f"{name:<8} {size / 1e6:6.1f} MB" for name, size in value["bytes"].items()])


if __name__ == "__main__":
    sys.exit(main())
