"""Jobs outlive the window: they are found again and finished once. Datasets render in a job while the window stays free."""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
from stage import add_camera, add_plane, contents

from scenes import make_snerg
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.io.images import read_image
from snerg.core.jobs import folder as folders
from snerg.core.jobs.runner import Job, job_environment
from snerg.core.jobs.task import ThreadTask
from snerg.operators import task_operator, watch
from snerg.operators.render_dataset import SNERG_OT_render_dataset, chosen_shots, rig_settings
from snerg.snerg_addon import activity
from snerg.snerg_addon.activity import Activity
from snerg.snerg_addon.bridge import box_from_blender
from snerg.snerg_addon.capture import CaptureSettings, evaluated, render_dataset, unfinished, views_rendered
from snerg.snerg_addon.panels.main import draw_task
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.render_job import render_job

PATIENCE = 120.0
ROOT = Path(task_operator.__file__).resolve().parents[1]
SLOW_JOB = f"""
import importlib.util, sys, time
spec = importlib.util.spec_from_file_location("launcher", {str(ROOT / "launcher.py")!r})
launcher = importlib.util.module_from_spec(spec)
spec.loader.exec_module(launcher)
launcher.load(launcher.Path({str(ROOT)!r}))
from snerg.core.jobs.protocol import run_job
def work(progress):
    for k in range(10**6):
        progress(0.25, "working")
        if launcher.Path({{go!r}}).exists():
            return {{result!r}}
        time.sleep(0.01)
sys.exit(run_job(work))
"""


@pytest.fixture(autouse=True)
def nothing_left():
    yield
    for begun in activity.current():
        begun.task.cancel()
    until(lambda: not activity.current())
    activity.stop()


def until(true) -> None:
    """Call the timer's function until the condition holds."""
    end = time.monotonic() + PATIENCE
    while True:
        watch.tick()
        if true():
            return
        assert time.monotonic() < end, [(begun.label, begun.task.text) for begun in activity.current()]
        time.sleep(0.02)


def slow(go: Path, result: dict) -> Job:
    """A job that ends with `result` when the file `go` exists."""
    return Job([sys.executable, "-c", SLOW_JOB.format(go=str(go), result=result)], job_environment())


def a_field(project) -> str:
    """A new version of the field, as a training writes it."""
    version = project.new_version("field")
    (version / "field.npz").write_bytes(b"a field")
    return str(version)


def an_operator(operator: str, work) -> type:
    """An operator class that starts the task `work`; the real operator of that name finishes it."""

    class Starts(task_operator.TaskOperator):
        bl_idname, step, label = operator, "field", "Training"

        def start(self, context, project):
            return work

    return Starts


def launch(operator: str, work) -> Activity:
    return task_operator.launch(an_operator(operator, work)(), bpy.context)


def test_a_job_is_shown_and_taken_in_when_it_has_ended(scene, tmp_path):
    project = project_of(scene)
    launch("snerg.train", slow(tmp_path / "go", {"psnr": 31.25, "steps": 60, "field": a_field(project)}))
    until(lambda: activity.current()[0].task.text == "working")
    assert activity.current(project.folder)[0].outlives and activity.current(tmp_path) == []
    (tmp_path / "go").touch()
    until(lambda: not activity.current())
    assert activity.last_report(project.folder) == (f"Trained the field at 31.2 dB; it is in {project.field}", True)
    assert project.notes()["field"]["steps"] == 60


def test_the_panel_shows_what_goes_on_together_with_the_notes():
    job = Job([])
    job.text, job.notes = "Compiling the training step", ["NDC: no. The cameras look inwards."]
    layout = MagicMock()
    layout.panel.return_value = layout, layout
    draw_task(layout, Activity("field", "Training", job))
    drawn = str(layout.mock_calls)
    assert "Compiling the training step" in drawn and "NDC: no. The cameras look inwards." in drawn


