"""Benchmarks that web pages saved: read, kept in a study's folder, and refused where they are damaged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from snerg.core.errors import SnergError
from snerg.core.study.benchmarks import add_benchmarks, benchmarks_csv, benchmarks_of

GOOD = {
    "format": "snerg-benchmark",
    "version": 1,
    "title": 'Head, "stone"',
    "kind": "synthetic",
    "width": 800,
    "height": 800,
    "field_of_view": 39,
    "frames": 150,
    "ms": 12.5,
    "fps": 80,
    "memory_megabytes": 210.5,
    "megabytes": 38.2,
    "voxels": [310, 514, 356],
    "cells": 804,
    "codec": "png",
    "view_dependent": True,
    "graphics": "A card",
    "browser": "A browser",
}


def written(path: Path, **more: Any) -> Path:
    path.write_text(json.dumps(GOOD | more))
    return path


def test_benchmarks_stay_in_the_study(tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    add_benchmarks([written(tmp_path / "a.json"), written(tmp_path / "b.json", ms=5, fps=200)], tmp_path / "study")
    add_benchmarks([written(tmp_path / "c.json")], tmp_path / "study")  # the same once more
    assert [found["ms"] for found in benchmarks_of(tmp_path / "study")] == [5, 12.5]
    lines = benchmarks_csv(benchmarks_of(tmp_path / "study")).splitlines()
    assert len(lines) == 3 and lines[1].startswith('"Head, ""stone""",synthetic,800,800,150,5,200,')


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "no benchmark of a web page"),
        (json.dumps(GOOD | {"version": 2}), "no benchmark of a web page"),
        (json.dumps(GOOD | {"ms": 0}), "'ms' is missing or impossible"),
        (json.dumps(GOOD | {"fps": None}), "'fps' is missing or impossible"),
        (json.dumps(GOOD | {"kind": "sphere"}), "'kind' is missing or impossible"),
        (json.dumps(GOOD | {"graphics": 3}), "'graphics' is missing or impossible"),
    ],
)
def test_damaged_benchmarks_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "study").mkdir()
    (tmp_path / "it.json").write_text(text)
    with pytest.raises(SnergError, match=words):
        add_benchmarks([written(tmp_path / "good.json"), tmp_path / "it.json"], tmp_path / "study")
    assert benchmarks_of(tmp_path / "study") == [], "all are read before one is kept"
