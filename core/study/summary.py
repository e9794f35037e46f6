"""What a study's rows say: fronts, knobs, stages and predictions, each traceable to rows by their keys."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .pareto import Row
from .plan import RESOLUTION, STAGES, WATERFALL, Step

GOOD = 0.25  # a prediction within this of what then happens is a good one
PREDICTED = {"bake": "bake, s", "refine": "refining, s", "ms": "frame, ms", "megabytes": "files, MB"}


@dataclass(frozen=True)
class Point:
    """A row on a knob's path. value: of the knob, for people; usual: whether the usual configuration is meant."""

    value: str
    row: Row
    usual: bool


def making(row: Row) -> float:
    """Seconds from a field to files."""
    return float(sum(row["seconds"].get(name, 0.0) for name in ("bake", "refine", "write")))


def knobs(rows: dict[str, Row], plan: Sequence[Step], usual: str) -> dict[str, list[Point]]:
    """Each knob's path of measured rows, in the plan's order; those with one row alone say nothing and are left out."""
    paths: dict[str, list[Point]] = {}
    for step in plan:
        row = rows.get(step.config.key)
        for knob, value in step.knobs if row else ():
            if knob != WATERFALL and row is not None:
                paths.setdefault(knob, []).append(Point(value, row, step.config.key == usual))
    for knob, path in paths.items():
        if knob.startswith(RESOLUTION):
            path.sort(key=lambda point: point.row["config"]["bake"]["resolution"])
    return {knob: path for knob, path in paths.items() if len(path) > 1}


def stages(rows: dict[str, Row], plan: Sequence[Step], field: Row | None) -> list[tuple[str, Row]]:
    """(stage, row) from the field to the web page, those that were measured."""
    found = {value: rows[step.config.key] for step in plan for knob, value in step.knobs if knob == WATERFALL and step.config.key in rows}
    first = [("field", field)] if field is not None else []
    return first + [(stage, found[stage]) for stage in STAGES if stage in found]


def difference(row: Row, usual: Row) -> tuple[float, float]:
    """dB by which a row's views are better than the usual one's: the mean over the views and half the width of its 95 % interval
    (Student's t, paired by view); infinite for a single view."""
    from scipy.special import stdtrit

    gain = np.array(row["psnr_of_views"]) - np.array(usual["psnr_of_views"])
    if len(gain) < 2:
        return float(gain.mean()), float("inf")
    return float(gain.mean()), float(stdtrit(len(gain) - 1, 0.975) * gain.std(ddof=1) / np.sqrt(len(gain)))


def predictions(rows: Sequence[Row]) -> list[tuple[str, Row, float, float]]:
    """(what, row, said, was) of every number that was predicted; what a bake and its refining took is said once
    a bake."""
    found: list[tuple[str, Row, float, float]] = []
    done: set[tuple[str, str]] = set()
    for row in rows:
        measured = {"bake": row["seconds"].get("bake"), "refine": row["seconds"].get("refine")}
        measured |= {"ms": row["ms"], "megabytes": row["megabytes"]}
        once = str(row["config"]["bake"]) + row["config"]["field"] if row["config"] else row["key"]
        plain = row["config"] is not None and row["config"]["codec"]["name"] in ("png", "float")
        usual = row["config"] is not None and not row["config"]["march"]["per_sample_network"]
        for name, was in measured.items():
            said = row.get("predicted", {}).get(name)
            again = name in ("bake", "refine") and (name, once) in done
            if was and said and not again and (plain or name != "megabytes") and (usual or name != "ms"):
                found.append((name, row, float(said), float(was)))
                done.add((name, once))
    return found


def accuracy(found: Sequence[tuple[str, Row, float, float]]) -> dict[str, tuple[int, int]]:
    """Of each number that was predicted: (how often within GOOD of what was, how often at all)."""
    result: dict[str, tuple[int, int]] = {}
    for name, _, said, was in found:
        good, count = result.get(name, (0, 0))
        result[name] = good + (abs(said / was - 1) <= GOOD), count + 1
    return result


COLUMNS = (
    *("key", "knobs", "psnr", "ssim", "lpips", "ms", "ms_95", "megabytes", "peak_megabytes", "memory_megabytes"),
    *("blocks", "samples", "views"),
)
SECONDS = ("train", "occupancy", "visibility", "prefilter", "bake", "refine", "write", "read", "tables")
TAIL = ("refine", "codec", "quality", "tolerance", "stop_transmittance", "per_sample_network", "page", "field")


def csv_of(rows: Sequence[Row], plan: Sequence[Step]) -> str:
    """Every row as a line: what it is, its quality, its seconds a stage, what was predicted, and its configuration."""
    known = {step.config.key: step.text for step in plan}
    text = io.StringIO()
    writer = csv.writer(text)
    said = [f"predicted_{name}" for name in PREDICTED]
    settings = ("resolution", "samples", "alpha_threshold", "visibility_threshold", "visibility", "quantise", "network")
    writer.writerow([*COLUMNS, *(f"seconds_{name}" for name in SECONDS), *said, *(f"bake_{name}" for name in settings), *TAIL])
    for row in rows:
        config, seconds = row["config"] or {}, row.get("seconds", {})
        told = row | {"knobs": known.get(row["key"], row["key"])}
        cells = [told.get(name) for name in COLUMNS] + [seconds.get(name) for name in SECONDS]
        cells += [row.get("predicted", {}).get(name) for name in PREDICTED]
        cells += [config.get("bake", {}).get(name) for name in settings]
        march, codec = config.get("march", {}), config.get("codec", {})
        cells += [config.get("refine"), codec.get("name"), codec.get("quality"), march.get("tolerance"), march.get("stop_transmittance")]
        cells += [march.get("per_sample_network"), config.get("page"), config.get("field", row.get("field"))]
        writer.writerow(cells)
    return text.getvalue()