def test_a_job_is_found_again_and_its_result_is_taken_in_once(scene, tmp_path):
    """Blender forgets everything, as when it closes. Opening the file again finds the job, later its result, and then nothing more."""
    project = project_of(scene)
    launch("snerg.train", slow(tmp_path / "go", {"psnr": 30.0, "field": a_field(project)}))
    activity.stop()
    watch.tick()
    begun = activity.current()[0]
    assert (begun.label, begun.operator, begun.scene, begun.task.state) == ("Training", "snerg.train", scene.name, "running")
    until(lambda: begun.task.fraction == 0.25)
    activity.stop()
    (tmp_path / "go").touch()
    folder = folders.job_folders(project.folder)[0]
    while folders.is_alive(folder):
        time.sleep(0.02)
    watch.tick()
    watch.tick()
    assert project.notes()["field"]["psnr"] == 30.0 and activity.last_report(project.folder)[1]
    activity.stop()
    watch.tick()
    assert activity.current() == [] and activity.last_report(project.folder) is None


def a_bake(scene, go: Path) -> None:
    """A bake whose scene is there when the file `go` exists."""
    folder = project_of(scene).new_version("scene")
    write_scene(make_snerg((34, 30, 40), diffuse=True), folder)
    launch("snerg.bake", slow(go, {"path": str(folder)}))


def moved(name: str, x: float) -> None:
    """A step of the artist's."""
    bpy.data.objects[name].location.x = x
    bpy.ops.ed.undo_push(message="Move")


def there(*names: str) -> list:
    return [bpy.data.objects[name].location.x for name in names if name in bpy.data.objects]


def test_undo_and_redo_take_a_bake_back_and_bring_it_again_as_a_step_of_its_own(scene, tmp_path):
    add_plane()
    bpy.ops.ed.undo_push(message="before")
    a_bake(scene, tmp_path / "go")
    moved("Plane", 1.0)
    (tmp_path / "go").touch()
    until(lambda: not activity.current())
    moved("SNeRG", 2.0)
    seen = []
    for _ in range(3):
        bpy.ops.ed.undo()
        seen.append(there("Plane", "SNeRG"))
    assert seen == [[1.0, 0.0], [1.0], [0.0]]
    for wanted in reversed(([1.0, 2.0], *seen[:2])):
        bpy.ops.ed.redo()
        assert there("Plane", "SNeRG") == wanted


def test_the_object_waits_for_the_end_of_edit_mode_whose_undo_steps_would_lose_it(scene, tmp_path):
    bpy.context.view_layer.objects.active = add_plane()
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.object.mode_set(mode="EDIT")
    (tmp_path / "go").touch()
    a_bake(scene, tmp_path / "go")
    until(lambda: activity.current()[0].task.text == "Ready; leave Edit Mode to get the result")
    assert not there("SNeRG")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.ed.undo_push(message="Toggle Edit Mode")
    until(lambda: not activity.current())
    assert there("SNeRG")
    bpy.ops.ed.undo()
    assert not there("SNeRG")
    bpy.ops.ed.redo()
    assert there("SNeRG")


def test_every_status_bar_shows_it_and_nothing_is_left_behind(scene):
    """The status bar's draw function runs at each redraw, in every workspace; it sets no text that would have to be cleared."""
    header = bpy.types.STATUSBAR_HT_header
    assert watch.draw_status in header.draw._draw_funcs
    watch.unregister()
    assert watch.draw_status not in header.draw._draw_funcs
    watch.register()


def test_a_job_of_another_project_is_not_shown(scene, tmp_path):
    launch("snerg.train", slow(tmp_path / "go", {}))
    mine = scene.snerg.folder
    scene.snerg.folder = str(tmp_path / "other")
    watch.tick()
    assert activity.current() == []
    scene.snerg.folder = mine
    watch.tick()
    assert [begun.label for begun in activity.current()] == ["Training"]


