"""Mistakes of an artist give one sentence, CANCELLED, and no unfinished files; settings reach the command line."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path

import bpy
import numpy as np
import pytest
from stage import add_camera, add_plane

from flax_checkpoint import networks, tree, write
from scenes import make_snerg
from snerg.core.cli import parser
from snerg.core.commands.train import train_field
from snerg.core.data.readers.path_files import read_path
from snerg.core.errors import Cancelled, SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.jobs.task import StepTask
from snerg.snerg_addon import estimate_panel
from snerg.snerg_addon.bridge import STUDY
from snerg.snerg_addon.camera_move import counted, summary
from snerg.snerg_addon.project import project_of
from snerg.snerg_addon.steps import next_step


def refused(name: str, match: str, **keywords) -> None:
    """The operator must report an error; from a script, Blender raises it with the report's text."""
    with pytest.raises(RuntimeError, match=match):
        getattr(bpy.ops.snerg, name)(**keywords)


def files(scene) -> list[str]:
    folder = Path(scene.snerg.folder)
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) if folder.exists() else []


def test_each_step_says_what_it_is_waiting_for(scene):
    assert next_step(scene) == "Next: add a box, or import a dataset"
    for name, match in (
        ("train", "no dataset"),
        ("bake", "no field"),
        ("estimate", "no field"),
        ("study", "no field"),
        ("preview", "no baked scene"),
        ("export_scene", "no baked scene"),
        ("export_web", "no baked scene"),
    ):
        refused(name, match)
    assert files(scene) == []


def test_rendering_without_cameras_or_box_is_refused(scene):
    refused("render_dataset", "has no camera; add some, or choose Rig")
    scene.snerg.cameras = "SELECTED"
    refused("render_dataset", "no camera selected")
    scene.snerg.cameras = "RIG"
    refused("render_dataset", "There is no box")
    scene.snerg.cameras = "ALL"
    add_camera("All Round", type="PANO")
    refused("render_dataset", "'All Round' is pano")
    assert files(scene) == []


def started(monkeypatch, name: str) -> list[str]:
    """The command line that an operator would start."""
    module = importlib.import_module(f"snerg.operators.{name}")
    for starter in ("start_command", "start_training"):
        monkeypatch.setattr(module, starter, lambda arguments: arguments, raising=False)
    operator = getattr(module, f"SNERG_OT_{name}")  # in place of an instance, which only Blender makes
    return operator.start(operator, bpy.context, project_of(bpy.context.scene))


def test_the_panels_settings_reach_the_command_line(scene, monkeypatch):
    arguments = started(monkeypatch, "bake")
    assert arguments[4:] == ["--resolution", "256", "--samples", "0"]
    scene.snerg.voxel_size, scene.snerg.samples, scene.snerg.refine = 0.125, 3, False
    assert started(monkeypatch, "bake")[4:] == ["--voxel-size", "0.125", "--samples", "3", "--no-refine"]
    scene.snerg.refine, scene.snerg.fit, scene.snerg.prune = True, True, 0.01
    assert started(monkeypatch, "bake")[4:] == ["--voxel-size", "0.125", "--samples", "3", "--fit", "--prune", "0.01"]
    add_camera()
    assert "--codec" not in started(monkeypatch, "export_web")
    scene.snerg.codec = "webp"
    assert started(monkeypatch, "export_web")[-2:] == ["--codec", "webp"]
    scene.snerg.codec, scene.snerg.quality = "avif", 70
    assert started(monkeypatch, "export_web")[-4:] == ["--codec", "avif", "--quality", "70"]
    scene.snerg.codec, scene.snerg.half_features = "jxl", True
    assert started(monkeypatch, "export_web")[-3:] == ["--codec", "jxl", "--half-features"]
    for name in ("bake", "export_web"):  # every option is one that there is
        assert parser().parse_args(started(monkeypatch, name)).command == name.replace("export_web", "bundle")


@pytest.mark.slow
def test_what_a_bake_takes_is_said_as_the_box_is_dragged(scene, dataset):
    """The field is measured once, then the estimate follows the box; a new version of the field has to be measured again."""
    project = project_of(scene)
    assert estimate_panel.lines(bpy.context) == []
    train_field(dataset, project.field, steps=60)
    assert estimate_panel.lines(bpy.context) == []
    assert bpy.ops.snerg.estimate() == {"FINISHED"}
    whole = estimate_panel.lines(bpy.context)
    assert "B of memory" in whole[0] and "B as PNG" in whole[1]
    assert estimate_panel.probe_of(project) is estimate_panel.probe_of(project), "read once"
    scene.snerg.resolution = 512
    assert estimate_panel.lines(bpy.context) != whole
    bpy.ops.snerg.add_box()
    scene.snerg.box.location.x += 1000
    bpy.context.view_layer.update()
    assert estimate_panel.lines(bpy.context)[1].startswith("0 kB")
    scene.snerg.voxel_size = 1e-9
    (line,) = estimate_panel.lines(bpy.context)
    assert "choose at least" in line, "one sentence, in place of numbers"
    train_field(dataset, project.field, steps=70)
    assert estimate_panel.lines(bpy.context) == []


