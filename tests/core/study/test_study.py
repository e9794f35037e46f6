"""A study end to end, small: it measures, goes on where it was stopped, reports, and bakes what a target calls for."""

import csv
import importlib
import itertools
import json
import re
import shutil
import time

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("matplotlib")

from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.train import train_field
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.export.scene_files import read_scene
from snerg.core.io.images import over
from snerg.core.rendering.render import MarchSettings, render_scene
from snerg.core.study.machine import watched
from snerg.core.study.metrics import psnr
from snerg.core.study.pareto import StudyTarget
from snerg.core.study.plan import StudySettings
from snerg.core.study.study import study
from snerg.core.study.summary import difference

SETTINGS = StudySettings(minutes=20, resolution=24, views=2)


@pytest.fixture(scope="module")
def field(tmp_path_factory, dataset):
    out = tmp_path_factory.mktemp("studied") / "field"
    values = {"family.grid.levels": "4", "family.grid.log2_size": "12", "samples": "4096", "view_dependence": "deferred"}
    train_field(dataset, out, steps=120, values=values)
    return out


@pytest.fixture(scope="module")
def begun(tmp_path_factory, field):
    """A study that was stopped in the middle."""
    out, told = tmp_path_factory.mktemp("study") / "out", []

    def stop(fraction, message):
        told.append((fraction, message))
        if sum(1 for path in (out / "rows").glob("*.json")) >= 3:
            raise Cancelled("Stopped by the test.")

    with pytest.raises(Cancelled):
        study(field, out, settings=SETTINGS, progress=stop)
    assert [f for f, _ in told] == sorted(f for f, _ in told)
    return out


@pytest.fixture(scope="module")
def studied(begun, field, tmp_path_factory):
    """The study after it went on."""
    out = shutil.copytree(begun, tmp_path_factory.mktemp("finished") / "out")
    before = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in (out / "rows").glob("*.json")}
    assert len(before) >= 3 and not (out / "study.json").exists()
    result = study(field, out, settings=SETTINGS)
    after = {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in (out / "rows").glob("*.json")}
    assert all(after[name] == kept for name, kept in before.items()), "what was finished is measured again"
    return out, result


@pytest.mark.slow
def test_every_row_is_measured_and_each_claim_has_one(studied):
    out, result = studied
    value = json.loads((out / "study.json").read_text())
    rows = {row["key"]: row for row in value["rows"]}
    assert result["left_out"] == 0 and result["configurations"] == len(rows) - 1 >= 50  # and the field itself
    table = list(csv.DictReader((out / "study.csv").read_text().splitlines()))
    assert {line["key"] for line in table} == set(rows)
    for line in table:
        row = rows[line["key"]]
        assert float(line["psnr"]) == row["psnr"] > 10 and float(line["ms"]) == row["ms"] > 0 and row["ms_95"] >= row["ms"]
        assert float(line["megabytes"]) == row["megabytes"] > 0 and len(row["psnr_of_views"]) == row["views"] == 2
    report = (out / "report.html").read_text()
    named = set(re.findall(r"<code>(\w+)</code>", report))
    assert named and named <= set(rows) and not re.search(r"(src|href)=\"(?!data:)", report), "the report opens offline"
    assert {path.name for path in (out / "plots").iterdir()} >= {f"error-and-time.{kind}" for kind in ("png", "svg")}
    marked = [rows[key] for key in value["front"]]
    for a, b in itertools.permutations(marked, 2):
        assert a["psnr"] < b["psnr"] or a["ms"] > b["ms"] or a["megabytes"] > b["megabytes"] or a["psnr"] == b["psnr"]


@pytest.mark.slow
def test_parameters_do_what_they_say(studied):
    rows = {row["key"]: row for row in json.loads((studied[0] / "study.json").read_text())["rows"] if row["config"]}

    def found(**wanted):
        return [
            r
            for r in rows.values()
            if all({**r["config"], **r["config"]["bake"], **r["config"]["codec"]}[k] == v for k, v in wanted.items())
        ]

    png = rows[json.loads((studied[0] / "study.json").read_text())["usual"]]
    webp, halved = sorted(found(name="webp", resolution=24), key=lambda row: "half_features" in row["config"]["codec"])
    assert webp["psnr"] == png["psnr"] and halved["megabytes"] < webp["megabytes"] < png["megabytes"]
    assert all(row["megabytes"] > png["megabytes"] for row in found(quantise=False))
    assert all(row["memory_megabytes"] == pytest.approx(png["memory_megabytes"] / 2, abs=0.1) for row in found(network=False))
    worse = found(name="jpeg", quality=50, resolution=24)[0]
    gain, half = difference(worse, png)
    assert gain < 0 < half and difference(png, png) == (0, 0)