def test_the_button_stops_the_job_that_it_names(scene, tmp_path):
    first, second = launch("snerg.train", slow(tmp_path / "go", {})), launch("snerg.bake", slow(tmp_path / "go", {"second": 1}))
    until(lambda: second.task.text == "Waits for Training")
    assert bpy.ops.snerg.cancel(work=second.key) == {"FINISHED"}
    until(lambda: second not in activity.current())
    assert first in activity.current() and not first.task.cancelling
    assert activity.last_report(project_of(scene).folder) == ("Training: Stopped as you asked, before it began.", False)
    assert bpy.ops.snerg.cancel() == {"FINISHED"}
    until(lambda: not activity.current())
    assert not bpy.ops.snerg.cancel.poll()


def test_the_same_is_not_started_twice(scene, tmp_path):
    launch("snerg.train", slow(tmp_path / "go", {}))
    with pytest.raises(SnergError, match="Training with these settings is already running"):
        launch("snerg.train", slow(tmp_path / "go", {}))
    launch("snerg.train", slow(tmp_path / "go", {"other": "settings"}))
    assert len(activity.current()) == 2


def test_training_can_be_started_behind_the_dataset_that_it_needs(scene, tmp_path):
    """A bake cannot: its arguments depend on the field."""
    assert not bpy.ops.snerg.train.poll() and not bpy.ops.snerg.bake.poll()
    work = slow(tmp_path / "go", {})
    begun = activity.Activity("dataset", "Rendering", work, "snerg.render_dataset", project_of(scene).folder, scene.name)
    work.begin(begun.project, {"label": "Rendering"})
    activity.begin(begun)
    assert bpy.ops.snerg.train.poll() and not bpy.ops.snerg.bake.poll()
    work.cancel()
    until(lambda: not activity.current())
    assert not bpy.ops.snerg.train.poll()


def test_a_file_that_was_never_saved_takes_its_jobs_with_it(scene):
    assert not Activity("", "", Job([]), project=Path(bpy.app.tempdir) / "snerg").outlives
    assert Activity("", "", Job([]), project=project_of(scene).folder).outlives


def test_what_blender_does_itself_ends_with_its_scene(scene, tmp_path):
    def think(progress):
        while True:
            progress(0.5, "thinking")
            time.sleep(0.01)

    other = bpy.data.scenes.new("Other")
    other.snerg.folder = str(tmp_path / "other")
    work = ThreadTask(think)
    activity.begin(Activity("dataset", "Importing", work, "snerg.import_dataset", tmp_path / "other", other.name, other.session_uid))
    with pytest.raises(SnergError, match="still running"), bpy.context.temp_override(scene=other):
        launch("snerg.import_dataset", work)
    watch.tick()
    assert len(activity.current()) == 1 and not activity.current()[0].outlives
    bpy.data.scenes.remove(other)
    watch.tick()
    assert activity.current() == [] and work.cancelling


def test_an_operator_that_blender_made_starts_a_job_which_its_class_finishes(scene):
    """Blender gives instances another bl_idname than their class; a job's record holds the one of the class."""

    class SNERG_OT_launch(bpy.types.Operator):
        bl_idname, bl_label, step, label = "snerg.launch", "Launch", "field", "Training"

        def start(self, context, project):
            return Job([sys.executable, "-c", ""], job_environment())

        def execute(self, context):
            begun.append(task_operator.launch(self, context))
            return {"FINISHED"}

    begun: list[Activity] = []
    bpy.utils.register_class(SNERG_OT_launch)
    try:
        assert bpy.ops.snerg.launch() == {"FINISHED"}
    finally:
        bpy.utils.unregister_class(SNERG_OT_launch)
    assert begun[0].operator == "snerg.launch" == folders.read_record(begun[0].task.folder)["operator"]


def test_damaged_results_are_a_sentence(scene, tmp_path):
    folder = folders.new_job(project_of(scene).folder, {"label": "Training", "operator": "snerg.render_dataset", "scene": "gone"})
    (folder / folders.EVENTS).write_text('{"result": {}}\n')
    (folder / folders.RECORD).write_text((folder / folders.RECORD).read_text().replace('"started": ', '"started": -'))
    until(lambda: (folder / folders.TAKEN).exists())
    assert "could not be used (KeyError" in activity.last_report(project_of(scene).folder)[0]


