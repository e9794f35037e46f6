"""`make bench-train`: how good a field gets in how many minutes, as a table with the machine that it was measured on.

Each row is a `snerg train` and a `snerg eval` in processes of their own, so that the peak memory is the training's alone. The
data sets are in the folder SNERG_DATA (or DATA=FOLDER): lego400, fern and fox. Without it the demo's scene takes their place.
ROWS=NAME,NAME chooses. Writes to build/bench: train.json, and of each row its field and the pictures beside the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench"


@dataclass(frozen=True)
class Row:
    """dataset: its folder; minutes of training; white: with the alpha channel dropped; arguments: more for `snerg train`."""

    dataset: str
    minutes: float
    about: str
    white: bool = False
    arguments: tuple[str, ...] = ()


ROWS = {
    "lego-2": Row("lego400", 2, "hash grid"),
    "lego-5": Row("lego400", 5, "hash grid"),
    "lego-10": Row("lego400", 10, "hash grid"),
    "lego-5-white": Row("lego400", 5, "hash grid, no alpha channel", white=True),
    "lego-5-mlp": Row("lego400", 5, "positional-encoding MLP", arguments=("--preset", "mlp")),
    "fern": Row("fern", 10, "hash grid, every 8th held out", arguments=("--holdout", "8")),
    "fox": Row("fox", 10, "hash grid, every 8th held out", arguments=("--holdout", "8")),
}


def main(arguments: list[str] | None = None) -> int:
    """Measure the chosen rows one after the other; the exit code is 0 when all of them are done."""
    options = parsed(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    machine, results = describe_machine(), []
    for name in options.rows:
        results.append(measure(name, ROWS[name], options))
        (options.out / "train.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1) + "\n")
    print(table(machine, results))
    print(f"\nPictures beside the truth: {options.out}/ROW/pictures/contact.png; all numbers: {options.out / 'train.json'}")
    return 0


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The options; where there is no data, only the rows that the demo's scene can stand in for."""
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


def measure(name: str, row: Row, options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate one row."""
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
        "ssim": measured["ssim"],
        "split": measured["split"],
        "views": measured["views"],
        "steps": trained["steps"],
        "seconds": trained["seconds"],
        "ms_per_step": round(1000 * trained["seconds"] / max(trained["steps"], 1), 2),
        "peak_gb": peak,
        "decisions": trained["decisions"],
    }


def snerg(*arguments: str) -> tuple[dict[str, Any], float | None]:
    """Run a verb in a process of its own; returns its result and its peak memory in GB (None where the system does not say)."""
    command = [sys.executable, "-m", "snerg.core.cli", *arguments, "--json"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    output, peak = child.stdout.read(), None
    if hasattr(os, "wait4"):
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        peak = round(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9, 2)
    if child.wait() != 0:
        raise SystemExit(f"'snerg {' '.join(arguments)}' failed with code {child.returncode}.")
    return json.loads(output.splitlines()[-1]), peak


def source(row: Row, options: argparse.Namespace) -> Path:
    """The row's dataset: as it is, without its alpha channel, or the demo's."""
    dataset = options.data / row.dataset if options.data is not None else demo(options.out)
    return without_alpha(dataset, options.out / f"{dataset.name}-white") if row.white else dataset


def demo(out: Path) -> Path:
    """The demo's scene, rendered once."""
    dataset = out / "demo" / "dataset"
    if not dataset.is_dir():
        subprocess.run([sys.executable, str(ROOT / "demo" / "run.py"), "--dataset-only", "--out", str(dataset.parent)], check=True)
    return dataset


def without_alpha(dataset: Path, copy: Path) -> Path:
    """A copy of a dataset whose pictures are opaque, over white, made once."""
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


def describe_machine() -> dict[str, Any]:
    """The processor, its memory, what JAX trains on, and the versions."""
    devices = json.loads(
        subprocess.run(  # in a process of its own: JAX keeps a GPU's memory to itself
            [sys.executable, "-m", "snerg.core.cli", "info", "--devices", "--json"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[-1]
    )
    processor, memory = platform.processor() or platform.machine(), None
    if sys.platform == "linux":
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return {
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": memory,
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "jax": version("jax"),
        "devices": devices,
    }


def table(machine: dict[str, Any], results: list[dict[str, Any]]) -> str:
    """Everything as Markdown."""
    memory = f"{machine['memory_gb']} GB" if machine["memory_gb"] else "memory unknown"
    lines = [
        f"{machine['processor']}, {machine['cores']} cores, {memory}; {machine['system']}; Python {machine['python']}, "
        f"NumPy {machine['numpy']}, JAX {machine['jax']}. {machine['devices']['training']}",
        "",
        "| row | dataset | what | minutes | PSNR | SSIM | steps | ms a step | peak memory |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results:
        psnr = "identical" if row["psnr"] is None else f"{row['psnr']:.2f} dB"
        peak = "—" if row["peak_gb"] is None else f"{row['peak_gb']:.2f} GB"
        where = f"{row['dataset']}, {row['views']} {row['split']} views"
        numbers = f"{psnr} | {row['ssim']:.4f} | {row['steps']} | {row['ms_per_step']:.1f} | {peak}"
        lines.append(f"| {row['row']} | {where} | {row['about']} | {row['seconds'] / 60:.1f} | {numbers} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
