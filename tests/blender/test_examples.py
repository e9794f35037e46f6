"""The scripts in examples/, each in a Blender of its own, on a scene of a few views."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow

PREPARE = """
import sys
import bpy, snerg
snerg.register()
"""

MAKE = f"""{PREPARE}
sys.path.insert(0, {str(ROOT / "demo")!r})
import build_scene
scene = build_scene.build(size=24, samples=1, cameras=6)
scene.cycles.use_denoising = False
scene.snerg.box, scene.snerg.test_every, scene.snerg.samples = None, 3, 1
for name, place in (("Box left", (-0.5, 0, 0.4)), ("Box right", (0.5, 0, 0.4))):
    box = bpy.data.objects.new(name, None)
    box.empty_display_type, box.location, box.scale = "CUBE", place, (0.5, 0.6, 0.6)
    scene.collection.objects.link(box)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""

RUN = f"""{PREPARE}
import runpy
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
script = sys.argv[2]
sys.argv = ["blender", "--", *sys.argv[3:]]
runpy.run_path(script, run_name="__main__")
"""


def blender(folder: Path, script: str, *arguments: object) -> str:
    """Run a script in the bpy module; returns what it printed."""
    file = folder / "script.py"
    file.write_text(script)
    result = subprocess.run([sys.executable, str(file), *map(str, arguments)], capture_output=True, text=True, cwd=folder)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A .blend after examples/scene_to_web.py."""
    folder = tmp_path_factory.mktemp("examples")
    file = folder / "still.blend"
    blender(folder, MAKE, file)
    blender(folder, RUN, file, ROOT / "examples" / "scene_to_web.py", "--steps", 20, "--resolution", 24)
    return file


def test_a_scene_becomes_a_web_page(made):
    project = next(made.parent.glob("still.snerg/*"))
    assert (project / "dataset" / "transforms_train.json").is_file() and (project / "fields" / "001" / "field.npz").is_file()
    assert (project / "scenes" / "001" / "scene.json").is_file() and (project / "web" / "index.html").is_file()


def test_each_box_becomes_a_web_page(made):
    field, out = next(made.parent.glob("still.snerg/*/fields/001")), made.parent / "baked"
    arguments = ("--field", field, "--out", out, "--resolution", 24)
    said = blender(made.parent, RUN, made, ROOT / "examples" / "bake_boxes.py", *arguments)
    assert "Box left" in said and "Box right" in said
    for name in ("Box_left", "Box_right"):
        assert (out / name / "scene" / "scene.json").is_file() and (out / name / "web" / "index.html").is_file()
