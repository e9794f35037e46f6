"""The benchmark itself, on a dataset of a few pixels: its rows, its table and its pictures. No figure is asserted."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "bench" / "train.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
def test_a_row_is_trained_measured_and_shown(dataset, tmp_path):
    pytest.importorskip("jax")
    shutil.copytree(dataset, tmp_path / "data" / "lego400")
    result = run("--data", tmp_path / "data", "--rows", "lego-5-white", "--steps", 3, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    assert "| lego-5-white | lego400-white, 3 test views | hash grid, no alpha channel |" in result.stdout and "JAX" in result.stdout
    value = json.loads((tmp_path / "out" / "train.json").read_text())
    (row,) = value["rows"]
    assert row["steps"] == 3 and row["psnr"] > 1 and row["views"] == 3 and {d["effect"] for d in row["decisions"]} >= {"Alpha", "NDC"}
    assert row["peak_gb"] is None or 0.05 < row["peak_gb"] < 50
    assert value["machine"]["cores"] >= 1
    assert (tmp_path / "out" / "lego-5-white" / "pictures" / "contact.png").is_file()


def test_rows_that_there_are_not(tmp_path):
    assert "no row 'moon'" in run("--rows", "moon", "--out", tmp_path / "out").stderr
    result = run("--data", tmp_path, "--out", tmp_path / "out")
    assert result.returncode == 2 and "none of the data sets" in result.stderr
