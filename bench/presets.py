"""`make bench-presets DATASETS="DATASET ..."`: what the panel's presets are estimated to take, beside what they then took.

Of each dataset and preset: `snerg estimate` of the training, the training, `snerg estimate` of the bake, and the bake, each in a process of
its own. Estimates hold for a machine that is as busy as during the field probe; the seconds of the processor beside the measured times tell
how much of it a command got. Without datasets, the demo's. Writes build/bench/presets.json.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from common import OUT, demo, described, markdown, on_machine, watched

from snerg.core.units import duration, file_size
from snerg.snerg_addon.presets import PRESETS, Preset

COLUMNS = "dataset, preset, training, set-up, steps, its memory, bake, after it, bake's memory, files"
TEXTS = {"s": duration, "MB": lambda megabytes: file_size(1e6 * megabytes), "": lambda count: f"{count:.0f}"}


def main(arguments: list[str] | None = None) -> int:
    """Measure every dataset with every preset; the exit code is 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", type=Path, nargs="*")
    parser.add_argument("--presets", default="DRAFT,GOOD,BEST", help="names with commas (default: %(default)s)")
    parser.add_argument("--minutes", type=float, help="of each training, in place of the presets': for a trial")
    parser.add_argument("--resolution", type=int, help="of each bake, in place of the presets': for a trial")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    presets = [PRESETS[name] for name in options.presets.split(",")]
    machine, rows = described(), []
    for dataset in options.datasets or [demo(options.out)]:
        for preset in presets:
            minutes, resolution = options.minutes or preset.minutes, options.resolution or preset.resolution
            rows.append(measured(dataset, preset, minutes, resolution, options.out / "presets" / dataset.name / preset.name.lower()))
            options.out.mkdir(parents=True, exist_ok=True)
            (options.out / "presets.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    print(f"{on_machine(machine)}\n\n{markdown(COLUMNS, [cells(row) for row in rows])}")
    print("\nEstimated / measured (their ratio; seconds of the processor).")
    return 0


def measured(dataset: Path, preset: Preset, minutes: float, resolution: int, folder: Path) -> dict[str, Any]:
    """A row: {quantity: [unit, estimated, measured, seconds of the processor or None]}."""
    print(f"{dataset.name}, {preset.name}: {minutes:g} minutes, {resolution} voxels ...", file=sys.stderr, flush=True)
    field, length, size = str(folder / "field"), ("--minutes", f"{minutes:g}"), ("--resolution", str(resolution))
    training = watched("estimate", str(dataset), *length).result
    trained = watched("train", str(dataset), "--out", field, *length)
    baking = watched("estimate", field, *size).result
    baked = watched("bake", field, *size, "--out", str(folder / "scene"))
    stages, seconds = baking["seconds"], baked.result["seconds"]  # of the bake, and of what comes after it
    after = max(round(sum(stages.values()) - baking["bake_seconds"], 1), 0.0)
    found = {
        "training": ["s", training["set_up_seconds"] + training["seconds"], trained.seconds, trained.processor],
        "set-up": ["s", training["set_up_seconds"], trained.seconds - trained.result["seconds"], None],
        "steps": ["", training["steps"], trained.result["steps"], None],
        "its memory": ["MB", training["peak_megabytes"], trained.megabytes, None],
        "bake": ["s", baking["bake_seconds"], seconds["bake"], baked.processor],
        "after it": ["s", after, sum(seconds.values()) - seconds["bake"], None],
        "bake's memory": ["MB", baking["peak_megabytes"], baked.megabytes, None],
        "files": ["MB", baking["megabytes"], baked.result["megabytes"], None],
    }
    return {"dataset": dataset.name, "preset": preset.name, "minutes": minutes, "resolution": resolution, "found": found}


def cells(row: dict[str, Any]) -> list[str]:
    """A row of the table."""
    return [row["dataset"], row["preset"], *(cell(*found) for found in row["found"].values())]


def cell(unit: str, estimated: float, took: float | None, processor: float | None) -> str:
    """'28 min / 30 min (0.93; 41 min)'."""
    if not took:
        return f"{TEXTS[unit](estimated)} / {'unknown' if took is None else 'none'}"
    more = "" if processor is None else f"; {duration(processor)}"
    return f"{TEXTS[unit](estimated)} / {TEXTS[unit](took)} ({estimated / took:.2f}{more})"


if __name__ == "__main__":
    sys.exit(main())
