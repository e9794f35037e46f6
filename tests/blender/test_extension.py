"""The extension as people get it: the zip, Blender's validator, the installation, and every operator in order.

Each Blender is a process of its own with a fresh user folder, in which the zip is installed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

INSTALL = """
import json, sys
import bpy  # which is what makes the next one importable
import addon_utils
addon_utils.enable("bl_pkg")
assert bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True) == {"FINISHED"}
NAME = "bl_ext.user_default.snerg_addon"
assert NAME in [addon.module for addon in bpy.context.preferences.addons]
"""

REGISTER = """
from importlib import import_module
addon = import_module(NAME)
def registered():
    found = [cls for kind in (bpy.types.Panel, bpy.types.Operator, bpy.types.PropertyGroup) for cls in kind.__subclasses__()]
    return sorted(cls.__name__ for cls in found if cls.__name__.startswith("SNERG_") and cls.is_registered)
assert "jax" not in sys.modules and "PIL" in sys.modules
for _ in range(2):
    assert hasattr(bpy.types.Scene, "snerg") and hasattr(bpy.types, "SNERG_PT_main") and "bake" in dir(bpy.ops.snerg)
    before = registered()
    addon_utils.disable(NAME)
    assert not hasattr(bpy.types.Scene, "snerg") and not hasattr(bpy.types, "SNERG_PT_main") and registered() == []
    addon_utils.enable(NAME)
    assert registered() == before and len(before) > 15
print("REGISTERED TWICE")
"""

FLOW = """
sys.path.insert(0, sys.argv[3])
from pathlib import Path
import build_scene
scene = build_scene.build(size=48, samples=1, cameras=10)
scene.cycles.use_denoising = False
settings = scene.snerg
settings.folder, settings.test_every, settings.steps, settings.resolution, settings.samples = sys.argv[2], 5, 60, 40, 1
settings.web_cameras, settings.box = "ALL", None
operators, done, files = bpy.ops.snerg, {}, {}
def run(name, **keywords):
    done[name] = sorted(getattr(operators, name)(**keywords))
    files[name] = sorted(path.name for path in Path(settings.folder).iterdir() if not path.name.startswith("."))
run("render_dataset")
run("train")
bpy.ops.object.select_all(action="DESELECT")
run("add_box")
run("bake")
run("preview")
run("export_scene")
run("export_web")
image = bpy.data.images["SNeRG Preview"]
size, alpha = list(image.size), image.pixels[3]
from importlib import import_module
project = import_module(NAME + ".snerg_addon.project").project_of(scene)
quality = project.notes()["scene"]["psnr"]
run("import_scene", filepath=str(project.reference))
run("import_dataset", filepath=str(project.own_dataset))
print("RESULT", json.dumps({
    "done": done, "files": files["export_web"], "size": size, "alpha": alpha, "notes": project.notes(),
    "box": settings.box.name, "scene_psnr": quality,
    "has": [step for step in ("dataset", "field", "scene", "reference", "web") if project.has(step)],
    "rest": sorted(path.name for path in Path(settings.folder).iterdir()),
}))
"""


@pytest.fixture(scope="module")
def light_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The extension without wheels: what it needs is installed beside bpy."""
    out = tmp_path_factory.mktemp("extension")
    command = [sys.executable, str(ROOT / "tools" / "build_extension.py"), "--no-wheels", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    return next(out.glob("*.zip"))


def blender(script: str, user: Path, *arguments: str) -> str:
    """Run a script in a Blender with the user folder `user`; returns what it printed."""
    (user.parent / "script.py").write_text(script)
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), "PYTHONPATH": ""}
    command = [sys.executable, str(user.parent / "script.py"), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=user.parent)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_the_zip_holds_the_code_and_nothing_else(light_zip):
    with zipfile.ZipFile(light_zip) as opened:
        names = set(opened.namelist())
        manifest = tomllib.loads(opened.read("blender_manifest.toml").decode())
    assert {"__init__.py", "launcher.py", "LICENSE", "core/cli.py", "operators/bake.py", "snerg_addon/bridge.py"} <= names
    unwanted = ("tests/", "node_modules", "__pycache__", ".git", "tools/", "demo/", "build/", ".venv")
    assert not [name for name in names if any(part in name for part in unwanted)]
    assert manifest["id"] == "snerg_addon" and manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert set(manifest["permissions"]) == {"files", "network"} and manifest["blender_version_min"] == "4.5.0"
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert manifest["version"] == version


def test_the_manifest_is_filled_in_for_each_python(light_zip):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import build_extension as tool
    finally:
        sys.path.remove(str(ROOT / "tools"))
    wheels = [Path("wheels/jax-0.7.1-py3-none-any.whl")]
    old, new = (tomllib.loads(tool.manifest_for(tool.PYTHONS[version], "linux-x64", wheels)) for version in ("3.11", "3.13"))
    assert (old["blender_version_min"], old["blender_version_max"]) == ("4.5.0", "5.1.0")
    assert new["blender_version_min"] == "5.1.0" and "blender_version_max" not in new
    assert old["wheels"] == ["./wheels/jax-0.7.1-py3-none-any.whl"] and old["platforms"] == ["linux-x64"]
    assert "files" in old["permissions"]
    assert "jax==0.7.1" in tool.pinned(tool.PYTHONS["3.11"]) and "jax==0.7.1" not in tool.pinned(tool.PYTHONS["3.13"])


def test_it_installs_and_registers_cleanly_twice(light_zip, tmp_path):
    assert "REGISTERED TWICE" in blender(INSTALL + REGISTER, tmp_path / "user", str(light_zip))


@pytest.mark.slow
@pytest.mark.hard_case(63)
def test_every_operator_in_order(light_zip, tmp_path):
    printed = blender(INSTALL + FLOW, tmp_path / "user", str(light_zip), str(tmp_path / "project"), str(ROOT / "demo"))
    result = json.loads(next(line for line in printed.splitlines() if line.startswith("RESULT"))[len("RESULT") :])
    assert all(ended == ["FINISHED"] for ended in result["done"].values()), result["done"]
    assert result["has"] == ["dataset", "field", "scene", "reference", "web"]
    assert result["size"] == [48, 48] and result["alpha"] == 1.0 and result["box"].startswith("SNeRG Box")
    assert result["notes"]["dataset"]["train"] == 8 and result["notes"]["dataset"]["test"] == 2
    assert result["notes"]["field"]["steps"] == 60 and result["notes"]["scene"]["blocks"] > 0 and result["scene_psnr"] > 5
    assert not [name for name in result["rest"] if name.endswith((".part", ".old"))]
    assert len(json.loads((tmp_path / "project" / "cameras.json").read_text())["frames"]) == 10


def test_registers_where_blender_allows_no_data_yet(addon, monkeypatch):
    """As Blender enables extensions: before a file is open, with nothing in `bpy.data` but what its own stand-in has."""
    import _bpy_restrict_state
    import bpy

    import snerg

    snerg.unregister()
    with monkeypatch.context() as restricted:
        restricted.setattr(bpy, "data", _bpy_restrict_state._data_restrict)
        snerg.register()
