"""`make bench-train`: the quality of a field by minutes of training, as a table with the machine.

Each row is a `snerg train` and a `snerg eval` in processes of their own, so that the peak memory is the training's alone. The
data sets are in the folder SNERG_DATA (or DATA=FOLDER): lego400, fern and fox. Without it the demo's scene takes their place.
ROWS=NAME,NAME chooses. Writes to build/bench: train.json, and of each row its field and the pictures beside the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from common import OUT, demo, described, on_machine, snerg
from PIL import Image


@dataclass(frozen=True)
class TrainingRow:
    """A training to measure."""

    dataset: str  # name of its folder
    minutes: float  # of training
    about: str  # for people
    white: bool = False  # composite the images over white, without an alpha channel
    arguments: tuple[str, ...] = ()  # more of `snerg train`


ROWS = {
    "lego-2": TrainingRow("lego400", 2, "hash grid"),
    "lego-5": TrainingRow("lego400", 5, "hash grid"),
    "lego-10": TrainingRow("lego400", 10, "hash grid"),
    "lego-5-white": TrainingRow("lego400", 5, "hash grid, no alpha channel", white=True),
    "lego-5-mlp": TrainingRow("lego400", 5, "positional-encoding MLP", arguments=("--preset", "mlp")),
    "fern": TrainingRow("fern", 10, "hash grid, every 8th held out", arguments=("--holdout", "8")),
    "fox": TrainingRow("fox", 10, "hash grid, every 8th held out", arguments=("--holdout", "8")),
}


def main(arguments: list[str] | None = None) -> int:
    """Measure the chosen rows and print the table. Returns the exit code, 0."""
    options = parsed(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    machine, results = described(), []
    for name in options.rows:
        results.append(measure(name, ROWS[name], options))
        (options.out / "train.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1) + "\n")
    print(table(machine, results))
    print(f"\nPictures beside the truth: {options.out}/ROW/pictures/contact.png; all numbers: {options.out / 'train.json'}")
    return 0


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The parsed options; without data, only the rows whose dataset the demo replaces."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SNERG_DATA") or None, help="folder with lego400, fern and fox")
    parser.add_argument("--rows", default="", help=f"of {', '.join(ROWS)}, with commas (default: all that the data allow)")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--steps", type=int, help="train so many steps in place of the minutes, to try the benchmark itself")
    options = parser.parse_args(arguments)
    wanted = [name for name in options.rows.split(",") if name]
    if unknown := [name for name in wanted if name not in ROWS]:
        parser.error(f"there is no row {unknown[0]!r}; choose from {', '.join(ROWS)}")
    if options.data is None:
        print("SNERG_DATA names no folder of data sets: the demo's scene takes the place of lego400, and fern and fox are left out.")
    options.rows = [n for n in wanted or ROWS if wanted or options.data is None or (options.data / ROWS[n].dataset).is_dir()]
    options.rows = [n for n in options.rows if options.data is not None or ROWS[n].dataset == "lego400"]
    if not options.rows:
        parser.error(f"{options.data or 'the demo'} has none of the data sets of these rows")
    return options


def measure(name: str, row: TrainingRow, options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate one row; returns its line of train.json."""
    print(f"{name}: {row.minutes:g} minutes of {row.dataset}, {row.about} ...", file=sys.stderr, flush=True)
    folder = options.out / name
    shutil.rmtree(folder, ignore_errors=True)
    dataset = source(row, options)
    length = ("--steps", str(options.steps)) if options.steps else ("--minutes", f"{row.minutes:g}")
    trained, peak = snerg("train", str(dataset), "--out", str(folder / "field"), *length, *row.arguments)
    measured, _ = snerg("eval", str(folder / "field"), str(dataset), "--out", str(folder / "pictures"))
    return {
        "row": name,
        **asdict(row),
        "dataset": dataset.name if options.data is not None else dataset.name.replace("dataset", "demo"),
        "psnr": measured["psnr"],
        "psnr_pooled": measured["psnr_pooled"],
        "ssim": measured["ssim"],
        "split": measured["split"],
        "views": measured["views"],
        "steps": trained["steps"],
        "seconds": trained["seconds"],
        "ms_per_step": round(1000 * trained["seconds"] / max(trained["steps"], 1), 2),
        "peak_gb": peak,
        "decisions": trained["decisions"],
    }


def source(row: TrainingRow, options: argparse.Namespace) -> Path:
    """The folder of the row's dataset, of its copy without alpha, or of the demo's."""
    dataset = options.data / row.dataset if options.data is not None else demo(options.out)
    return without_alpha(dataset, options.out / f"{dataset.name}-white") if row.white else dataset


def without_alpha(dataset: Path, copy: Path) -> Path:
    """The copy of a dataset with images composited over white, which is made if it is not there."""
    if copy.is_dir():
        return copy
    part = copy.with_name(f".{copy.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(dataset, part)
    for path in part.rglob("*.png"):
        image = Image.open(path).convert("RGBA")
        Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB").save(path)
    part.rename(copy)
    return copy


def table(machine: dict[str, Any], results: list[dict[str, Any]]) -> str:
    """The machine and a row for each training, as Markdown."""
    lines = [
        on_machine(machine),
        "",
        "| row | dataset | what | minutes | PSNR, mean of views | pooled | SSIM | steps | ms a step | peak memory |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results:
        psnr = " | ".join("identical" if row[name] is None else f"{row[name]:.2f} dB" for name in ("psnr", "psnr_pooled"))
        peak = "—" if row["peak_gb"] is None else f"{row['peak_gb']:.2f} GB"
        where = f"{row['dataset']}, {row['views']} {row['split']} views"
        numbers = f"{psnr} | {row['ssim']:.4f} | {row['steps']} | {row['ms_per_step']:.1f} | {peak}"
        lines.append(f"| {row['row']} | {where} | {row['about']} | {row['seconds'] / 60:.1f} | {numbers} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