@pytest.mark.slow
def test_a_study_shows_its_pictures_in_blender(scene, dataset, monkeypatch):
    """A study gives an image; the same settings continue the same study."""
    project = project_of(scene)
    train_field(dataset, project.field, steps=60)
    scene.snerg.resolution, scene.snerg.study_minutes = 16, 1.0
    assert bpy.ops.snerg.study() == {"FINISHED"}
    note = project.notes()["study"]
    assert Path(note["report"]).is_file() and note["configurations"] >= 3
    assert bpy.data.images[STUDY].size[0] > 100
    again = started(monkeypatch, "study")
    assert again[again.index("--out") + 1] == note["out"] and parser().parse_args(again).command == "study"


def test_a_box_without_volume_is_refused(scene):
    add_camera()
    empty = bpy.data.objects.new("Flat", None)
    scene.collection.objects.link(empty)
    empty.scale = (1, 1, 0)
    bpy.context.view_layer.update()
    scene.snerg.box = empty
    refused("render_dataset", "Flat: The box has no volume")
    (project_of(scene).field).mkdir(parents=True)
    (project_of(scene).field / "field.npz").write_bytes(b"not yet a field")
    refused("bake", "Flat: The box has no volume")
    scene.snerg.box = None
    refused("bake", "field.npz|field")
    assert not project_of(scene).scene.exists()


@pytest.mark.skipif(os.name != "posix", reason="permissions are POSIX's")
def test_an_unwritable_folder_is_refused_before_the_work(scene, tmp_path):
    add_plane()
    add_camera()
    (tmp_path / "file").write_text("in the way")
    scene.snerg.folder = str(tmp_path / "file" / "project")
    refused("render_dataset", "not a folder that you can write to")


