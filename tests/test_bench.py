"""The benchmarks themselves, on a dataset of a few pixels: their rows, tables and pictures. No figure is asserted."""

import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from snerg.core.commands.train import train_field
from snerg.core.io.images import read_image

ROOT = Path(__file__).parent.parent


def run(*arguments: object, bench: str = "train") -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "bench" / f"{bench}.py"), *map(str, arguments)]
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
    assert (
        row["steps"] == 3
        and row["psnr"] >= row["psnr_pooled"] > 1
        and row["views"] == 3
        and {d["effect"] for d in row["decisions"]} >= {"Alpha", "NDC"}
    )
    assert row["peak_gb"] is None or 0.05 < row["peak_gb"] < 50
    assert value["machine"]["cores"] >= 1
    assert (tmp_path / "out" / "lego-5-white" / "pictures" / "contact.png").is_file()


def test_rows_that_there_are_not(tmp_path):
    assert "no row 'moon'" in run("--rows", "moon", "--out", tmp_path / "out").stderr
    result = run("--data", tmp_path, "--out", tmp_path / "out")
    assert result.returncode == 2 and "none of the data sets" in result.stderr


@pytest.mark.slow
def test_the_grid_is_measured_and_its_scaling_drawn(dataset, tmp_path):
    pytest.importorskip("jax")
    train_field(dataset, tmp_path / "field", steps=12, values={"view_dependence": "deferred"})
    rows = "bake,large,preview,profile,gather,scaling,whole,no-network,sample-network,webp,half"
    tiny = ("--views", 2, "--resolution", 48, "--large", 60, "--size", 16, "--out", tmp_path / "out")
    result = run("--field", tmp_path / "field", "--rows", rows, *tiny, bench="grid")
    assert result.returncode == 0, result.stderr
    for text in (
        "2 of 3 held-out views",
        "| bake, 48 voxels |",
        "| bake, 60 voxels |",
        "`ray_marcher.",
        "| samples taken |",
        "| 24 voxels |",
    ):
        assert text in result.stdout
    value = json.loads((tmp_path / "out" / "grid.json").read_text())["rows"]
    assert list(value) == rows.split(",") and value["preview"]["naive"]["difference"] < 1e-3
    assert value["no-network"]["atlas_gb"] == pytest.approx(value["whole"]["atlas_gb"] / 2, abs=1e-6)
    assert value["webp"]["psnr"] == value["whole"]["psnr"]  # nothing is lost
    assert sum(row["seconds"] for row in value["profile"]["rows"]) == pytest.approx(value["profile"]["seconds_watched"])
    picture = read_image(tmp_path / "out" / "scaling.png")
    assert picture.shape[1] > 2 * picture.shape[0] and (picture.reshape(-1, 3).min(axis=-1) < 100).any()
    assert (tmp_path / "out" / "contact.png").is_file()


def test_rows_of_the_grid_that_there_are_not(tmp_path):
    result = run("--rows", "moon", "--out", tmp_path / "out", bench="grid")
    assert result.returncode == 2 and "no row 'moon'" in result.stderr
    result = run("--field", tmp_path, "--rows", "bake", "--out", tmp_path / "out", bench="grid")
    assert result.returncode == 2 and "bench-grid: " in result.stderr and "Traceback" not in result.stderr


def test_a_straight_line_is_found_and_drawn(monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "bench")
    plot = importlib.import_module("plot")
    panel = plot.Panel("a line", "x", [(x, 2 * x + 1) for x in (1, 2, 5)])
    assert panel.line() == pytest.approx((2, 1, 1))
    plot.save_plot(tmp_path / "plot.png", [panel, panel])
    with Image.open(tmp_path / "plot.png") as image:
        assert image.size == (4 * plot.WIDTH, 2 * plot.HEIGHT)


@pytest.mark.slow
def test_estimates_are_compared_and_coefficients_fitted(dataset, tmp_path):
    pytest.importorskip("jax")
    train_field(dataset, tmp_path / "field", steps=40, values={"view_dependence": "deferred"})
    result = run(tmp_path / "field", "--configurations", "32x1,64x2,64x0", "--out", tmp_path / "out", bench="estimate")
    assert result.returncode == 0, result.stderr
    assert "| field | voxels | samples |" in result.stdout and "| `preview_factor` | 0.85 |" in result.stdout
    value = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert len(value["rows"]) == 3 and value["fitted_to"]["preview_factor"] == 3 and value["coefficients"]["ray_overhead"] == 6


@pytest.mark.slow
def test_a_preset_is_estimated_and_measured(dataset, tmp_path):
    pytest.importorskip("jax")
    short = ("--presets", "DRAFT", "--minutes", "0.1", "--resolution", "16")
    result = run(dataset, *short, "--out", tmp_path / "out", bench="presets")
    assert result.returncode == 0, result.stderr
    assert f"| {dataset.name} | Draft |" in result.stdout and "Estimated / measured" in result.stdout
    (row,) = json.loads((tmp_path / "out" / "presets.json").read_text())["rows"]
    _, estimated, took, _ = row["found"]["training"]
    assert estimated > 6 and took > 6 and row["found"]["bake"][2] > 0 and row["found"]["steps"][2] > 0


@pytest.mark.slow
def test_cameras_lead_to_a_page_in_the_given_time(tmp_path):
    pytest.importorskip("jax")
    short = ("8x1x48", "--seconds", "20", "--resolution", "24")
    result = run(*short, "--out", tmp_path / "out", bench="page")
    assert result.returncode == 0, result.stderr
    (row,) = json.loads((tmp_path / "out" / "page.json").read_text())["rows"]
    assert "| 8x1x48 |" in result.stdout and row["steps"] > 0 and row["psnr"]["scene"] > 5 and row["megabytes"] > 0.1
    assert row["seconds"]["all"] >= sum(row["seconds"][name] for name in ("render", "train", "bake", "refine", "page")) - 1
