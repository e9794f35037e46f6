"""`blender --command snerg COMMAND` in a full Blender, whose own signal handlers and output the bpy module does not have."""

from __future__ import annotations

import json
import shutil

import pytest


def answer(result):
    """The JSON object in the last line of a command that ended well."""
    said = result.stdout + result.stderr
    assert result.returncode == 0 and "Traceback" not in said, f"exit code {result.returncode}: {said[-2000:]}"
    value = json.loads(result.stdout.splitlines()[-1])
    assert isinstance(value, dict)
    return value


@pytest.fixture(scope="module")
def folder(blender):
    """For what the commands write, where Blender sees it."""
    made = blender.folder("command")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    return made


@pytest.fixture(scope="module")
def baked(blender, folder, trained):
    """A scene that Blender itself has baked."""
    result = blender.snerg("bake", str(trained), "--out", str(folder / "scene"), "--resolution", "40", "--samples", "1", "--json")
    assert answer(result)["blocks"] > 0
    return folder / "scene"


def test_info(blender, photos):
    assert answer(blender.snerg("info", str(photos), "--json"))["splits"] == {"train": 12, "test": 3}


def test_train(blender, photos, folder):
    settings = ("--steps", "20", "--view-dependence", "diffuse")
    result = blender.snerg("train", str(photos), "--out", str(folder / "field"), *settings, "--json")
    assert answer(result)["steps"] == 20 and (folder / "field" / "field.npz").is_file()


def test_bake(baked):
    assert (baked / "scene.json").is_file()


def test_effects(blender, photos):
    assert answer(blender.snerg("effects", str(photos), "--json"))


def test_bundle(blender, baked, folder):
    answer(blender.snerg("bundle", str(baked), "--out", str(folder / "web"), "--json"))
    assert (folder / "web" / "index.html").is_file()


@pytest.mark.parametrize("command", ["info", "train", "bake", "effects", "bundle"])
def test_a_wrong_path_is_one_sentence(blender, folder, command):
    out = () if command in ("info", "effects") else ("--out", str(folder / "nothing"))
    result = blender.snerg(command, str(folder / "nowhere"), *out, "--json")
    said = [line for line in result.stderr.splitlines() if line.startswith("snerg: ")]
    assert result.returncode == 2, f"exit code {result.returncode}: {result.stderr}"
    assert len(said) == 1 and "nowhere" in said[0] and "Traceback" not in result.stderr + result.stdout


def test_ctrl_c_ends_with_130(blender, photos, folder):
    result = blender.snerg("train", str(photos), "--out", str(folder / "stopped"), "--steps", "1000000", stop="Step ")
    assert result.returncode == 130, f"exit code {result.returncode}: {result.stderr[-2000:]}"
    assert "Traceback" not in result.stderr + result.stdout
