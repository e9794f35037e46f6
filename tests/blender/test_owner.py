"""A project belongs to one scene of one file, whatever is saved, copied, renamed, undone and opened in between."""

from __future__ import annotations

import errno
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import pytest
from stage import add_camera, add_plane, contents

from snerg.core.jobs import folder as folders
from snerg.core.jobs.runner import Job, job_environment
from snerg.operators import watch
from snerg.operators.train import training_arguments
from snerg.snerg_addon import activity
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.steps import next_step


@pytest.fixture
def fresh(scene: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A new file with something to render. Returns a folder; projects of unsaved files are in the test's temporary folder too."""
    monkeypatch.setenv("BLENDER_USER_DATAFILES", str(tmp_path / "datafiles"))
    new_file()
    yield tmp_path
    bpy.ops.wm.read_homefile(app_template="")


def new_file() -> Any:
    """A new file with one camera above a square."""
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    prepare()
    return bpy.context.scene


def prepare() -> None:
    scene = bpy.context.scene
    add_plane()
    add_camera()
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.resolution_x, scene.render.resolution_y = 8, 6
    scene.snerg.test_every = 0


def render() -> Path:
    """Render a dataset, and return the project's folder."""
    assert bpy.ops.snerg.render_dataset() == {"FINISHED"}
    project = project_of(bpy.context.scene)
    assert project.has("dataset")
    return project.folder


def save(path: Path, **more: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False, **more)
    return path


def load(path: Path) -> Any:
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene


def ours(scene: Any = None) -> bool:
    """Whether the panel shows a rendered dataset for the scene."""
    return next_step(scene or bpy.context.scene) == "Next: train a field"


def test_two_files_in_one_folder_have_a_project_each(fresh):
    save(fresh / "a.blend")
    first = render()
    save(fresh / "a.blend")
    before = contents(first)
    new_file()
    save(fresh / "b.blend")
    assert not ours() and project_of(bpy.context.scene).folder != first
    second = render()
    assert second != first and contents(first) == before
    load(fresh / "a.blend")
    assert ours() and project_of(bpy.context.scene).folder == first


@pytest.mark.parametrize("kind", ["NEW", "EMPTY", "LINK_COPY", "FULL_COPY"])
def test_a_second_scene_has_a_project_of_its_own(fresh, kind):
    save(fresh / "a.blend")
    first, name = render(), bpy.context.scene.name
    before = contents(first)
    bpy.ops.scene.new(type=kind)
    other = bpy.context.scene
    assert other.name != name and not ours()
    if not [thing for thing in other.objects if thing.type == "CAMERA"]:
        prepare()
    second = render()
    assert second != first and contents(first) == before
    save(fresh / "a.blend")
    load(fresh / "a.blend")
    folders = {scene.name: project_of(scene).folder for scene in bpy.data.scenes}
    assert folders[name] == first and folders[bpy.context.scene.name] == second


def test_a_renamed_scene_keeps_its_project_when_a_new_one_takes_its_name(fresh):
    save(fresh / "a.blend")
    folder = render()
    scene = bpy.context.scene
    name, scene.name = scene.name, "Final"
    assert ours() and project_of(scene).folder == folder
    other = bpy.data.scenes.new(name)
    assert project_of(scene).folder == folder and ours(scene)
    assert project_of(other).folder != folder and not ours(other)


def test_a_file_closed_without_saving_finds_its_project_again(fresh):
    path = save(fresh / "a.blend")
    folder = render()
    load(path)
    assert ours() and project_of(bpy.context.scene).folder == folder


def test_an_unsaved_files_work_moves_beside_it_when_it_is_saved(fresh):
    before = render()
    assert str(bpy.app.tempdir) not in str(before), "Blender deletes its temporary folder"
    files = {name: data for name, data in contents(before).items() if name.startswith("dataset")}
    path = save(fresh / "work" / "a.blend")
    after = project_of(bpy.context.scene).folder
    assert ours() and after.is_relative_to(path.parent) and not before.exists()
    assert {name: data for name, data in contents(after).items() if name.startswith("dataset")} == files
    load(path)
    assert ours() and project_of(bpy.context.scene).folder == after


def test_undo_loses_no_project(fresh):
    """An undo restores the settings from before a dataset was rendered, but the scene keeps its project."""
    bpy.ops.ed.undo_push(message="before")
    folder = render()
    bpy.context.scene.objects[0].location.x += 1
    bpy.ops.ed.undo_push(message="moved")
    bpy.ops.ed.undo()
    assert ours() and project_of(bpy.context.scene).folder == folder
    save(fresh / "a.blend")
    assert ours() and not folder.exists()


def test_unsaved_files_do_not_see_each_others_work(fresh):
    first = render()
    new_file()
    assert not ours()
    second = render()
    assert second != first
    save(fresh / "b.blend")
    assert first.is_dir(), "work of a file that was never saved stays where it was"


def test_save_as_goes_on_with_the_project(fresh):
    first = save(fresh / "a.blend")
    folder = render()
    save(first)
    save(fresh / "elsewhere" / "b.blend")
    assert ours() and project_of(bpy.context.scene).folder == folder
    save(fresh / "elsewhere" / "b.blend")
    before = contents(folder)
    load(first)
    scene = bpy.context.scene
    shared = project_of(scene).folder == folder
    assert not shared, "two files would write into one folder"
    render()
    assert {k: v for k, v in contents(folder).items() if k in before} == before
    load(fresh / "elsewhere" / "b.blend")
    assert ours() and project_of(bpy.context.scene).folder == folder


def test_save_a_copy_leaves_the_project_with_the_original(fresh):
    first = save(fresh / "a.blend")
    folder = render()
    save(first)
    copy = save(fresh / "elsewhere" / "copy.blend", copy=True)
    assert ours() and project_of(bpy.context.scene).folder == folder
    load(copy)
    assert not ours() and project_of(bpy.context.scene).folder != folder
    assert render() != folder
    load(first)
    assert ours() and project_of(bpy.context.scene).folder == folder


def test_a_copy_made_in_the_systems_file_browser_has_its_own_project(fresh):
    first = save(fresh / "a.blend")
    folder = render()
    save(first)
    before = contents(folder)
    shutil.copy(first, fresh / "a copy.blend")
    load(fresh / "a copy.blend")
    assert not ours() and render() != folder and contents(folder) == before


def test_a_whole_folder_copied_or_moved_takes_its_project_along(fresh):
    first = save(fresh / "one" / "a.blend")
    folder = render()
    save(first)
    before = contents(folder)
    shutil.copytree(fresh / "one", fresh / "two")
    load(fresh / "two" / "a.blend")
    assert ours() and project_of(bpy.context.scene).folder == fresh / "two" / folder.relative_to(fresh / "one")
    render()
    assert contents(folder) == before
    shutil.move(fresh / "one", fresh / "three")
    load(fresh / "three" / "a.blend")
    assert ours()


def test_a_file_renamed_outside_blender_keeps_its_project(fresh):
    first = save(fresh / "a.blend")
    folder = render()
    save(first)
    first.rename(fresh / "b.blend")
    load(fresh / "b.blend")
    assert ours() and project_of(bpy.context.scene).folder == folder


def test_a_file_opened_by_a_link_is_the_same_file(fresh):
    first = save(fresh / "one" / "a.blend")
    folder = render()
    save(first)
    (fresh / "link").symlink_to(fresh / "one", target_is_directory=True)
    load(fresh / "link" / "a.blend")
    assert ours() and project_of(bpy.context.scene).folder.samefile(folder)


def test_a_folder_that_the_artist_set_is_one_files_too(fresh):
    scene = bpy.context.scene
    scene.snerg.folder = str(fresh / "chosen")
    save(fresh / "a.blend")
    assert render() == fresh / "chosen"
    save(fresh / "a.blend")
    new_file().snerg.folder = str(fresh / "chosen")
    save(fresh / "b.blend")
    assert not ours() and render() != fresh / "chosen"


def test_a_file_of_an_earlier_version_is_read_where_its_work_lies(fresh):
    """A file of version 0.1 that stored its project folder; files with the default folder stored none."""
    scene = bpy.context.scene
    path = save(fresh / "a.blend")
    folder = render()
    old = fresh / "snerg"
    folder.rename(old)
    (old / "project.json").unlink()
    scene.snerg.folder = "//snerg"
    save(path)
    load(path)
    assert ours() and project_of(bpy.context.scene).folder == old


def test_saving_over_another_file_leaves_that_ones_work_and_takes_its_own_along(fresh):
    save(fresh / "b.blend")
    other = render()
    save(fresh / "b.blend")
    before = contents(other)
    new_file()
    bpy.context.scene.render.resolution_x = 12
    render()
    save(fresh / "b.blend")
    mine = project_of(bpy.context.scene).folder
    assert ours() and mine != other and contents(other) == before
    load(fresh / "b.blend")
    assert project_of(bpy.context.scene).folder == mine


def test_two_unsaved_scenes_both_move(fresh):
    first = render()
    bpy.ops.scene.new(type="FULL_COPY")
    assert not ours()
    second = render()
    assert first != second
    save(fresh / "a.blend")
    folders = [project_of(scene).folder for scene in bpy.data.scenes]
    assert len(set(folders)) == 2 and all(ours(scene) for scene in bpy.data.scenes) and not first.exists() and not second.exists()
    load(fresh / "a.blend")
    assert [project_of(scene).folder for scene in bpy.data.scenes] == folders


def test_an_unsaved_file_saved_as_a_copy_first_keeps_its_work(fresh):
    first = render()
    save(fresh / "copy.blend", copy=True)
    assert ours() and project_of(bpy.context.scene).folder == first
    save(fresh / "a.blend")
    assert ours() and not first.exists()
    folder = project_of(bpy.context.scene).folder
    load(fresh / "copy.blend")
    assert project_of(bpy.context.scene).folder != folder


def test_save_as_twice_and_back(fresh):
    save(fresh / "a.blend")
    folder = render()
    save(fresh / "b.blend")
    save(fresh / "a.blend")
    assert ours() and project_of(bpy.context.scene).folder == folder
    load(fresh / "b.blend")
    assert not ours()


def test_undo_over_saving_and_moving(fresh):
    bpy.ops.ed.undo_push(message="before")
    render()
    bpy.ops.ed.undo_push(message="rendered")
    save(fresh / "x" / "a.blend")
    folder = project_of(bpy.context.scene).folder
    bpy.ops.ed.undo()
    assert project_of(bpy.context.scene).folder == folder and ours()
    bpy.ops.ed.redo()
    assert project_of(bpy.context.scene).folder == folder and ours()


def test_a_project_moves_to_another_disk_whole(fresh, monkeypatch):
    """Where a rename is not possible, files are copied. If that fails, the project stays complete in its place, and moves the next time."""
    folder, real, flaws = render(), os.rename, [OSError(errno.ENOSPC, "No space left on device")]
    files = contents(folder)

    def other_disk(source: Any, target: Any) -> None:
        if Path(source) == folder and Path(target).parent != folder.parent:
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        if flaws and str(source).endswith(".moving"):
            raise flaws.pop()
        real(source, target)

    monkeypatch.setattr(os, "rename", other_disk)
    path = save(fresh / "a.blend")
    assert project_of(bpy.context.scene).folder == folder and contents(folder) == files and ours()
    watch.tick()
    assert project_of(bpy.context.scene).folder == folder, "not tried again at each tick"
    load(path)
    moved = project_of(bpy.context.scene).folder
    assert moved.is_relative_to(fresh / "a.snerg") and ours() and not folder.exists()
    assert [path.name for path in folder.parent.iterdir()] == [], "nothing of it is left"
    assert {name: data for name, data in contents(moved).items() if name != "project.json"} == {
        name: data for name, data in files.items() if name != "project.json"
    }


def test_a_stopped_training_can_go_on_after_the_project_has_moved(fresh):
    render()
    scene = bpy.context.scene
    noted = training_arguments(scene, project_of(scene))
    save(fresh / "a.blend")
    assert training_arguments(scene, project_of(scene)) == noted


def test_a_project_with_a_job_moves_when_that_has_ended(fresh):
    folder = render()
    job = Job([sys.executable, "-c", "pass"], job_environment())
    job.begin(folder, {"operator": "snerg.export_scene", "label": "A job", "scene": bpy.context.scene.name})
    while job.poll():  # only its folder is needed
        time.sleep(0.01)
    lock = folders.hold(job.folder / folders.LOCK)  # as a job's process holds it while it runs
    os.write(lock, b"1")
    try:
        save(fresh / "a.blend")
        watch.tick()
        assert project_of(bpy.context.scene).folder == folder and ours()
    finally:
        os.close(lock)
    watch.tick()  # what came of it is taken in where it lies
    watch.tick()
    assert ours() and project_of(bpy.context.scene).folder.is_relative_to(fresh / "a.snerg") and not folder.exists()
    activity.stop()