def test_a_scripts_job_is_not_taken_in_by_a_window(scene, tmp_path):
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "scene.json").write_text("{}")
    with pytest.raises(RuntimeError, match="damaged"):
        bpy.ops.snerg.import_scene(filepath=str(tmp_path / "damaged"))
    (folder,) = folders.job_folders(project_of(scene).folder)
    assert folders.read_record(folder)["label"] == "Importing the scene" and not folders.is_alive(folder)
    watch.tick()
    assert activity.last_report(project_of(scene).folder) is None


def five_cameras(scene):
    add_plane()
    scene.cycles.seed = 3
    scene.snerg.test_every = 3
    return [add_camera(f"Camera {index}", (0, 0, 4 + index)) for index in range(5)]


def job_of(scene, goes_on: bool = True) -> Job:
    """The job that the operator starts where there is a window."""
    settings = scene.snerg
    box = box_from_blender(settings.box, evaluated(scene)) if settings.box else None
    shots = rig_settings(bpy.context.scene) if settings.cameras == "RIG" else chosen_shots(bpy.context)
    return render_job(scene, shots, project_of(scene).own_dataset, CaptureSettings(settings.test_every), box, goes_on)


def test_a_dataset_renders_in_a_process_of_its_own_with_all_unsaved_changes(scene, tmp_path):
    """The dataset has the same bytes as one rendered in this process, although the file was never saved. The copy is deleted."""
    shots = five_cameras(scene)
    project = project_of(scene)
    render_dataset(scene, shots, tmp_path / "here", CaptureSettings(3))
    launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
    scene.objects["Camera 0"].location.x += 5  # what is changed afterwards is not rendered
    until(lambda: not activity.current())
    assert activity.last_report(project.folder) == (f"Rendered 4 views to train on and 1 to test on into {project.own_dataset}", True)
    assert contents(project.own_dataset) == contents(tmp_path / "here")
    assert not bpy.data.filepath and not list((project.folder / "jobs").rglob("*.blend"))


@pytest.fixture
def unsaved_again():
    """Restore the session afterwards: a file that was never saved."""
    yield
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)


def test_relative_paths_and_painted_pictures_reach_the_copy(scene, tmp_path, unsaved_again):
    """One texture has a path that starts with //; another was painted and not saved."""
    saved = tmp_path / "work" / "file.blend"
    saved.parent.mkdir()
    picture = bpy.data.images.new("Beside", 4, 4)
    picture.pixels[:] = [0.0, 1.0, 0.0, 1.0] * 16
    picture.filepath_raw, picture.file_format = str(saved.parent / "beside.png"), "PNG"
    picture.save()
    bpy.data.images.remove(picture)
    bpy.ops.wm.save_as_mainfile(filepath=str(saved))
    beside = bpy.data.images.load(str(saved.parent / "beside.png"))
    beside.filepath = "//beside.png"
    painted = bpy.data.images.new("Painted", 4, 4)
    painted.pixels[:] = [1.0, 0.0, 0.0, 1.0] * 16
    for image, x in ((beside, -1.0), (painted, 1.0)):
        plane = add_plane(size=1.0, location=(x, 0, 0), emission=1.0)
        nodes = plane.data.materials[0].node_tree
        texture = nodes.nodes.new("ShaderNodeTexImage")
        texture.image = image
        emission = next(node for node in nodes.nodes if node.type == "EMISSION")
        nodes.links.new(texture.outputs[0], emission.inputs[0])
    add_camera("Above", (0, 0, 6))
    scene.snerg.test_every = 0
    launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
    until(lambda: not activity.current())
    pixels = read_image(project_of(scene).own_dataset / "train" / "r_0.png").astype(int)
    assert painted.is_dirty and beside.filepath == "//beside.png", "the artist's own are as they were"
    for half, colour in ((pixels[:, :16], [0, 255, 0]), (pixels[:, 16:], [255, 0, 0])):
        solid = half[half[..., 3] == 255]
        assert len(solid) > 10 and np.abs(solid[:, :3] - colour).max() <= 2


