"""The demo from beginning to end, small (hard case 63)."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from snerg.core.commands.bake import info
from snerg.core.io.images import read_size

DEMO = Path(__file__).resolve().parent.parent / "demo" / "run.py"


@pytest.mark.slow
@pytest.mark.hard_case(63)
def test_the_whole_demo(tmp_path):
    pytest.importorskip("bpy")
    sizes = ["--size", "64", "--cameras", "16", "--minutes", "0.3", "--resolution", "64"]
    result = subprocess.run([sys.executable, str(DEMO), "--out", str(tmp_path / "out"), *sizes], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert set(report["seconds"]) == {"render", "train", "bake", "refine", "preview", "export"}
    for measure in ("psnr", "ssim"):
        assert set(report[measure]) == {"field", "bake", "refined"}
    assert report["psnr"]["field"] > 10 and min(report["bytes"].values()) > 1000
    assert read_size(tmp_path / "out" / "contact.png") == (4 * 70 + 6, 2 * 92 + 6)  # two cameras are held out
    assert info(tmp_path / "out" / "scene")["kind"] == "scene"
    assert info(tmp_path / "out" / "reference")["kind"] == "reference scene"
    assert (tmp_path / "out" / "web" / "index.html").is_file()
    assert "http.server" in result.stdout and "refined" in result.stdout
