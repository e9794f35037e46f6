"""The preview renders in a thread; Blender shows each pass, the coarse one first."""

from __future__ import annotations

import time

import bpy
import numpy as np
import pytest
from stage import add_camera

from scenes import make_snerg
from snerg.core.errors import Cancelled, SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.rendering.render import render_scene
from snerg.operators.preview import PreviewTask, enlarged
from snerg.snerg_addon.bridge import camera_from_blender
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.project import project_of

NAME = "SNeRG Preview"


@pytest.fixture
def baked(scene):
    """A project with a baked scene, and a camera that sees it."""
    snerg = make_snerg((34, 30, 40), diffuse=True)
    write_scene(snerg, project_of(scene).scene)
    scene.camera = add_camera("Above", (0.2, -0.1, 4))
    bpy.context.view_layer.update()
    return scene, snerg, camera_from_blender(scene.camera, scene, evaluated(scene))


def test_the_picture_is_what_the_marcher_gives(baked):
    scene, snerg, camera = baked
    assert bpy.ops.snerg.preview() == {"FINISHED"}
    image = bpy.data.images[NAME]
    shown = np.array(image.pixels[:]).reshape(camera.height, camera.width, 4)[::-1]
    wanted = render_scene(snerg, camera).over(tuple(scene.snerg.background))
    assert np.ptp(wanted) > 0.3 and np.abs(shown[..., :3] - wanted).max() < 1.01 / 255


def test_the_picture_survives_in_the_file_though_no_editor_shows_it(baked, tmp_path):
    assert bpy.ops.snerg.preview() == {"FINISHED"}
    before = np.array(bpy.data.images[NAME].pixels[:])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    assert NAME in bpy.data.images, "The preview is lost with the session"
    assert np.array_equal(np.array(bpy.data.images[NAME].pixels[:]), before)


def finish(work: PreviewTask) -> None:
    while work.poll():
        time.sleep(0.01)


def test_a_small_picture_comes_first(baked):
    scene, _, camera = baked
    seen = []
    work = PreviewTask(project_of(scene), camera, seen.append)
    finish(work)
    assert work.state == "done" and work.fraction == 1
    assert seen[-1].alpha.shape == (24, 32)
    assert all(frame.alpha.shape in ((6, 8), (24, 32)) for frame in seen)
    pixels = np.arange(12.0).reshape(2, 2, 3)
    assert np.array_equal(enlarged(pixels, 7, 8)[::4, ::4], pixels) and enlarged(pixels, 7, 8).shape == (8, 7, 3)
    assert enlarged(pixels, 2, 2) is pixels
    assert enlarged(np.zeros((3, 17, 3)), 500, 61).shape == (61, 500, 3)  # the width grew by more than the height


def test_stopping_and_failing_end_as_jobs_do(baked):
    scene, _, camera = baked
    work = PreviewTask(project_of(scene), camera.resized(3000, 3000), lambda frame: None)
    work.cancel()
    assert work.cancelling
    began = time.perf_counter()
    with pytest.raises(Cancelled, match="Stopped"):
        work.wait()
    assert time.perf_counter() - began < 2 and work.state == "cancelled"
    (project_of(scene).scene / "scene.json").write_text("{}")
    broken = PreviewTask(project_of(scene), camera, lambda frame: None)
    finish(broken)
    assert broken.state == "failed" and "scene.json" in broken.error
    with pytest.raises(SnergError, match=r"scene\.json"):
        broken.wait()
    with pytest.raises(RuntimeError, match=r"scene\.json"):
        bpy.ops.snerg.preview()