@pytest.mark.slow
def test_a_target_is_baked_and_has_what_was_measured(studied, field, dataset):
    out, _ = studied
    rows = [row for row in json.loads((out / "study.json").read_text())["rows"] if row["config"]]
    wish = sorted(row["psnr"] for row in rows)[len(rows) // 2]
    result = study(field, out, settings=SETTINGS, target=StudyTarget(db=wish))
    assert result["psnr"] >= wish and len(read_scene(out / "scene").cells)
    config = next(row for row in rows if row["key"] == result["chosen"])["config"]
    camera = read_dataset(dataset, "test").cameras[0]
    shown = render_scene(read_scene(out / "scene"), camera, MarchSettings(**config["march"]))
    assert psnr(shown.over(), over(read_dataset(dataset, "test").read(0))) == pytest.approx(rows_of(rows, result["chosen"]), abs=0.02)
    with pytest.raises(SnergError, match=r"has at least 90 dB.* The closest has [\d.]+ dB"):
        study(field, out, settings=SETTINGS, target=StudyTarget(db=90))


def rows_of(rows, key):
    """dB of a row's first view."""
    return next(row["psnr_of_views"][0] for row in rows if row["key"] == key)


@pytest.mark.slow
def test_a_baked_scene_is_stored_and_marched_otherwise(studied, field, dataset, tmp_path):
    bake_scene(field, tmp_path / "scene", BakeSettings(resolution=20), refine=False)
    result = study(tmp_path / "scene", tmp_path / "out", dataset, StudySettings(minutes=10, views=1))
    value = json.loads((tmp_path / "out" / "study.json").read_text())
    assert result["left_out"] == 0 and {row["config"]["codec"]["name"] for row in value["rows"]} >= {"png", "jpeg"}
    assert all(row["seconds"].get("bake") is None for row in value["rows"])


@pytest.mark.slow
def test_the_papers_tables_have_all_their_rows(dataset, tmp_path):
    train_field(dataset, tmp_path / "field", minutes=0.1, values={"view_dependence": "deferred"})
    study(tmp_path / "field", tmp_path / "out", settings=StudySettings(minutes=6, resolution=24, views=1, paper=True))
    report = (tmp_path / "out" / "report.html").read_text()
    told = report[report.index("The paper's tables") : report.index("Every row")]
    missing = [line for line in told.split("<tr>") if "<td>—</td>" in line]
    assert [line for line in missing if "the field" not in line] == [] and "34.67, 0.976" in told


@pytest.mark.slow
def test_a_dataset_is_trained_for_some_times(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.import_module("snerg.core.study.prepare"), "LONG_MINUTES", 1.0)
    settings = StudySettings(minutes=2, resolution=16, views=1)
    result = study(dataset, tmp_path / "out", settings=settings)
    value = json.loads((tmp_path / "out" / "study.json").read_text())
    lengths = [row["trained_seconds"] for row in value["rows"] if row["config"] is None]
    assert result["configurations"] >= 10 and len(lengths) == 3 and lengths == sorted(lengths)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda out: (out / "about.json").write_text('{"version": 0}'), "of another version of studies"),
        (lambda out: (out / "about.json").write_text("{"), "about.json"),
        (lambda out: next((out / "rows").iterdir()).write_text("[]"), "not a row of a study"),
        (lambda out: (out / "about.json").unlink(), "holds other results"),
    ],
)
def test_what_an_earlier_study_left_is_never_overwritten(field, begun, tmp_path, spoil, told):
    out = tmp_path / "out"
    shutil.copytree(begun, out)
    spoil(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(SnergError, match=told):
        study(field, out, settings=SETTINGS)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_bad_input_is_told_in_a_sentence(field, dataset, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(SnergError, match=r"coarsest configuration takes about .* give more minutes"):
        study(field, out, settings=StudySettings(minutes=0.001, resolution=24, views=2))
    with pytest.raises(SnergError, match="with other settings"):
        study(field, out, settings=StudySettings(minutes=1, resolution=25, views=2))
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    with pytest.raises(SnergError, match="holds other files"):
        study(field, other)
    assert (other / "mine.txt").read_text() == "mine"


def test_memory_is_watched():
    with watched() as peak:
        block = np.ones(40_000_000 // 8)
        time.sleep(0.1)
    assert peak.most is None or peak.most > block.nbytes
