"""Summaries of a study's rows: paths of parameters, stages, predictions, and the rows as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..baking.finish import FINISHING_STAGES
from ..export.codecs import LOSSLESS
from .pareto import StudyRow
from .plan import RESOLUTION, STAGES, WATERFALL, PlanStep

GOOD_ERROR = 0.25  # relative error of a good prediction
PREDICTED = {
    "bake": "bake, s",
    "refine": "refining, s",
    "prune": "pruning, s",
    "fit": "fitting, s",
    "ms": "frame, ms",
    "megabytes": "files, MB",
}


@dataclass(frozen=True)
class PathPoint:
    """A row on the path of a parameter."""

    value: str  # of the parameter, for people
    row: StudyRow
    is_baseline: bool


def making_seconds(row: StudyRow) -> float:
    """Seconds to bake, finish and write a row's scene."""
    return float(sum(row["seconds"].get(name, 0.0) for name in ("bake", *FINISHING_STAGES, "write")))


def parameter_paths(rows: dict[str, StudyRow], plan: Sequence[PlanStep], baseline: str) -> dict[str, list[PathPoint]]:
    """{parameter: its measured rows in the plan's order}, of parameters with two rows or more. baseline: the key of its row."""
    paths: dict[str, list[PathPoint]] = {}
    for step in plan:
        row = rows.get(step.config.key)
        for parameter, value in step.parameters if row else ():
            if parameter != WATERFALL and row is not None:
                paths.setdefault(parameter, []).append(PathPoint(value, row, step.config.key == baseline))
    for parameter, path in paths.items():
        if parameter.startswith(RESOLUTION):
            path.sort(key=lambda point: point.row["config"]["bake"]["resolution"])
    return {parameter: path for parameter, path in paths.items() if len(path) > 1}


def stage_rows(rows: dict[str, StudyRow], plan: Sequence[PlanStep], field: StudyRow | None) -> list[tuple[str, StudyRow]]:
    """(stage, row) of each measured stage from the field to the web page."""
    keys = {value: step.config.key for step in plan for parameter, value in step.parameters if parameter == WATERFALL}
    found = {stage: rows[key] for stage, key in keys.items() if key in rows}
    first = [("field", field)] if field is not None else []
    return first + [(stage, found[stage]) for stage in STAGES if stage in found]


def difference(row: StudyRow, baseline: StudyRow) -> tuple[float, float]:
    """The mean gain in dB of a row's views over the baseline's, and half the width of its 95 % interval (Student's t, paired by view).

    The interval is infinite for a single view.
    """
    from scipy.special import stdtrit

    gain = np.array(row["psnr_of_views"]) - np.array(baseline["psnr_of_views"])
    if len(gain) < 2:
        return float(gain.mean()), float("inf")
    return float(gain.mean()), float(stdtrit(len(gain) - 1, 0.975) * gain.std(ddof=1) / np.sqrt(len(gain)))


def predictions(rows: Sequence[StudyRow]) -> list[tuple[str, StudyRow, float, float]]:
    """(name in PREDICTED, row, predicted, measured) of every predicted number; those of a bake once for all rows that share it."""
    found: list[tuple[str, StudyRow, float, float]] = []
    done: set[tuple[str, str]] = set()
    for row in rows:
        measured = {name: row["seconds"].get(name) for name in ("bake", *FINISHING_STAGES)}
        measured |= {"ms": row["ms"], "megabytes": row["megabytes"]}
        for name, value in measured.items():
            predicted, bake = row.get("predicted", {}).get(name), (name, _bake_of(row))
            again = name in ("bake", *FINISHING_STAGES) and bake in done
            if value and predicted and not again and _is_predicted(row, name):
                found.append((name, row, float(predicted), float(value)))
                done.add(bake)
    return found


def _bake_of(row: StudyRow) -> str:
    """What rows of the same bake share."""
    return str(row["config"]["bake"]) + str(row["config"]["field"]) if row["config"] else str(row["key"])


def _is_predicted(row: StudyRow, name: str) -> bool:
    """Whether the cost model is for this number: bytes of lossless codecs or floats, milliseconds of a network that runs once a pixel."""
    config = row["config"]
    if name == "megabytes":
        return config is not None and config["codec"]["name"] in (*LOSSLESS, "float")
    return name != "ms" or (config is not None and not config["march"]["per_sample_network"])


def accuracy(found: Sequence[tuple[str, StudyRow, float, float]]) -> dict[str, tuple[int, int]]:
    """{name: (number of predictions within GOOD_ERROR, number of predictions)}."""
    result: dict[str, tuple[int, int]] = {}
    for name, _, predicted, measured in found:
        good, count = result.get(name, (0, 0))
        result[name] = good + (abs(predicted / measured - 1) <= GOOD_ERROR), count + 1
    return result


COLUMNS = (  # of study.csv; "knobs" are the parameters, a name that scripts read
    *("key", "knobs", "psnr", "psnr_pooled", "ssim", "flip", "lpips", "ms", "ms_95", "megabytes", "peak_megabytes", "memory_megabytes"),
    *("blocks", "samples", "views"),
)
SECONDS = ("train", "occupancy", "visibility", "prefilter", "bake", "refine", "prune", "fit", "write", "read", "tables")
TAIL = (
    *("refine", "fit", "prune", "codec", "quality", "half_features"),
    *("tolerance", "stop_transmittance", "per_sample_network", "page", "field"),
)


def csv_of(rows: Sequence[StudyRow], plan: Sequence[PlanStep]) -> str:
    """Every row as a line of CSV: its quality, seconds of each stage, predictions and configuration."""
    known = {step.config.key: step.text for step in plan}
    text = io.StringIO()
    writer = csv.writer(text)
    predicted = [f"predicted_{name}" for name in PREDICTED]
    settings = ("resolution", "samples", "alpha_threshold", "visibility_threshold", "visibility", "quantise", "network")
    writer.writerow([*COLUMNS, *(f"seconds_{name}" for name in SECONDS), *predicted, *(f"bake_{name}" for name in settings), *TAIL])
    for row in rows:
        config, seconds = row["config"] or {}, row.get("seconds", {})
        named = row | {"knobs": known.get(row["key"], row["key"])}
        cells = [named.get(name) for name in COLUMNS] + [seconds.get(name) for name in SECONDS]
        cells += [row.get("predicted", {}).get(name) for name in PREDICTED]
        cells += [config.get("bake", {}).get(name) for name in settings]
        march, codec = config.get("march", {}), config.get("codec", {})
        cells += [config.get("refine"), config.get("fit", False), config.get("prune", 0.0)]
        cells += [codec.get("name"), codec.get("quality"), codec.get("half_features", False)]
        cells += [march.get("tolerance"), march.get("stop_transmittance")]
        cells += [march.get("per_sample_network"), config.get("page"), config.get("field", row.get("field"))]
        writer.writerow(cells)
    return text.getvalue()
