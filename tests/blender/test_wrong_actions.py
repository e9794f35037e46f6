"""Ten wrong actions of an artist: each is answered by one sentence that says what to do, and changes nothing."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import pytest
from stage import a_version, add_camera, add_plane, contents

from snerg.core.errors import SnergError
from snerg.snerg_addon import results
from snerg.snerg_addon.folder_pattern import problem
from snerg.snerg_addon.project import project_of


def train_on_holidays(scene: Any, folder: Path) -> None:
    scene.snerg.dataset = str(folder)
    bpy.ops.snerg.train()


def drop_any_json(_scene: Any, folder: Path) -> None:
    (folder / "package.json").write_text(json.dumps({"name": "page"}))
    bpy.ops.snerg.import_file(filepath=str(folder / "package.json"))


def import_a_field_as_a_dataset(scene: Any, folder: Path) -> None:
    field = folder / "theirs"
    field.mkdir()
    (field / "field.npz").write_bytes(b"")
    bpy.ops.snerg.import_dataset(filepath=str(field))


def fit_a_flat_box(scene: Any, _folder: Path) -> None:
    bpy.ops.snerg.add_box()
    scene.snerg.box.scale.z = 0
    bpy.context.view_layer.update()
    bpy.ops.snerg.fit_box()


def render_round_a_camera(scene: Any, _folder: Path) -> None:
    scene.snerg.cameras, scene.snerg.box = "RIG", add_camera("Shot")
    bpy.ops.snerg.render_dataset()


def add_a_box_in_edit_mode(_scene: Any, _folder: Path) -> None:
    bpy.context.view_layer.objects.active = add_plane()
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bpy.ops.snerg.add_box()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def copy_the_command_of_an_unsaved_file(_scene: Any, _folder: Path) -> None:
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    bpy.ops.snerg.copy_command(step="dataset")


def open_a_page_before_the_export(_scene: Any, _folder: Path) -> None:
    bpy.ops.snerg.open_page()


def choose_a_version_that_was_removed(scene: Any, _folder: Path) -> None:
    version = a_version(project_of(scene), "field", 30.0)
    version.rename(version.with_name("elsewhere"))
    results.choose(scene, "field", version)


def name_a_pattern_without_a_meaning(_scene: Any, _folder: Path) -> None:
    raise SnergError(problem("//projects/{artist}/{scene}"))


WRONG: dict[Callable[[Any, Path], None], str] = {
    train_on_holidays: "holidays holds no dataset: no transforms.json, poses_bounds.npy, COLMAP model or other known export is there",
    drop_any_json: "package.json has no frames; a dataset needs at least one image with its camera",
    import_a_field_as_a_dataset: "theirs is a field, not a dataset; use Import Field for it",
    fit_a_flat_box: "The box has no volume; scale it above 0 on all three axes",
    render_round_a_camera: "The box 'Shot' is not an empty; choose an empty, or add one with Add Box",
    add_a_box_in_edit_mode: "Switch to Object Mode first",
    copy_the_command_of_an_unsaved_file: "The terminal's Blender opens the file from the disk; save it first",
    open_a_page_before_the_export: "There is no web page; export one",
    choose_a_version_that_was_removed: "The field 001 is not there any more; it was renamed or removed",
    name_a_pattern_without_a_meaning: r"has \{artist\} in it; only \{file\} and \{scene\} have a meaning",
}


@pytest.mark.parametrize("action", WRONG, ids=lambda action: action.__name__)
def test_a_wrong_action_gives_one_sentence(scene, tmp_path, action):
    folder = tmp_path / "holidays"
    folder.mkdir()
    (folder / "beach.txt").write_text("sand")
    with pytest.raises((RuntimeError, SnergError)) as caught:
        action(scene, folder)
    sentence = re.sub(r"^Error: |^Operator \S+ error: |^Operator \S+poll\(\) ", "", str(caught.value).strip())
    assert re.search(WRONG[action], sentence), sentence
    assert "\n" not in sentence and len(re.findall(r"\.(?:\s|$)", sentence)) <= 1 and "Traceback" not in sentence
    assert contents(folder)["beach.txt"] == b"sand"