def test_a_dataset_with_a_missing_image_is_refused(scene, tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    scene.snerg.dataset = str(folder)
    refused("train", "no dataset")
    (folder / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "frames": []}')
    refused("train", "no frames")
    frame = '{"file_path": "./train/r_0", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}'
    (folder / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "frames": [' + frame + "]}")
    refused("train", "r_0")
    assert not project_of(scene).field.exists()


def test_importing_what_is_not_there_is_refused(scene, tmp_path):
    refused("import_field", "No path was given")
    refused("import_scene", "nowhere", filepath=str(tmp_path / "nowhere"))
    broken = tmp_path / "checkpoint_100"
    broken.write_bytes(b"\x81\xa6params")
    refused("import_field", "checkpoint_100", filepath=str(broken))
    assert not project_of(scene).field.exists() and not project_of(scene).scene.exists()


def test_imports_of_another_kind_write_nothing(scene, tmp_path, dataset):
    """Refused before a version's folder is made; a file inside a scene stands for the scene."""
    write_scene(make_snerg((34, 30, 20)), tmp_path / "baked")
    checkpoint = write(tmp_path / "checkpoint_7", tree(networks(np.random.default_rng(0))))
    project = project_of(scene)
    refused("import_scene", "use Import Field", filepath=str(checkpoint))
    refused("import_scene", "use Import Dataset", filepath=str(dataset))
    refused("import_field", "use Import Scene", filepath=str(tmp_path / "baked"))
    refused("import_dataset", "use Import Scene", filepath=str(tmp_path / "baked/scene.json"))
    assert not list(project.folder.glob("*/*"))
    bpy.ops.snerg.import_scene(filepath=str(tmp_path / "baked/scene.json"))
    assert project.has("scene")


def test_rendering_from_the_operator_fills_the_project(scene):
    add_plane()
    for index in range(4):
        add_camera(f"Camera {index}", (0, 0, 4 + index))
    scene.snerg.test_every = 4
    assert bpy.ops.snerg.render_dataset() == {"FINISHED"}
    project = project_of(scene)
    assert project.has("dataset") and project.notes()["dataset"]["train"] == 3
    assert next_step(scene) == "Next: train a field"
    assert bpy.ops.snerg.render_dataset() == {"FINISHED"}  # over its own earlier result


def test_the_box_fits_round_what_is_selected(scene):
    near, far = add_plane(size=2.0), add_plane(size=1.0, location=(10, 0, 0))
    near.select_set(False)
    far.select_set(True)
    assert bpy.ops.snerg.add_box() == {"FINISHED"}
    box = scene.snerg.box
    assert box.name == "SNeRG Box" and tuple(box.location) == pytest.approx((10, 0, 0), abs=1e-5)
    assert box.scale.x == pytest.approx(0.525) and box.scale.z > 0
    box.select_set(False)
    assert bpy.ops.snerg.fit_box() == {"FINISHED"}
    assert scene.snerg.box == box and box.location.x == pytest.approx(4.75)


def test_steps_end_as_jobs_do():
    def good():
        yield 0.5, "half"
        return {"views": 3}

    def bad():
        yield 0.5, "half"
        raise SnergError("The scene has no camera.")

    assert StepTask(good()).wait() == {"views": 3}
    with pytest.raises(SnergError, match="no camera"):
        StepTask(bad()).wait()
    stopped = StepTask(good())
    stopped.cancel()
    with pytest.raises(Cancelled):
        stopped.wait()


def test_a_page_needs_no_cameras(scene, monkeypatch):
    """Without cameras the page starts with a view of the whole box."""
    assert "--cameras" not in started(monkeypatch, "export_web")
    scene.snerg.web_cameras = "SELECTED"
    with pytest.raises(SnergError, match="no camera selected"):
        started(monkeypatch, "export_web")
    scene.snerg.web_cameras = "ALL"
    add_camera()
    arguments = started(monkeypatch, "export_web")
    assert "--cameras" in arguments and parser().parse_args(arguments).thumbnails == 24
    scene.snerg.web_thumbnails = 0
    assert parser().parse_args(started(monkeypatch, "export_web")).thumbnails == 0


def test_a_page_plays_the_camera_where_it_moves(scene, monkeypatch):
    """A camera that stands still, or a move that is switched off, adds nothing; what was exported is counted for the panel."""
    write_scene(make_snerg((12, 12, 12)), project_of(scene).folder / "scenes" / "001")
    scene.camera = camera = add_camera(location=(0.0, 0.0, 5.0))
    scene.frame_end = 20
    assert "--path" not in started(monkeypatch, "export_web") and not counted(scene)
    for frame, place in ((1, 5.0), (20, 3.0)):
        camera.location.z = place
        camera.keyframe_insert("location", frame=frame)
    scene.snerg.web_play = True
    arguments = started(monkeypatch, "export_web")
    parsed = parser().parse_args(arguments)
    path = read_path(parsed.path)
    assert parsed.play and (path.start, path.end) == (1, 20) and path.camera_at(20).position[2] == pytest.approx(3.0, abs=0.02)
    assert counted(scene) == summary(path)
    scene.frame_end = 10
    assert counted(scene) == "", "it was counted for other frames"
    assert bpy.ops.snerg.count_keyframes() == {"FINISHED"} and "keyframes" in counted(scene)
    scene.snerg.web_path = False
    assert "--path" not in started(monkeypatch, "export_web")


def test_a_page_says_what_the_artist_wrote(scene, monkeypatch):
    """Texts stay one word each of the command, whatever they begin with."""
    settings = scene.snerg
    assert "--orbit-distance" not in started(monkeypatch, "export_web")
    settings.page_title, settings.page_background, settings.limits_orbit = "--out", "black", True
    settings.orbit_distance, settings.orbit_elevation = (2.0, 3.5), (0.0, math.pi / 4)
    assert "--preset" not in started(monkeypatch, "export_web")
    settings.page_quality = "phone"
    parsed = parser().parse_args(started(monkeypatch, "export_web"))
    assert parsed.title == "--out" and parsed.background == "black" and parsed.description == ""
    assert parsed.orbit_distance == [2.0, 3.5] and parsed.orbit_elevation == [0.0, 45.0] and parsed.move == "orbit"
    assert parsed.preset == "phone"


def test_the_background_of_a_page(scene, monkeypatch):
    """Any colour, nothing, or a picture, which is asked for where none is named."""
    settings = scene.snerg
    for kind, expected in (("transparent", "transparent"), ("colour", "#ff8000")):
        settings.page_background, settings.page_colour, settings.page_mode = kind, (1.0, 0.5, 0.0), "walk"
        parsed = parser().parse_args(started(monkeypatch, "export_web"))
        assert parsed.background == expected and parsed.move == "walk"
    settings.page_background = "image"
    with pytest.raises(SnergError, match="choose one under About the Page"):
        started(monkeypatch, "export_web")
    settings.page_image = "/pictures/-sky.png"
    assert parser().parse_args(started(monkeypatch, "export_web")).background == "/pictures/-sky.png"


def test_what_is_wrong_with_a_dataset_folder_is_said(scene, tmp_path):
    scene.snerg.dataset = str(tmp_path / "nowhere")
    refused("train", "nowhere.*no transforms.json")
