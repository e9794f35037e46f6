"""Versions: a result never replaces an earlier one, and the artist chooses which is in use."""

from __future__ import annotations

import inspect
from pathlib import Path

import bpy
import pytest
from stage import a_version, contents

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.core.jobs.task import ThreadTask
from snerg.operators import bake, classes, train, watch
from snerg.operators.task_operator import TaskOperator
from snerg.snerg_addon import results
from snerg.snerg_addon.activity import Activity
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.scene_object import folder_of, own_objects


@pytest.mark.parametrize("step", ["field", "scene"])
def test_a_finished_version_is_in_use_and_a_stopped_one_is_not(scene, step):
    project = project_of(scene)
    first = a_version(project, step, 30.0)
    before = contents(first)
    second = a_version(project, step)
    assert project.in_use(step) == first and project.notes()[step]["psnr"] == 30.0
    assert project.versions(step) == [first, second]
    third = a_version(project, step, 31.0)
    assert project.in_use(step) == third and contents(first) == before


def test_the_artist_goes_back_renames_and_deletes(scene):
    project = project_of(scene)
    first, second = a_version(project, "field", 30.0), a_version(project, "field", 31.0)
    results.choose(scene, "field", first)
    assert project.field == first and project.notes()["field"]["psnr"] == 30.0
    project.rename(first, "Before the sofa")
    assert project.name_of(first) == "Before the sofa" and project.name_of(second) == second.name
    assert bpy.ops.snerg.delete_version(step="field", version=first.name) == {"FINISHED"}
    assert not first.exists() and project.versions("field") == [second] and project.field == second
    third = a_version(project, "field", 32.0)
    assert project.name_of(third) == third.name and third != second
    with pytest.raises(RuntimeError, match="There is no version"):
        bpy.ops.snerg.delete_version(step="field", version="..")


def test_a_project_of_an_earlier_snerg_has_its_field_and_scene_as_versions(scene):
    project = project_of(scene)
    for step, name in (("field", "field.npz"), ("scene", "scene.json")):
        (project.folder / step).mkdir(parents=True)
        (project.folder / step / name).write_bytes(b"old")
        project.note(step, {"psnr": 29.0})
        assert project.in_use(step) == project.folder / step and project.notes()[step]["psnr"] == 29.0
        new = a_version(project, step, 30.0)
        assert project.in_use(step) == new and project.versions(step) == [project.folder / step, new]


def test_training_over_a_field_that_is_finished_makes_another(scene, monkeypatch):
    monkeypatch.setattr(train, "start_training", lambda arguments: arguments)
    project = project_of(scene)
    first = a_version(project, "field", 30.0)
    arguments = train.SNERG_OT_train.start(None, bpy.context, project)
    out = Path(arguments[arguments.index("--out") + 1])
    assert out != first and out.parent == first.parent and project.field == first
    assert project.settings_of(out).startswith("preset fast, seed 0, minutes 5, view dependence auto") and project.settings_of(first) == ""


def test_a_bake_says_which_field_and_settings_it_is_of(scene, monkeypatch):
    monkeypatch.setattr(bake, "start_training", lambda arguments: arguments)
    project = project_of(scene)
    project.rename(a_version(project, "field", 30.0), "Sofa")
    arguments = bake.SNERG_OT_bake.start(None, bpy.context, project)
    assert project.settings_of(Path(arguments[3])) == "field Sofa, resolution 256, samples 0"


@pytest.mark.parametrize("operator", [cls for cls in classes() if issubclass(cls, TaskOperator)], ids=lambda cls: cls.bl_idname)
def test_a_result_is_taken_without_an_instance_of_the_operator(operator):
    assert "super(" not in inspect.getsource(operator.finish), "watch.Finisher stands in for the instance, which Blender deleted"


def test_a_scene_imported_by_a_job_is_shown(scene):
    project = project_of(scene)
    path = project.new_version("scene")
    write_scene(make_snerg((34, 30, 40), diffuse=True), path)
    task = ThreadTask(lambda progress: {"to": str(path)})
    task.wait()
    done = Activity("bake", "Importing the scene", task, "snerg.import_scene", project.folder, scene.name, scene.session_uid)
    assert watch.take_result(done) == (f"Imported the baked scene into {path}", True)
    assert project.scene == path and [folder_of(thing) for thing in own_objects()] == [path]


def test_an_import_is_a_version(scene, tmp_path):
    path = tmp_path / "theirs"
    write_scene(make_snerg((34, 30, 40), diffuse=True), path)
    project = project_of(scene)
    first = a_version(project, "scene", 30.0)
    assert bpy.ops.snerg.import_scene(filepath=str(path)) == {"FINISHED"}
    assert project.scene != first and project.has("scene") and first.is_dir()
