"""Frame times that a web page measured in a browser (its #benchmark), beside a study's rows."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..io.files import write_bytes
from ..io.json_files import json_bytes, read_json

FORMAT, VERSION = "snerg-benchmark", 1
FOLDER = "benchmarks"  # of a study
KINDS = ("synthetic", "forward-facing", "360")
NUMBERS = ("width", "height", "field_of_view", "frames", "ms", "fps", "memory_megabytes", "megabytes", "cells")
TEXTS = ("title", "codec", "graphics", "browser")
COLUMNS = ("title", "kind", "width", "height", "frames", "ms", "fps", "memory_megabytes", "megabytes", "codec", "graphics", "browser")

Benchmark = dict[str, Any]
"""The value of a benchmark.json: KINDS, NUMBERS and TEXTS by their names, voxels [3], and whether it is view_dependent."""


def read_benchmark(path: Path) -> Benchmark:
    """The file that a page saves. Raises SnergError when it cannot be read, or when a value is missing or impossible."""
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT or value.get("version") != VERSION:
        raise SnergError(f"{path} is no benchmark of a web page; open the page with #benchmark and save its JSON.")
    wrong = next((name for name in NUMBERS if not _is_positive(value.get(name))), None)
    wrong = wrong or next((name for name in TEXTS if not isinstance(value.get(name), str)), None)
    if wrong or value.get("kind") not in KINDS:
        raise SnergError(f"The benchmark {path} is damaged: {wrong or 'kind'!r} is missing or impossible; measure it again.")
    return value


def add_benchmarks(paths: Sequence[Path], out: Path) -> None:
    """Copy benchmarks into a study's folder, where later runs find them. Raises SnergError as `read_benchmark`."""
    for data in [json_bytes(read_benchmark(path)) for path in paths]:  # all are read before one is written
        (out / FOLDER).mkdir(exist_ok=True)
        write_bytes(out / FOLDER / f"{hashlib.sha256(data).hexdigest()[:12]}.json", data)


def benchmarks_of(out: Path) -> list[Benchmark]:
    """The benchmarks in a study's folder, the fastest first."""
    found = [read_benchmark(path) for path in sorted((out / FOLDER).glob("*.json"))]
    return sorted(found, key=lambda benchmark: float(benchmark["ms"]))


def benchmarks_csv(benchmarks: Sequence[Benchmark]) -> str:
    """A line a benchmark, with a heading."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(benchmarks)
    return text.getvalue()


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")
