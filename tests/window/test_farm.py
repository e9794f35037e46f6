"""Frames as Flamenco's tasks in a full Blender: chunks, a kill, the check, and the same pictures as one Blender renders."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest

from farm import a_manager, arguments, compiled
from scenes import make_snerg
from snerg.core.export.scene_files import write_scene
from snerg.core.io.images import read_image

from .conftest import OUT, Blender

STAGE = """
import bpy, importlib, math
from pathlib import Path
package = next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".snerg_addon"))
module = lambda name: importlib.import_module(package + "." + name)
scene = bpy.context.scene
for thing in list(bpy.data.objects):
    bpy.data.objects.remove(thing)
folder = Path(PLACE)
baked = module("core.export.scene_files").read_scene(folder / "scene")
made = module("snerg_addon.scene_object").make(baked, folder / "scene", scene.collection)
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
camera.location = (0, 0, 4)
scene.collection.objects.link(camera)
scene.camera = camera
for frame, turn in ((1, 0.0), (20, 1.5)):
    made.rotation_euler.z = turn
    made.keyframe_insert("rotation_euler", frame=frame)
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = SIZE, SIZE, 100
scene.frame_start, scene.frame_end = 1, 20
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
"""
SIZE, FRAMES = 160, range(1, 21)


@pytest.fixture(scope="module")
def shot(blender: Blender):
    """The folder of a .blend file with a SNeRG object that turns for 20 frames."""
    place = OUT / "farm"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    write_scene(make_snerg((34, 20, 20)), place / "scene")
    script = place / "stage.py"
    script.write_text(STAGE.replace("PLACE", repr(str(place))).replace("SIZE", str(SIZE)))
    result = blender.run("-b", "--python-exit-code", "1", "--python", str(script))
    assert result.returncode == 0 and (place / "shot.blend").is_file(), result.stdout + result.stderr
    return place


def job_of(shot, name, chunk, **more):
    settings = {"work": "frames", "blendfile": str(shot / "shot.blend"), "scene": "Scene", "frames": "1-20", "chunk_size": chunk}
    settings |= {"render_output": str(shot / name / "######"), "video": False, "image_file_extension": ".png"}
    return compiled(**{**settings, **more})["tasks"]


def run(blender, task):
    """What a Worker does with a task."""
    return blender.run(*arguments(task["commands"][0])[1:])


def frame(shot, name, number):
    return shot / name / f"{number:06d}.png"


def picture(shot, name, number):
    """The pixels of a frame; its file holds the date and the time that it took, too."""
    return read_image(frame(shot, name, number))


def started(blender, task):
    """The process of a task, to be killed."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(OUT / "user"), "PYTHONPATH": ""}
    command = [blender.program, *arguments(task["commands"][0])[1:]]
    return subprocess.Popen(command, env=environment, cwd=OUT, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def test_frames_of_tasks_are_those_of_one_blender(blender, shot):
    tasks = job_of(shot, "tasks", 7)
    process = started(blender, tasks[0])
    end = time.monotonic() + 120
    while not frame(shot, "tasks", 3).is_file() and time.monotonic() < end:
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in (shot / "tasks").glob("*.png")}
    assert 3 <= len(kept) < 7
    half = max(kept)
    half.write_bytes(half.read_bytes()[:-200])  # as if it was killed while writing it
    assert run(blender, tasks[-1]).returncode == 1, "the check finds that frames are missing"
    for task in tasks:
        result = run(blender, task)
        assert result.returncode == 0, result.stdout + result.stderr
    assert all(path.stat().st_mtime_ns == kept[path] for path in kept if path != half), "what was finished is rendered again"
    (whole,) = job_of(shot, "alone", 20)[:-1]
    assert run(blender, whole).returncode == 0
    for number in FRAMES:
        assert np.array_equal(picture(shot, "tasks", number), picture(shot, "alone", number)), number
    assert not np.array_equal(picture(shot, "alone", 1), picture(shot, "alone", 20)), "the object turns"


def test_a_missing_frame_fails_the_join_by_its_number(blender, shot):
    (shot / "alone" / "000009.png").unlink(missing_ok=True)
    result = run(blender, job_of(shot, "alone", 20)[-1])
    assert result.returncode == 1 and "Frames are missing or damaged" in result.stderr + result.stdout
    assert ": 9; run their tasks again." in result.stderr + result.stdout


def test_a_worker_without_the_extension_fails(blender, shot):
    line = arguments(job_of(shot, "bare", 20)[0]["commands"][0])[1:]
    result = blender.run("--factory-startup", *line)
    assert result.returncode == 1 and not list((shot / "bare").glob("*"))


def test_the_panel_sends_frames_where_a_manager_answers(blender, shot):
    with a_manager(shot) as server:
        seen = blender.walk("send_frames", server.url, shot / "shot.blend")
    assert not seen["without"] and seen["found"] and seen["sent"], seen
    ((job, made),) = server.jobs
    assert job["name"] == "shot: frames 1-20" and len(made["tasks"]) == 5
