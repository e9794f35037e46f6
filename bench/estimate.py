"""`make bench-estimate FIELDS="FIELD ..."`: the estimates of `snerg estimate`, and the bakes, files and pictures that follow.

Of each field and configuration: a field probe, an estimate, and a `snerg bake` in a process of its own, so that its peak memory is
known; then a picture. The coefficients of the cost model (core/study/coefficients.py) are fitted to the measurements. Without fields,
those that `make bench-train` left. Writes build/bench/estimate.json; prints the comparison and the table of fitted coefficients.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import OUT, described, markdown, snerg
from fit import Measurement, fit, fit_table

from snerg.core.baking.bake import BakeSettings
from snerg.core.baking.finish import Finishing
from snerg.core.export.scene_files import read_scene
from snerg.core.io.files import folder_bytes
from snerg.core.nerf.checkpoint import read_field
from snerg.core.rendering.acceleration import acceleration_of
from snerg.core.rendering.render import render_scene
from snerg.core.study.cost_model import Estimate, estimate
from snerg.core.study.field_probe import FieldProbe, probe_field

CONFIGURATIONS = ((128, 4), (256, 1), (256, 4), (256, 0), (384, 2), (512, 1), (512, 4), (512, 0))
GOOD = 0.25  # relative error of a good estimate


@dataclass(frozen=True)
class Pair:
    """An estimated and a measured number."""

    estimated: float
    measured: float

    @property
    def error(self) -> float:
        """Of the estimate, relative to the measurement."""
        return self.estimated / self.measured - 1 if self.measured else 0.0


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
    chosen = [tuple(map(int, text.split("x"))) for text in options.configurations.split(",") if text] or CONFIGURATIONS
    options.out.mkdir(parents=True, exist_ok=True)
    machine, results, measurements = described(), [], []
    for path in fields:
        probe = probe_field(read_field(path))
        for resolution, samples in chosen:
            row, measurement = compare(path, probe, BakeSettings(resolution=resolution, supersampling=samples), options.out / "estimate")
            results.append(row)
            measurements.append(measurement)
            (options.out / "estimate.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1) + "\n")
    coefficients, counts = fit(measurements)
    fitted = {"machine": machine, "rows": results, "coefficients": asdict(coefficients), "fitted_to": counts}
    (options.out / "estimate.json").write_text(json.dumps(fitted, indent=1) + "\n")
    print(table(results))
    print(f"\n{fit_table(coefficients, counts)}")
    return 0


def compare(path: Path, probe: FieldProbe, settings: BakeSettings, folder: Path) -> tuple[dict[str, Any], Measurement]:
    """A configuration, estimated and then baked: its row, and what to fit coefficients to."""
    name = path.parent.name if path.name == "field" else path.name
    print(f"{name}: {settings.resolution} voxels, {settings.supersampling or 'auto'} samples ...", file=sys.stderr, flush=True)
    began = time.perf_counter()
    estimated = estimate(probe, probe.field.domain.world_box(), settings, finishing=Finishing(refine=False))
    took = time.perf_counter() - began
    size = ("--resolution", str(settings.resolution), "--samples", str(settings.supersampling))
    result, peak = snerg("bake", str(path), *size, "--no-refine", "--out", str(folder / "scene"))
    preview, tables = timed_preview(probe, folder / "scene")
    seconds = {"bake": result["seconds"]["bake"], "preview": preview, "tables": tables}
    report, peak_megabytes = result["about"]["bake"], 1000 * (peak or 0)
    megabytes = folder_bytes(folder / "scene") / 1e6
    pairs = compared(estimated, report, seconds, peak_megabytes, megabytes)
    row = {
        "field": name,
        "resolution": settings.resolution,
        "samples": settings.supersampling,
        "survey_seconds": probe.seconds,
        "estimate_seconds": took,
        "pairs": {name: [pair.estimated, pair.measured, pair.error] for name, pair in pairs.items()},
    }
    stages = report["seconds"]
    return row, Measurement(probe, settings, stages["occupancy"], stages["prefilter"], preview, peak_megabytes if peak else None)


def timed_preview(probe: FieldProbe, folder: Path) -> tuple[float, float]:
    """Seconds of a picture of 800 x 800 pixels of a scene, the mean over a few cameras, and of building its acceleration structure."""
    scene = read_scene(folder)
    began = time.perf_counter()
    acceleration_of(scene)
    tables = time.perf_counter() - began
    cameras = probe.field.cameras[:: max(1, len(probe.field.cameras) // 4)]
    views = [camera.resized(800, round(800 * camera.height / camera.width)) for camera in cameras]
    began = time.perf_counter()
    for view in views:
        render_scene(scene, view)
    return (time.perf_counter() - began) * 800 * 800 / sum(view.width * view.height for view in views), tables


def compared(
    estimated: Estimate, report: dict[str, Any], seconds: dict[str, float], peak_megabytes: float, megabytes: float
) -> dict[str, Pair]:
    """Each number of an estimate beside its measurement. report: what the bake says of itself."""
    stages, voxels = report["seconds"], report["voxels"]
    return {
        "bake s": Pair(estimated.bake, seconds["bake"]),
        "occupancy s": Pair(estimated.seconds["start"] + estimated.seconds["occupancy"], stages["occupancy"]),
        "visibility s": Pair(estimated.seconds["visibility"], stages["visibility"]),
        "prefilter s": Pair(estimated.seconds["samples"] + estimated.seconds["prefilter"], stages["prefilter"]),
        "preview s": Pair(estimated.preview, seconds["preview"]),
        "tables s": Pair(estimated.tables, seconds["tables"]),
        "peak MB": Pair(estimated.peak_megabytes, peak_megabytes),
        "PNG MB": Pair(estimated.megabytes, megabytes),
        "held": Pair(estimated.held, voxels["held"]),
        "kept": Pair(estimated.kept, voxels["held"] if voxels["seen"] is None else voxels["seen"]),
        "blocks": Pair(estimated.blocks, report["blocks"]),
        "samples": Pair(estimated.samples, report["samples"]),
    }


def table(results: list[dict[str, Any]]) -> str:
    """Estimates and measurements as Markdown, and how many estimates are within a quarter."""
    names = list(results[0]["pairs"])
    rows = []
    for row in results:
        cells = [f"{estimated:.3g} / {measured:.3g} ({100 * error:+.0f} %)" for estimated, measured, error in row["pairs"].values()]
        rows.append([row["field"], row["resolution"], row["samples"] or "auto", *cells])
    errors = [np.abs([row["pairs"][name][2] for row in results]) for name in names]
    rows.append([f"within {100 * GOOD:g} %", "", "", *(f"{int((error <= GOOD).sum())} of {len(error)}" for error in errors)])
    slowest = max(row["estimate_seconds"] for row in results)
    probes = ", ".join(f"{seconds:.1f}" for seconds in dict.fromkeys(row["survey_seconds"] for row in results))
    columns = ", ".join(["field", "voxels", "samples", *names])
    return f"{markdown(columns, rows)}\n\nEstimated / measured. Probes took {probes} s, an estimate at most {1000 * slowest:.0f} ms."


if __name__ == "__main__":
    sys.exit(main())
