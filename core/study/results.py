"""The results of a study: its tables, report and contact sheet, and the scene that meets a target."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifact import Result
from ..errors import SnergError
from ..export.scene_files import write_scene
from ..io.files import write_bytes
from ..io.images import read_image, write_png
from ..io.json_files import json_bytes
from ..progress import Progress
from ..units import duration, file_size
from .benchmarks import Benchmark, benchmarks_csv
from .contact_sheet import contact_sheet, error_picture
from .evaluate import COLUMNS
from .pareto import StudyTarget, choose
from .plan import Configuration, PlanStep
from .report import StudyResults, html, write_plots
from .summary import accuracy, csv_of
from .sweep import Sweep

SHEET_ROWS = 5  # configurations on the contact sheet


def study_results(
    sweep: Sweep,
    plan: Sequence[PlanStep],
    baseline: Configuration,
    about: dict[str, Any],
    left_out: list[str],
    benchmarks: Sequence[Benchmark] = (),
) -> StudyResults:
    """The results of all rows; the best row takes the place of a baseline that is not measured. Raises SnergError without rows."""
    rows = {step.config.key: sweep.rows[step.config.key] for step in plan if step.config.key in sweep.rows}
    if not rows:
        raise SnergError("No configuration was measured, so that there is nothing to report; give more minutes.")
    alone = sorted((row for row in sweep.rows.values() if row["config"] is None), key=lambda row: row.get("trained_seconds") or 0)
    taken = rows.get(baseline.key) or max(rows.values(), key=lambda row: row["psnr"])
    title = f"What accuracy costs: {Path(about['path']).name}"
    return StudyResults(title, about, rows, alone, plan, left_out, taken, benchmarks)


def write_results(results: StudyResults, out: Path) -> None:
    """Write study.json, study.csv, the plots, the contact sheet and the report, each whole or not at all."""
    (out / "plots").mkdir(exist_ok=True)
    plots = write_plots(results, out / "plots")
    rows = [*results.fields, *results.rows.values()]
    value = {**results.about, "usual": results.baseline["key"], "left_out": results.left_out, "rows": rows}
    value["front"] = [row["key"] for row in results.pareto_front]
    value["predictions_within_a_quarter"] = {name: list(pair) for name, pair in accuracy(results.predictions).items()}
    if results.benchmarks:
        value["benchmarks"] = results.benchmarks
        write_bytes(out / "benchmarks.csv", benchmarks_csv(results.benchmarks).encode())
    write_bytes(out / "study.json", json_bytes(value))
    write_bytes(out / "study.csv", csv_of(rows, results.plan).encode())
    write_png(out / "contact.png", results_sheet(results, out / "pictures"))
    write_bytes(out / "report.html", html(results, plots, out / "pictures").encode())


def results_sheet(results: StudyResults, pictures: Path) -> NDArray[Any]:
    """One view of up to SHEET_ROWS rows of the Pareto front, the best first, beside the true image: uint8 [H, W, 3]."""
    truth = read_image(pictures / "truth.png")[..., :3].astype(np.float32) / 255
    front = sorted(results.pareto_front, key=lambda row: -row["psnr"])
    some = [front[index] for index in np.unique(np.linspace(0, len(front) - 1, SHEET_ROWS).round().astype(int))]
    rows = []
    for row in some:
        picture = read_image(pictures / f"{row['key']}.png")[..., :3].astype(np.float32) / 255
        name = f"{row['psnr']:.2f} dB, {duration(row['ms'] / 1e3)}, {file_size(1e6 * row['megabytes'])}"
        rows.append((name, [truth, picture, error_picture(truth, picture)]))
    return contact_sheet(rows, COLUMNS, 480)


def summary_of(results: StudyResults, out: Path) -> Result:
    """What `study` returns of its results."""
    counts = {"configurations": len(results.rows), "left_out": len(results.left_out)}
    front = [row["key"] for row in results.pareto_front]
    return {"out": str(out), "report": str(out / "report.html"), **counts, "front": front, "notes": results.about["notes"]}


def write_chosen(sweep: Sweep, results: StudyResults, target: StudyTarget, out: Path, progress: Progress) -> Result:
    """Write the scene of the row that meets the target. Raises SnergError where none does."""
    row, closest = choose(list(results.rows.values()), target)
    if row is None:
        assert closest is not None  # because there are rows
        reached = f"{closest['psnr']:.2f} dB, {file_size(1e6 * closest['megabytes'])} and {duration(closest['ms'] / 1e3)} a frame"
        where = f"({closest['key']} in {out / 'study.csv'})"
        raise SnergError(f"No configuration that was measured has {target.text()}. The closest has {reached} {where}.")
    config = Configuration.from_json(row["config"])
    scene, _ = sweep.scene_of(config, progress)
    write_scene(scene, out / "scene", codec=config.codec)
    return {"chosen": row["key"], "scene": str(out / "scene"), "psnr": row["psnr"], "ms": row["ms"], "megabytes": row["megabytes"]}
