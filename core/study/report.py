"""A study's results as one HTML file that opens offline: plots and crops are inside, and each number names its row.

The page is the template report.html.j2; Jinja2 escapes all text in it.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..io.files import write_bytes
from ..io.images import png_bytes, read_image
from .benchmarks import Benchmark
from .machine import machine_line
from .packages import needs_package
from .paper_tables import WHY, cell, tables
from .pareto import StudyRow, pareto_front
from .plan import PlanStep
from .plots import ablations, error_against_time, files, predicted_and_measured, rate_and_distortion, waterfall
from .summary import PREDICTED, PathPoint, accuracy, difference, making_seconds, parameter_paths, predictions, stage_rows

TEMPLATE = "report.html.j2"
CROP_PIXELS, ZOOM = 96, 3  # side of a crop of a rendered view, and how many times larger it is shown
COLUMN_NAMES = {
    "ms": "ms a frame",
    "memory_gb": "GB in memory",
    "psnr": "PSNR (mean of views)",
    "ssim": "SSIM",
    "megabytes": "MB",
    "fps": "FPS",
}
EQUAL_TIME = 1.2  # ratio of milliseconds a frame up to which two rows are compared as equally fast
TIME_QUANTILES = (0.15, 0.5, 0.85)  # of the rows' milliseconds a frame, at which crops are compared


@dataclass(frozen=True, eq=False)
class StudyResults:
    """What a report shows."""

    title: str
    about: dict[str, Any]  # of about.json
    rows: dict[str, StudyRow]  # of configurations, by key
    fields: list[StudyRow]  # of the fields themselves
    plan: Sequence[PlanStep]
    left_out: list[str]  # texts of the steps that the time limit left out
    baseline: StudyRow
    benchmarks: Sequence[Benchmark] = ()  # of web pages, measured in browsers

    @property
    def field(self) -> StudyRow | None:
        """The row of the field that the baseline is baked from, None where it is not measured."""
        return next((row for row in self.fields if row["field"] == self.baseline["config"]["field"]), None)

    @cached_property
    def paths(self) -> dict[str, list[PathPoint]]:
        """See `summary.parameter_paths`."""
        return parameter_paths(self.rows, self.plan, self.baseline["key"])

    @cached_property
    def pareto_front(self) -> list[StudyRow]:
        """The Pareto front of PSNR, milliseconds a frame and megabytes."""
        return pareto_front(list(self.rows.values()), "ms", "megabytes")

    @cached_property
    def predictions(self) -> list[tuple[str, StudyRow, float, float]]:
        """See `summary.predictions`."""
        return predictions(list(self.rows.values()))

    @cached_property
    def stages(self) -> list[tuple[str, StudyRow]]:
        """See `summary.stage_rows`."""
        return stage_rows(self.rows, self.plan, self.field)


@dataclass(frozen=True)
class Change:
    """A configuration that differs from the baseline in one parameter."""

    text: str  # the parameter and its value, for people
    gain: float  # dB of PSNR against the baseline
    interval: float  # half the width of its 95 % interval
    row: StudyRow


def write_plots(results: StudyResults, folder: Path) -> dict[str, dict[str, bytes]]:
    """Draw every plot that the rows allow and write it to a folder that exists. Returns {name: {"png": bytes, "svg": bytes}}.

    Raises SnergError where matplotlib is missing, or the folder cannot be written.
    """
    with needs_package("matplotlib", "A study's plots"):
        import matplotlib  # noqa: F401
    rows, paths, figures = list(results.rows.values()), results.paths, {}
    if paths:
        figures["error-and-time"] = error_against_time(rows, paths, results.baseline)
        figures["rate-and-distortion"] = rate_and_distortion(paths, rows)
    if len(results.stages) > 1:
        figures["stages"] = waterfall(results.stages)
    if changes := changes_of(results):
        figures["ablations"] = ablations([(change.text, change.gain, change.interval) for change in changes])
    if results.predictions:
        figures["predictions"] = predicted_and_measured(results.predictions)
    plots = {name: files(figure) for name, figure in figures.items()}
    for name, kinds in plots.items():
        for kind, data in kinds.items():
            write_bytes(folder / f"{name}.{kind}", data)
    return plots


def changes_of(results: StudyResults) -> list[Change]:
    """Each configuration that differs from the baseline in one parameter, on paths that the baseline is on."""
    found = []
    for parameter, path in results.paths.items():
        if any(point.is_baseline for point in path):
            others = [point for point in path if not point.is_baseline]
            found += [Change(f"{parameter}: {p.value}", *difference(p.row, results.baseline), p.row) for p in others]
    return found


def html(results: StudyResults, plots: dict[str, dict[str, bytes]], pictures: Path) -> str:
    """The report. pictures: the folder of KEY.png and truth.png. Raises SnergError where Jinja2 is missing."""
    with needs_package("jinja2", "A study's reports"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined)
    environment.filters |= {
        "fixed": lambda value, digits: f"{value:.{digits}f}",
        "general": lambda value: "—" if value is None else f"{value:g}",
        "making": making_seconds,
    }
    return environment.get_template(TEMPLATE).render(_context(results, plots, pictures)) + "\n"


def _context(results: StudyResults, plots: dict[str, dict[str, bytes]], pictures: Path) -> dict[str, Any]:
    """The variables of the template."""
    about, baseline = results.about, results.baseline
    settings = ", ".join(f"{name} {value}" for name, value in about["asked"].items() if value is not None)
    return {
        "results": results,
        "about": {"notes": [], **about},
        "baseline": baseline,
        "cheapest": results.pareto_front[0],
        "best": max(results.pareto_front, key=lambda row: row["psnr"]),
        "plots": {name: _base64(kinds["svg"]) for name, kinds in plots.items()},
        "changes": changes_of(results),
        "comparisons": _equal_time(results, pictures),
        "accuracy": [(PREDICTED[name], *counts) for name, counts in accuracy(results.predictions).items()],
        "why": WHY,
        "paper_tables": tables(results.rows, results.fields, results.plan, baseline, results.field),
        "column_names": COLUMN_NAMES,
        "cell": cell,
        "lines": _lines(results),
        "machine": machine_line(about["machine"]),
        "settings": settings,
    }


def _lines(results: StudyResults) -> list[dict[str, Any]]:
    """Every row, those of the fields first, then from the best PSNR to the worst."""
    front = {row["key"] for row in results.pareto_front}
    texts = {step.config.key: step.text for step in results.plan}
    lines = []
    for row in [*results.fields, *sorted(results.rows.values(), key=lambda row: -row["psnr"])]:
        kinds = (("baseline", row is results.baseline), ("pareto", row["key"] in front))
        whole = {"seconds": None, "peak_megabytes": None, **row}
        text = texts.get(row["key"], "the field")
        lines.append({"kind": " ".join(name for name, applies in kinds if applies), "text": text, "row": whole})
    return lines


def _equal_time(results: StudyResults, pictures: Path) -> list[dict[str, Any]]:
    """Crops of the best and the worst of equally fast rows and of the truth, where the two differ most, at each of TIME_QUANTILES."""
    path = pictures / "truth.png"
    rows = [row for row in results.rows.values() if (pictures / f"{row['key']}.png").is_file()]
    if not path.is_file() or len(rows) < 3:
        return []
    truth, comparisons = read_image(path), []
    for quantile in TIME_QUANTILES:
        level = float(np.quantile([row["ms"] for row in rows], quantile, method="nearest"))  # of one row, so that a row is near it
        near = [row for row in rows if level / EQUAL_TIME <= row["ms"] <= level * EQUAL_TIME]
        best, worst = max(near, key=lambda row: row["psnr"]), min(near, key=lambda row: row["psnr"])
        if best is worst:
            continue
        images = [read_image(pictures / f"{row['key']}.png") for row in (best, worst)]
        window = most_different(*images)
        crops = [_crop(image[window], row) for image, row in zip((truth, *images), (None, best, worst), strict=True)]
        comparisons.append({"ms": level, "crops": crops})
    return comparisons


def _crop(image: NDArray[Any], row: StudyRow | None) -> dict[str, Any]:
    """What the template needs of a crop. row: None for the truth."""
    large = enlarged(image)
    return {"row": row, "width": large.shape[1], "png": _base64(png_bytes(large))}


def most_different(a: NDArray[Any], b: NDArray[Any]) -> tuple[slice, slice]:
    """Rows and columns of the window of CROP_PIXELS pixels with the largest squared error between two images [H, W, 3]."""
    error = ((a.astype(np.float32) - b.astype(np.float32)) ** 2).sum(axis=-1)
    sums = np.pad(error.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    height, width = min(CROP_PIXELS, a.shape[0]), min(CROP_PIXELS, a.shape[1])
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def enlarged(image: NDArray[Any]) -> NDArray[Any]:
    """An image [H, W, 3 or 4] without alpha, ZOOM times as large with pixels as squares: uint8 [ZOOM * H, ZOOM * W, 3]."""
    picture = Image.fromarray(np.ascontiguousarray(image[..., :3]))
    return np.asarray(picture.resize((ZOOM * picture.width, ZOOM * picture.height), Image.Resampling.NEAREST))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
