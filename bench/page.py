"""`make bench-page`: from the demo's cameras to its web page in a given time, for several ways to render the dataset.

Of each row VIEWSxSAMPLESxPIXELS the dataset is rendered, a field is trained in the time that is left, baked, fine-tuned and exported,
each in a process of its own. All rows are scored on the same eight views, which are rendered with many samples.
Writes build/bench/page.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from common import OUT, ROOT, described, markdown, on_machine, watched

ROWS = ("68x12x240", "40x12x240", "40x24x240", "100x8x240", "68x12x320")
REFERENCE = (64, 128)  # cameras, of which every eighth is scored, and samples
LEAST = 10.0  # seconds of training, however long the rest takes
COLUMNS = "views x samples x pixels, rendering s, training s, steps, bake s, fine-tuning s, page s, in all s, field dB, scene dB, MB"


def main(arguments: list[str] | None = None) -> int:
    """Measure every row; the exit code is 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", default=ROWS, help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=150.0, help="from cameras to page (default: %(default)s)")
    parser.add_argument("--resolution", type=int, default=320, help="voxels along the longest side (default: %(default)s)")
    parser.add_argument("--reserve", type=float, default=35.0, help="seconds that bake, fine-tuning and export take (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    folder = options.out / "page"
    machine, rows = described(), []
    for row in dict.fromkeys(options.rows):
        views, samples, pixels = (int(part) for part in row.split("x"))
        reference = rendered(folder / f"reference-{pixels}", *REFERENCE, pixels)
        rows.append(measured(folder / row, reference, (views, samples, pixels), options))
        (options.out / "page.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    print(f"{on_machine(machine)}\n\n{markdown(COLUMNS, [cells(row) for row in rows])}")
    return 0


def measured(folder: Path, reference: Path, wanted: tuple[int, int, int], options: argparse.Namespace) -> dict[str, Any]:
    """A row: seconds of each stage, decibels on the reference's views, and the page's size."""
    began = time.monotonic()
    dataset = rendered(folder, *wanted, again=True)
    render_seconds = time.monotonic() - began
    minutes = max(options.seconds - options.reserve - render_seconds, LEAST) / 60
    field, scene, page = (str(folder / name) for name in ("field", "scene", "page"))
    trained = watched("train", str(dataset), "--out", field, "--minutes", f"{minutes:.3f}", "--view-dependence", "deferred")
    baked = watched("bake", field, "--resolution", str(options.resolution), "--out", scene)
    exported = watched("bundle", scene, "--out", page)
    spent = time.monotonic() - began
    quality = {
        name: watched("eval", path, "--dataset", str(reference)).result["psnr"] for name, path in (("field", field), ("scene", scene))
    }
    refining = baked.result["seconds"].get("refine", 0.0)
    return {
        "row": "x".join(map(str, wanted)),
        "seconds": {
            "render": render_seconds,
            "train": trained.seconds,
            "bake": baked.seconds - refining,
            "refine": refining,
            "page": exported.seconds,
            "all": spent,
        },
        "steps": trained.result["steps"],
        "psnr": quality,
        "megabytes": sum(file.stat().st_size for file in Path(page).rglob("*") if file.is_file()) / 1e6,
    }


def rendered(folder: Path, views: int, samples: int, pixels: int, again: bool = False) -> Path:
    """The dataset of the demo's scene, rendered in a process of its own; one that is there is kept unless it is to be rendered again."""
    dataset = folder / "dataset"
    if again or not dataset.is_dir():
        print(f"Rendering {views} views of {pixels} x {pixels} pixels with {samples} samples ...", file=sys.stderr, flush=True)
        size = ("--cameras", str(views), "--samples", str(samples), "--size", str(pixels))
        subprocess.run([sys.executable, str(ROOT / "demo" / "run.py"), "--dataset-only", "--out", str(folder), *size], check=True)
    return dataset


def cells(row: dict[str, Any]) -> list[str]:
    """A row of the table."""
    seconds = row["seconds"]
    times = [f"{seconds[name]:.0f}" for name in ("bake", "refine", "page", "all")]
    decibels = [f"{row['psnr'][name]:.2f}" for name in ("field", "scene")]
    return [
        row["row"],
        f"{seconds['render']:.0f}",
        f"{seconds['train']:.0f}",
        str(row["steps"]),
        *times,
        *decibels,
        f"{row['megabytes']:.1f}",
    ]


if __name__ == "__main__":
    sys.exit(main())
