"""Lines for the terminal, and importing whatever a file is."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from scenes import make_dataset, make_snerg
from snerg.core.commands.train import train_field
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.operators.copy_command import STEPS, command_of, quoted
from snerg.operators.import_file import importer_of
from snerg.snerg_addon.project import project_of

SMALL = ("--set", "samples=256", "--set", "family.grid.levels=2", "--set", "family.grid.log2_size=10")
ROOT = Path(__file__).resolve().parents[2]


def test_a_copied_line_does_what_the_button_does(scene, dataset):
    scene.snerg.dataset, scene.snerg.steps, scene.snerg.view_dependence = str(dataset), 3, "diffuse"
    project = project_of(scene)
    line = quoted(command_of("field", bpy.context, project))
    arguments = shlex.split(line)[1:]
    assert arguments[:2] == ["--command", "snerg"]
    run = [sys.executable, str(ROOT / "launcher.py"), *arguments[2:], *SMALL, "--json"]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    made = Path(json.loads(done.stdout.splitlines()[-1])["field"])
    assert made in project.versions("field") and project.in_use("field") == made


def test_a_line_that_cannot_start_is_refused(scene):
    for step in STEPS:
        with pytest.raises(SnergError, match="save it first" if step in ("dataset", "preview") else "make it first"):
            command_of(step, bpy.context, project_of(scene))


def test_a_file_is_imported_as_what_it_is(scene, dataset, tmp_path):
    write_scene(make_snerg(diffuse=True), tmp_path / "scene")
    field = train_field(
        dataset,
        tmp_path / "field",
        steps=1,
        values=dict(pair.split("=") for pair in SMALL[1::2]) | {"view_dependence": "diffuse"},
    )
    assert importer_of(dataset / "transforms_train.json")[0] == "import_dataset" and field is not None
    assert importer_of(tmp_path / "scene" / "scene.json")[0] == "import_scene"
    assert importer_of(tmp_path / "field" / "field.npz")[0] == "import_field"
    with pytest.raises(SnergError, match="does not exist"):
        importer_of(tmp_path / "nothing.json")
    assert bpy.ops.snerg.import_file(filepath=str(tmp_path / "scene" / "scene.json")) == {"FINISHED"}
    assert any(thing.snerg.folder for thing in scene.objects)


def test_a_file_of_one_split_stands_for_its_folder(tmp_path):
    photos = make_dataset(tmp_path / "photos", train=2, test=1, size=8)
    for split in ("train", "test"):
        assert importer_of(photos / f"transforms_{split}.json") == ("import_dataset", photos)
    alone = (photos / "transforms_test.json").rename(tmp_path / "cameras.json")
    assert importer_of(alone) == ("import_dataset", alone)
