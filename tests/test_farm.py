"""The job type of Flamenco: how it compiles, and a study that its tasks measure."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from farm import ROOT, arguments, compiled
from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.train import train_field
from snerg.core.export.scene_files import read_scene
from snerg.core.io.images import write_png

FRAMES = {"work": "frames", "blendfile": "/s/a.blend", "scene": "Shot", "frames": "1-20", "chunk_size": 7, "fps": 25}
FRAMES |= {"render_output": "/s/{timestamp}/######", "video": True, "image_file_extension": ".png"}
BAKES = {"work": "bakes", "field": "/s/it's a field", "out": "/s/scenes", "bakes": "004=128, 005=256", "options": "--samples 4 --no-refine"}
STUDY = {"work": "study", "field": "/s/field", "out": "/s/study", "box": "/s/box.json", "parts": 8}
STUDY |= {"options": "--minutes 30", "report_options": "--target-db 30"}


def names(job):
    return [task["name"] for task in job["tasks"]]


def test_settings_are_of_the_types_that_flamenco_knows():
    settings = compiled(**FRAMES)["type"]["settings"]
    known = {
        "key",
        "type",
        "subtype",
        "choices",
        "propargs",
        "description",
        "default",
        "eval",
        "evalInfo",
        "visible",
        "required",
        "editable",
    }
    python = {"string": str, "int32": int, "float": (int, float), "bool": bool}
    assert len({setting["key"] for setting in settings}) == len(settings)
    for setting in settings:
        assert setting.keys() <= known and isinstance(setting["default"], python[setting["type"]]), setting
        assert setting.get("visible", "visible") in ("visible", "hidden", "submission", "web"), setting
        assert setting.get("subtype", "file_path") in ("file_path", "dir_path", "hashed_file_path"), setting


def test_frames_are_chunks_then_a_check_and_a_video():
    job = compiled(**FRAMES)
    assert names(job) == ["render-1-7", "render-8-14", "render-15-20", "check-frames"]
    assert job["tasks"][-1]["dependencies"] == names(job)[:-1] and not any(task["dependencies"] for task in job["tasks"][:-1])
    line = arguments(job["tasks"][1]["commands"][0])
    output = "/s/2026-01-31_120000/######"
    assert line[:5] == ["blender", "-b", "-y", "--background", "/s/a.blend"] and line[-2:] == ["--render-frame", "8..14"]
    assert line[line.index("--render-output") + 1] == output == job["settings"]["render_output"]
    assert line[line.index("--engine") + 1] == "SNERG" and line[line.index("--scene") + 1] == "Shot"
    assert line.index("--engine") < line.index("--render-output") < line.index("--python-expr") < line.index("--render-frame")
    video = job["tasks"][-1]["commands"][1]
    assert video["name"] == "frames-to-video" and video["parameters"]["inputGlob"] == "/s/2026-01-31_120000/*.png"
    assert video["parameters"]["outputFile"] == "/s/2026-01-31_120000/a.mp4"
    assert len(compiled(**{**FRAMES, "image_file_extension": ".exr"})["tasks"][-1]["commands"]) == 1, "FFmpeg shows EXR wrong"
    two = compiled(**{**FRAMES, "frames": "3,4,9", "chunk_size": 2})
    assert names(two) == ["render-3,4", "render-9", "check-frames"]
    assert arguments(two["tasks"][0]["commands"][0])[-1] == "3,4"


def test_the_join_makes_a_film_of_every_frame(tmp_path):
    av, ffmpeg = pytest.importorskip("av"), shutil.which("ffmpeg")
    if ffmpeg is None:
        pytest.skip("FFmpeg makes the film, and is not here")
    job = compiled(**{**FRAMES, "blendfile": "/s/shot.blend", "render_output": str(tmp_path / "it's {timestamp}" / "######")})
    folder = tmp_path / "it's 2026-01-31_120000"
    for number in range(1, 21):
        write_png(folder / f"{number:06d}.png", np.full((45, 61, 3), 10 * number, np.uint8))  # H.264 stores even numbers of pixels
    for _ in range(2):  # a join that is killed runs again, over what it left
        subprocess.run([ffmpeg, *arguments(job["tasks"][-1]["commands"][1])[1:]], check=True, capture_output=True)
    with av.open(str(folder / "shot.mp4")) as film:
        frames = [frame.to_ndarray(format="gray") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 25
    assert len(frames) == 20 and frames[0].shape == (46, 62)
    assert [round(float(frame[20, 20]) / 10) for frame in frames] == list(range(1, 21))


def test_each_bake_is_a_task_and_the_join_opens_all():
    job = compiled(**BAKES)
    assert names(job) == ["bake-004-128", "bake-005-256", "check-scenes"]
    snerg = ["blender", "--command", "snerg"]
    common = ["--samples", "4", "--no-refine"]
    first = [*snerg, "bake", "/s/it's a field", "--out", "/s/scenes/004", "--resolution", "128", *common]
    assert arguments(job["tasks"][0]["commands"][0]) == first
    assert [arguments(each) for each in job["tasks"][-1]["commands"]] == [[*snerg, "info", f"/s/scenes/{n}"] for n in ("004", "005")]


def test_a_study_is_its_parts_then_the_whole():
    job = compiled(**STUDY)
    assert len(job["tasks"]) == 9 and job["tasks"][-1]["dependencies"] == names(job)[:-1]
    whole = ["blender", "--command", "snerg", "study", "/s/field", "--out", "/s/study", "--box", "/s/box.json", "--minutes", "30"]
    for number, task in enumerate(job["tasks"][:-1], 1):
        assert arguments(task["commands"][0]) == [*whole, "--part", f"{number}/8"]
    assert arguments(job["tasks"][-1]["commands"][0]) == [*whole, "--target-db", "30"]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({**FRAMES, "work": "knitting"}, "work is 'knitting'; choose frames, bakes or study"),
        ({**FRAMES, "blendfile": ""}, "the setting 'blendfile' is empty, which 'frames' needs"),
        ({**FRAMES, "render_output": ""}, "the setting 'render_output' is empty"),
        ({**BAKES, "field": ""}, "the setting 'field' is empty, which 'bakes' needs"),
        ({**BAKES, "bakes": "004:128"}, "'004:128' is no bake; give NAME=VOXELS"),
        ({**BAKES, "bakes": "../x=128"}, "'../x=128' is no bake"),
        ({**BAKES, "bakes": "..=128"}, "'..=128' is no bake"),
        ({**BAKES, "bakes": "1=128,1=256"}, "have the same name"),
        ({**STUDY, "parts": 0}, "parts is 0; give 1 or more"),
    ],
)
def test_what_cannot_be_compiled_is_said(settings, told):
    with pytest.raises(ValueError, match=told.replace(".", r"\.")):
        compiled(**settings)


def start(task):
    """The process of a task's command. `snerg` runs here in this Python, which has JAX, in place of Blender's."""
    line = arguments(task["commands"][0])
    assert line[:3] == ["blender", "--command", "snerg"]
    command = [sys.executable, str(ROOT / "launcher.py"), *line[3:]]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)


def finish(process):
    out, _ = process.communicate(timeout=900)
    assert process.returncode == 0, out
    return out


def rows(folder):
    return {path.stem: path for path in (folder / "rows").glob("*.json")}


MEASURED = {"ms", "ms_95", "seconds", "write", "read", "predicted", "peak_megabytes"}  # of a row: what depends on the moment


def values(folder):
    """What the rows say, apart from times."""
    read = {key: json.loads(path.read_text()) for key, path in rows(folder).items()}
    return {key: {name: value for name, value in row.items() if name not in MEASURED} for key, row in read.items()}


@pytest.mark.slow
def test_bakes_of_tasks_are_those_of_one_machine(dataset, tmp_path):
    pytest.importorskip("jax")
    values = {"family.grid.levels": "4", "family.grid.log2_size": "12", "samples": "4096", "view_dependence": "diffuse"}
    train_field(dataset, tmp_path / "field", steps=40, values=values)
    settings = {"work": "bakes", "field": str(tmp_path / "field"), "out": str(tmp_path / "scenes"), "options": "--samples 1"}
    job = compiled(**settings, bakes="001=12, 002=20")
    for process in [start(task) for task in job["tasks"][:-1]]:
        finish(process)
    for command in job["tasks"][-1]["commands"]:
        finish(start({"commands": [command]}))
    for name, resolution in (("001", 12), ("002", 20)):
        bake_scene(tmp_path / "field", tmp_path / name, BakeSettings(resolution=resolution, supersampling=1))
        made, alone = read_scene(tmp_path / "scenes" / name), read_scene(tmp_path / name)
        assert max(made.shape) >= resolution and np.array_equal(made.cells, alone.cells)
    (tmp_path / "scenes" / "002" / "scene.json").unlink()
    missing = start({"commands": [job["tasks"][-1]["commands"][1]]})
    assert "002" in missing.communicate()[0] and missing.returncode == 2


@pytest.mark.slow
def test_a_study_of_eight_tasks_is_what_one_machine_measures(dataset, tmp_path):
    """Two at a time, as on two workers; the first is killed amid its work and runs again, and measures no row twice."""
    pytest.importorskip("jax")
    pytest.importorskip("matplotlib")
    field, out, alone = tmp_path / "field", tmp_path / "study", tmp_path / "alone"
    options = {"family.grid.levels": "4", "family.grid.log2_size": "12", "samples": "4096", "view_dependence": "deferred"}
    train_field(dataset, field, steps=60, values=options)
    more = "--minutes 20 --resolution 16 --views 1"
    job = compiled(work="study", field=str(field), out=str(out), parts=8, options=more)
    killed = start(job["tasks"][0])
    end = time.monotonic() + 300
    while len(rows(out)) < 3 and time.monotonic() < end:
        assert killed.poll() is None, killed.communicate()[0]
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    before = {key: (path.stat().st_mtime_ns, path.read_bytes()) for key, path in rows(out).items()}
    assert len(before) >= 3 and not (out / "study.json").exists()
    tasks = job["tasks"][:-1]
    for pair in zip(tasks[::2], tasks[1::2], strict=True):
        for out_of in [finish(process) for process in [start(task) for task in pair]]:
            assert re.search(r"^left out +0$", out_of, re.MULTILINE), out_of
    parts = {key: path.stat().st_mtime_ns for key, path in rows(out).items()}
    finish(start(job["tasks"][-1]))
    assert {key: path.stat().st_mtime_ns for key, path in rows(out).items()} == parts, "the join measures nothing"
    assert all((rows(out)[key].stat().st_mtime_ns, rows(out)[key].read_bytes()) == kept for key, kept in before.items())
    finish(start(compiled(work="study", field=str(field), out=str(alone), parts=1, options=more)["tasks"][-1]))
    got, want = values(out), values(alone)
    assert rows(out).keys() == rows(alone).keys() and got.keys() == want.keys() and len(got) > 40
    # A scene's files tell the seconds of its bake, hence bytes that differ by some digits.
    assert all(got[key].pop("megabytes") == pytest.approx(want[key].pop("megabytes"), abs=2e-3) for key in want)
    different = {key: [name for name in want[key] if got[key][name] != want[key][name]] for key in want}
    assert not any(different.values()), different
    assert all((out / name).is_file() for name in ("study.csv", "report.html", "contact.png")) and not (out / "work").exists()
    for name in want:
        assert (out / "pictures" / f"{name}.png").read_bytes() == (alone / "pictures" / f"{name}.png").read_bytes()
