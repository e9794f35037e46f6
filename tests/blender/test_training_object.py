"""The temporary object of a running training: there while its preview is, the artist's to move and delete, and gone at the end."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.core.jobs.runner import Job
from snerg.operators import watch
from snerg.snerg_addon import activity, training_object
from snerg.snerg_addon.activity import Activity
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.scene_object import folder_of, make, show_scene, snerg_objects
from snerg.snerg_addon.viewport.loading import cached, loaded

WAIT = "import time; time.sleep(100)"


@pytest.fixture
def training(scene) -> Iterator[tuple[Activity, Path]]:
    """A process that stands for a training, and the folder of its preview."""
    project = project_of(scene)
    out = project.new_version("field")
    job = Job([sys.executable, "-c", WAIT, "train", "--out", str(out), "--preview"]).begin(project.folder, {"scene": scene.name})
    running = Activity("field", "Training", job, "snerg.train", project.folder, scene.name, scene.session_uid)
    activity.begin(running)
    yield running, out / "preview"
    kill(job)
    activity.stop()


def objects() -> list[bpy.types.Object]:
    bpy.context.view_layer.update()
    return list(snerg_objects(bpy.context.view_layer))


def kill(job: Job) -> None:
    if job._process.poll() is None:
        os.kill(job._process.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        job._process.wait()


def preview(folder: Path, centre: float = 0.0) -> None:
    """Write a preview, and let the timer see it."""
    write_scene(make_snerg((34, 30, 40), diffuse=True, fog=False, centre=(centre, 0, 0)), folder)
    watch.tick()
    cached(folder)
    watch.tick()


def test_a_preview_is_shown_where_it_was_baked_and_goes_away_with_the_training(training):
    running, folder = training
    watch.tick()
    assert not objects(), "There is no preview yet"
    preview(folder, 0.5)
    (thing,) = objects()
    assert thing.snerg.temporary and thing.hide_render and folder_of(thing) == folder
    assert np.allclose(thing.matrix_world.translation, (0.5, 0, 0), atol=1e-6)
    kill(running.task)
    watch.tick()
    assert not objects() and not folder.exists() and not activity.current()


def test_the_next_preview_is_shown_by_the_same_object_where_the_artist_put_it(training):
    _, folder = training
    preview(folder)
    (thing,) = objects()
    thing.location, before = (1, 2, 3), cached(folder)
    preview(folder)
    assert objects() == [thing] and tuple(thing.location) == (1, 2, 3)
    assert cached(folder) is not before


def test_while_the_next_preview_is_read_the_last_one_is_shown(training):
    _, folder = training
    preview(folder)
    before = cached(folder)
    write_scene(make_snerg((34, 30, 40), diffuse=True, fog=False), folder)
    assert loaded(folder).scene is not None, "The object would flicker"
    assert cached(folder) is not before


def test_an_object_that_the_artist_deletes_stays_away_and_one_that_undo_removes_comes_back(training):
    _, folder = training
    preview(folder)
    bpy.data.objects.remove(objects()[0])
    training_object.undone()  # as the handlers call it
    watch.tick()
    (again,) = objects()
    bpy.data.objects.remove(again)
    for _ in range(3):
        watch.tick()
    assert not objects()


def test_a_bake_takes_no_object_of_a_training_and_leaves_the_artists_own(training, scene, tmp_path):
    running, folder = training
    preview(folder)
    baked = project_of(scene).new_version("scene")
    write_scene(make_snerg((34, 30, 40), diffuse=True, fog=False), baked)
    mine = make(cached(folder), tmp_path / "mine", scene.collection, "Mine")
    bake = show_scene(scene, project_of(scene), baked, baked)
    assert not bake.snerg.temporary and folder_of(bake) == baked
    kill(running.task)
    watch.tick()
    assert set(objects()) == {mine, bake}


def test_a_file_saved_meanwhile_has_no_such_object_when_it_is_opened_again(training, tmp_path):
    running, folder = training
    preview(folder)
    path = tmp_path / "saved.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert [thing.snerg.temporary for thing in objects()] == [True], "Saving takes the object away from the artist"
    kill(running.task)
    activity.stop()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert not objects()


def test_an_operator_on_it_says_why_not(training):
    preview(training[1])
    (thing,) = objects()
    bpy.context.view_layer.objects.active = thing
    assert not bpy.ops.snerg.pack_scene.poll() and not bpy.ops.snerg.export_vdb.poll()
