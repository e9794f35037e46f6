"""`make bench-estimate FIELDS="FIELD ..."`: what `snerg estimate` says beforehand, and what a bake, its files and a picture then took.

Of each field and configuration: a survey, an estimate, and a `snerg bake` in a process of its own, so that its peak memory is
known; then a picture. Without fields, those that `make bench-train` left. Writes build/bench/estimate.json; prints a table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import OUT, described, markdown, snerg

from snerg.core.baking.bake import BakeSettings
from snerg.core.export.scene_files import read_scene
from snerg.core.io.files import folder_bytes
from snerg.core.nerf.checkpoint import read_field
from snerg.core.rendering.acceleration import acceleration_of
from snerg.core.rendering.render import render_scene
from snerg.core.study.cost_model import estimate
from snerg.core.study.field_probe import FieldProbe, probe_field

CONFIGURATIONS = ((128, 4), (256, 1), (256, 4), (256, 0), (384, 2), (512, 1), (512, 4), (512, 0))
GOOD = 0.25


@dataclass(frozen=True)
class Pair:
    """A number before and after."""

    said: float
    was: float

    @property
    def error(self) -> float:
        """Relative to what it was."""
        return self.said / self.was - 1 if self.was else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Measure every configuration that is not measured yet; the exit code is 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fields", type=Path, nargs="*")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--configurations", default="", help="RESOLUTIONxSAMPLES with commas; samples 0: chosen by the bake")
    options = parser.parse_args(arguments)
    fields = options.fields or sorted(path.parent for path in OUT.glob("*/field/field.npz"))
    if not fields:
        parser.error("there is no field; name some, or run make bench-train first")
    wanted = [tuple(map(int, text.split("x"))) for text in options.configurations.split(",") if text] or CONFIGURATIONS
    options.out.mkdir(parents=True, exist_ok=True)
    machine, results = described(), []
    for path in fields:
        looked = probe_field(read_field(path))
        for resolution, samples in wanted:
            results.append(compare(path, looked, resolution, samples, options.out / "estimate"))
            (options.out / "estimate.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1) + "\n")
    print(table(results))
    return 0


def compare(path: Path, looked: FieldProbe, resolution: int, samples: int, folder: Path) -> dict[str, Any]:
    """One configuration, said and done."""
    name = path.parent.name if path.name == "field" else path.name
    print(f"{name}: {resolution} voxels, {samples or 'auto'} samples ...", file=sys.stderr, flush=True)
    settings = BakeSettings(resolution=resolution, samples=samples)
    began = time.perf_counter()
    said = estimate(looked, looked.field.domain.world_box(), settings, refine=False)
    took = time.perf_counter() - began
    arguments = ("--resolution", str(resolution), "--samples", str(samples), "--no-refine", "--out", str(folder / "scene"))
    done, peak = snerg("bake", str(path), *arguments)
    told = done["about"]["bake"]
    scene = read_scene(folder / "scene")
    began = time.perf_counter()
    acceleration_of(scene)
    tables = time.perf_counter() - began
    views = [
        camera.resized(800, round(800 * camera.height / camera.width))
        for camera in looked.field.cameras[:: max(1, len(looked.field.cameras) // 4)]
    ]
    began = time.perf_counter()
    for view in views:
        render_scene(scene, view)
    picture = (time.perf_counter() - began) * 800 * 800 / sum(view.width * view.height for view in views)
    voxels = told["voxels"]
    pairs = {
        "bake s": Pair(said.bake, done["seconds"]["bake"]),
        "occupancy s": Pair(said.seconds["start"] + said.seconds["occupancy"], told["seconds"]["occupancy"]),
        "visibility s": Pair(said.seconds["visibility"], told["seconds"]["visibility"]),
        "prefilter s": Pair(said.seconds["samples"] + said.seconds["prefilter"], told["seconds"]["prefilter"]),
        "preview s": Pair(said.preview, picture),
        "tables s": Pair(said.tables, tables),
        "peak MB": Pair(said.peak_megabytes, 1000 * (peak or 0)),
        "PNG MB": Pair(said.megabytes, folder_bytes(folder / "scene") / 1e6),
        "held": Pair(said.held, voxels["held"]),
        "kept": Pair(said.kept, voxels["held"] if voxels["seen"] is None else voxels["seen"]),
        "blocks": Pair(said.blocks, told["blocks"]),
        "samples": Pair(said.samples, told["samples"]),
    }
    return {
        "field": name,
        "resolution": resolution,
        "samples": samples,
        "survey_seconds": looked.seconds,
        "estimate_seconds": took,
        "pairs": {name: [pair.said, pair.was, pair.error] for name, pair in pairs.items()},
    }


def table(results: list[dict[str, Any]]) -> str:
    """Said and done as Markdown, and how many are within a quarter."""
    names = list(results[0]["pairs"])
    rows = []
    for row in results:
        cells = [f"{said:.3g} / {was:.3g} ({100 * error:+.0f} %)" for said, was, error in row["pairs"].values()]
        rows.append([row["field"], row["resolution"], row["samples"] or "auto", *cells])
    errors = [np.abs([row["pairs"][name][2] for row in results]) for name in names]
    rows.append([f"within {100 * GOOD:g} %", "", "", *(f"{int((error <= GOOD).sum())} of {len(error)}" for error in errors)])
    slowest = max(row["estimate_seconds"] for row in results)
    looks = ", ".join(f"{seconds:.1f}" for seconds in dict.fromkeys(row["survey_seconds"] for row in results))
    columns = ", ".join(["field", "voxels", "samples", *names])
    return f"{markdown(columns, rows)}\n\nSaid / done. Surveys took {looks} seconds, an estimate at most {1000 * slowest:.0f} ms."


if __name__ == "__main__":
    sys.exit(main())
