"""The list of a project's datasets, fields and scenes: what it holds, choosing, renaming, and folders that went away."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import bpy
import pytest
from stage import a_version

from scenes import make_dataset
from snerg.core.errors import SnergError
from snerg.snerg_addon import activity, results
from snerg.snerg_addon.dataset_notes import note_dataset, noted_datasets
from snerg.snerg_addon.panels.layout import megabytes
from snerg.snerg_addon.panels.results import counted, figures_of
from snerg.snerg_addon.project import project_of, remember


@pytest.fixture
def photos(tmp_path) -> Path:
    return make_dataset(tmp_path / "photos", train=3, test=1, size=8)


def listed(scene) -> list[tuple[str, str, str, bool]]:
    return [(one.kind, one.label, figures_of(project_of(scene), one), one.in_use) for one in results.results_of(project_of(scene))]


def test_it_lists_what_is_there_with_its_figures(scene, photos):
    assert listed(scene) == []
    project = project_of(scene)
    make_dataset(project.own_dataset, train=3, test=1, size=8)
    remember(project, "dataset", project.own_dataset, {"train": 3, "test": 1})
    assert bpy.ops.snerg.import_dataset(filepath=str(photos)) == {"FINISHED"}
    project = project_of(scene)
    a_version(project, "field", 30.0)
    a_version(project, "field")
    a_version(project, "scene", 29.5)
    size = megabytes(project.notes()["dataset"])
    small = megabytes({"bytes": 4})
    assert listed(scene) == [
        ("dataset", "Rendered", f"4 views, {size}", False),
        ("dataset", "photos", "4 views", True),
        ("field", "Field 002", "stopped", False),
        ("field", "Field 001", f"30.0 dB, {small}", True),
        ("scene", "Scene 001", f"29.5 dB, {small}", True),
    ]
    assert counted([one.kind for one in results.results_of(project)]) == "2 datasets, 2 fields, 1 scene"


def test_choosing_a_row_makes_it_the_current_one(scene, photos):
    project = project_of(scene)
    make_dataset(project.own_dataset, train=3, test=1, size=8)
    note_dataset(project, photos, {})
    first, second = a_version(project, "field", 30.0), a_version(project, "field", 31.0)
    assert results.refresh() and not results.refresh()
    shown = results.shown_results(scene)
    folders = [item.folder for item in shown.items]
    for folder, current in ((first, lambda: project.field), (second, lambda: project.field), (photos, lambda: project_of(scene).dataset)):
        shown.index = folders.index(str(folder))
        assert current() == folder and shown.index == folders.index(str(folder)) and shown.items[shown.index].in_use
    shown.index = folders.index(str(project.own_dataset))
    assert scene.snerg.dataset == "" and project_of(scene).dataset == project.own_dataset
    shown.items[folders.index(str(first))].label = "Before the sofa"
    shown.items[folders.index(str(second))].label = "Field 002"
    assert (
        project.name_of(second) == "002"
        and project.name_of(first) == "Before the sofa"
        and shown.items[folders.index(str(first))].label == "Before the sofa"
    )


def test_a_row_whose_folder_went_away_gives_a_sentence(scene, photos):
    project = project_of(scene)
    note_dataset(project, photos, {})
    first, _second = a_version(project, "field", 30.0), a_version(project, "field", 31.0)
    results.refresh()
    shown = results.shown_results(scene)
    index = [item.folder for item in shown.items].index(str(first))
    shutil.rmtree(first)
    shown.index = index
    assert activity.last_report(project.folder) == ("The field 001 is not there any more; it was renamed or removed.", False)
    assert str(first) not in [item.folder for item in shown.items]
    shutil.rmtree(photos)
    with pytest.raises(SnergError, match="photos is not there any more; it was renamed or removed"):
        results.choose(scene, "dataset", photos)
    assert not [one for one in results.results_of(project) if one.kind == "dataset"]
    activity.stop()


def test_a_renamed_version_is_listed_under_its_new_name_and_said(scene):
    project = project_of(scene)
    a_version(project, "field", 30.0)
    second = a_version(project, "field", 31.0)
    assert results.lost(project, scene) == []
    renamed = second.rename(second.with_name("sofa"))
    assert results.lost(project, scene) == ["The field 002 was renamed or removed; sofa is used instead."]
    assert [one.label for one in results.results_of(project)] == ["Field sofa", "Field 001"]
    results.choose(scene, "field", renamed)
    assert results.lost(project, scene) == [] and project.field == renamed
    assert a_version(project, "field", 32.0).name == "002"


def test_a_version_deleted_by_its_button_is_not_missed(scene):
    project = project_of(scene)
    a_version(project, "scene", 30.0)
    for left in ("002", "001"):
        if left == "002":
            a_version(project, "scene", 31.0)
        assert bpy.ops.snerg.delete_version(step="scene", version=left) == {"FINISHED"}
        assert results.lost(project, scene) == []


def test_a_project_folder_that_went_away_is_said(scene, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    a_version(project_of(scene), "field", 30.0)
    scene.snerg.project_id = "1"
    assert results.lost(project_of(scene), scene) == []
    (tmp_path / "project").rename(tmp_path / "moved")
    sentence = f"There is no folder {scene.snerg.folder}. Was it renamed? Choose it above, or a new project starts there."
    assert results.lost(project_of(scene), scene) == [sentence]


def test_datasets_are_found_where_the_project_or_both_were_moved(scene, tmp_path, photos):
    project = project_of(scene)
    note_dataset(project, photos, {"train": 3, "test": 1})
    (tmp_path / "art").mkdir()
    alone = replace(project, folder=project.folder.rename(tmp_path / "art" / "project"))
    assert list(noted_datasets(alone)) == [photos] and noted_datasets(alone)[photos]["train"] == 3
    photos = photos.rename(tmp_path / "art" / "photos")
    note_dataset(alone, photos, {"train": 4})
    art = (tmp_path / "art").rename(tmp_path / "elsewhere")
    both = noted_datasets(replace(project, folder=art / "project"))
    assert both[art / "photos"]["train"] == 4