def test_the_rig_renders_in_a_process_of_its_own(scene, tmp_path):
    plane = add_plane()
    plane.select_set(True)
    bpy.ops.snerg.add_box()
    scene.snerg.cameras, scene.snerg.rig_count, scene.snerg.test_every = "RIG", 3, 0
    box = box_from_blender(scene.snerg.box, evaluated(scene))
    render_dataset(scene, chosen_shots(bpy.context), tmp_path / "here", CaptureSettings(0), box)
    launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
    until(lambda: not activity.current())
    assert contents(project_of(scene).own_dataset) == contents(tmp_path / "here")


def killed_renderings(scene, whole: dict, kills: int, rng: random.Random) -> int:
    """Render with kills at random moments; the result must equal an uninterrupted one. Returns the number of views that were kept."""
    project, kept = project_of(scene), 0

    def check(killed: bool) -> None:
        until(lambda: not activity.current())
        sentence, good = activity.last_report(project.folder)
        assert killed or good, sentence
        if not unfinished(project.own_dataset).exists():
            assert contents(project.own_dataset) == whole

    for _ in range(kills):
        begun = launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
        view = rng.randint(min(views_rendered(project.own_dataset)[0] + 2, 5), 5)
        until(lambda: begun.task.ended or begun.task.fraction >= (view - 1) / 5)  # noqa: B023
        time.sleep(rng.uniform(0.0, 0.1))
        alive = folders.is_alive(begun.task.folder)
        if alive:
            os.kill(int((begun.task.folder / folders.LOCK).read_text()), signal.SIGKILL)
        check(killed=alive)
        kept += views_rendered(project.own_dataset)[0]
    launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
    check(killed=False)
    assert views_rendered(project.own_dataset) == (0, 0)
    return kept


@pytest.mark.skipif(os.name != "posix", reason="a POSIX signal")
def test_a_killed_rendering_goes_on_and_ends_as_if_nothing_had_happened(scene, tmp_path):
    shots = five_cameras(scene)
    scene.cycles.samples = 16
    scene.render.resolution_percentage = 400
    render_dataset(scene, shots, tmp_path / "whole", CaptureSettings(3))
    killed_renderings(scene, contents(tmp_path / "whole"), 2, random.Random(1))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a POSIX signal")
def test_fifty_killed_renderings(scene, tmp_path):
    shots = five_cameras(scene)
    scene.cycles.samples = 32
    scene.render.resolution_percentage = 500
    render_dataset(scene, shots, tmp_path / "whole", CaptureSettings(3))
    kept = killed_renderings(scene, contents(tmp_path / "whole"), 50, random.Random(2))
    print(f"50 kills, {kept} views kept in all")
    assert kept > 0


def test_a_rendering_hears_that_it_shall_stop_in_the_middle_of_a_view(scene, tmp_path):
    """A rendering stops within seconds although a view takes minutes, and keeps the views before it."""
    shots = five_cameras(scene)
    scene.cycles.samples = 4096
    scene.render.resolution_x = scene.render.resolution_y = 1024
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    begun = launch(SNERG_OT_render_dataset.bl_idname, job_of(scene))
    until(lambda: begun.task.text.startswith("View 1 of 5"))
    time.sleep(0.5)
    start = time.monotonic()
    begun.task.cancel()
    until(lambda: not activity.current())
    assert time.monotonic() - start < 10.0  # of minutes; 0.5 s where the machine has nothing else to do
    scene.render.threads_mode = "AUTO"
    assert begun.task.state == "cancelled" and "views that were rendered are kept" in begun.task.error and len(shots) == 5
