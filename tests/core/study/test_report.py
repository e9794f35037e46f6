"""The report of whatever was measured: few rows, gaps between their times, figures at their bounds, and text that is no HTML."""

import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax")

from snerg.core.baking.bake import BakeSettings
from snerg.core.errors import SnergError
from snerg.core.io.images import write_png
from snerg.core.study.inputs import digest
from snerg.core.study.machine import describe_machine
from snerg.core.study.plan import Configuration, plan_steps
from snerg.core.study.results import study_results, write_results
from snerg.core.study.study import study

BASELINE = Configuration(BakeSettings(resolution=24))
PLAN = plan_steps(BASELINE, True, True, True, ["webp", "jpeg"])


class Measured:
    """A sweep's rows, as they lie on the disk."""

    def __init__(self, rows):
        self.rows = {row["key"]: row for row in rows}


def measured(times, **more):
    """Rows of the plan's first configurations, so many milliseconds a frame each."""
    rows = []
    for index, (step, ms) in enumerate(zip(PLAN, times, strict=False)):
        quality = 20.0 + index
        row = {"key": step.config.key, "config": step.config.to_json(), "seconds": {"bake": 1.0}, "ms": ms, "ms_95": ms, "views": 2}
        row |= {"psnr": quality, "ssim": 0.9, "psnr_of_views": [quality, quality + 1], "megabytes": 1.0 + index, "memory_megabytes": 3.0}
        rows.append(row | more)
    return rows


def reported(rows, folder):
    """report.html of such rows, and what was found."""
    (folder / "pictures").mkdir(parents=True)
    draw = np.random.default_rng(3)
    for name in ("truth", *(row["key"] for row in rows)):
        write_png(folder / "pictures" / f"{name}.png", draw.integers(0, 255, (20, 30, 3)).astype(np.uint8))
    about = {"path": "field", "dataset": "data", "machine": describe_machine(), "asked": {"views": 2}, "notes": []}
    found = study_results(Measured(rows), PLAN, BASELINE, about, [])
    write_results(found, folder)
    return (folder / "report.html").read_text(), found


@pytest.mark.parametrize(
    "times",
    [
        [1.0, 1.0, 100.0, 100.0],  # nothing takes about as long as the middle one of all
        [1.0, 10.0, 100.0, 1000.0, 1e4],
        [5.0] * 6,
        [7.0],
        [7.0, 9.0],
        [0.0, 0.0, 0.0, 3.0],
        [*np.geomspace(0.01, 1e5, 9)],
    ],
)
def test_any_times_are_reported(times, tmp_path):
    pytest.importorskip("matplotlib")
    text, found = reported(measured(times), tmp_path)
    assert text.endswith("</html>\n") and all(key in text for key in found.rows)


@pytest.mark.parametrize("more", [{"psnr": 100.0, "psnr_of_views": [100.0, 100.0]}, {"psnr_of_views": [21.0], "views": 1}])
def test_figures_at_their_bounds(more, tmp_path):
    """Pictures that are the truth itself, and a single view, which says nothing about its interval."""
    pytest.importorskip("matplotlib")
    assert reported(measured([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], **more), tmp_path)[0].endswith("</html>\n")


def test_nothing_measured_is_a_sentence(tmp_path):
    with pytest.raises(SnergError, match="nothing to report"):
        reported([], tmp_path)


def test_benchmarks_of_pages_are_in_the_report(tmp_path):
    _, found = reported(measured([5.0, 6.0]), tmp_path)
    browser = {"title": "<b>Head</b>", "kind": "360", "width": 990, "height": 773, "frames": 150, "ms": 12.5, "fps": 80.0}
    browser |= {"memory_megabytes": 210.5, "megabytes": 38.2, "codec": "png", "graphics": "A card"}
    write_results(replace(found, benchmarks=[browser]), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "&lt;b&gt;Head&lt;/b&gt;" in page and "<td>12.5</td><td>80.0</td>" in page
    assert (tmp_path / "benchmarks.csv").read_text().count("\n") == 2


def test_text_in_a_row_is_no_html(tmp_path):
    pytest.importorskip("matplotlib")
    evil = "<script>alert(1)</script>"
    rows = measured([1.0, 2.0, 3.0], peak_megabytes=evil, views=evil)
    assert "<script" not in reported(rows, tmp_path)[0]


def test_what_a_kill_left_is_no_other_source(tmp_path):
    """A study goes on although the folder of its field holds half of a file now."""
    (tmp_path / "field.npz").write_bytes(b"field")
    before = digest(tmp_path)
    (tmp_path / ".field.npz.0123abcd.part").mkdir()
    (tmp_path / ".field.npz.0123abcd.part" / "file").write_bytes(b"half")
    assert digest(tmp_path) == before
    (tmp_path / "field.npz").write_bytes(b"other")
    assert digest(tmp_path) != before


def test_without_matplotlib_nothing_is_measured(tmp_path, monkeypatch):
    """It says so before the minutes, not after them."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SnergError, match="pip install matplotlib"):
        study(tmp_path / "field", tmp_path / "out")
    assert not list(tmp_path.iterdir())
