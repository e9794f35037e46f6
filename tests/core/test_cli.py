"""The command line as scripts use it: streams, JSON, exit codes and one sentence for each mistake."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flax_checkpoint import networks, tree, write
from scenes import make_snerg
from snerg.core import cli
from snerg.core.export.scene import write_scene
from snerg.core.field.checkpoint import read_field
from snerg.core.jobs.runner import start_verb


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("baked") / "scene"
    write_scene(make_snerg((31, 30, 33), diffuse=True), folder)
    return folder


def test_json_is_the_last_line(scene, capsys):
    assert cli.main(["info", str(scene), "--json"]) == 0
    output = capsys.readouterr()
    value = json.loads(output.out.splitlines()[-1])
    assert value["kind"] == "scene" and value["voxels"] == [31, 30, 33] and not value["effects"]["view_dependence"]
    assert output.err == ""


def test_people_get_a_table(scene, capsys):
    assert cli.main(["info", str(scene)]) == 0
    out = capsys.readouterr().out
    assert "voxels" in out and "[31, 30, 33]" in out and "{" not in out.splitlines()[0]


def test_every_verb_has_help(capsys):
    for verb in ("train", "import", "bake", "eval", "render", "export", "bundle", "info"):
        assert cli.main([verb, "--help"]) == 0
        assert f"snerg {verb}" in capsys.readouterr().out
    assert cli.main(["--help"]) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["frobnicate"],
        ["train", "x"],
        ["train", "x", "--out", "y", "--minutes", "1", "--steps", "2"],
        ["train", "x", "--out", "y", "--minutes", "nan"],
        ["train", "x", "--out", "y", "--steps", "0"],
        ["train", "x", "--out", "y", "--seed", "-1"],
        ["train", "x", "--out", "y", "--preset", "slow"],
        ["bake", "x", "--out", "y", "--resolution", "0"],
    ],
)
def test_arguments_that_make_no_sense(arguments, capsys):
    assert cli.main(arguments) == 2
    assert capsys.readouterr().err.startswith("snerg: ")


def frames_of(folder: Path) -> dict:
    return json.loads((folder / "transforms_train.json").read_text())


def no_frames(tmp_path, dataset, scene):
    folder = shutil.copytree(dataset, tmp_path / "no-frames")
    value = frames_of(folder)
    value["frames"] = []
    (folder / "transforms_train.json").write_text(json.dumps(value))
    return ["train", folder, "--steps", "1"]


def missing_image(tmp_path, dataset, scene):
    folder = shutil.copytree(dataset, tmp_path / "missing-image")
    (folder / "train" / "3.png").unlink()
    return ["train", folder, "--steps", "1"]


def cut_image(tmp_path, dataset, scene):
    folder = shutil.copytree(dataset, tmp_path / "cut-image")
    path = folder / "train" / "3.png"
    path.write_bytes(path.read_bytes()[:200])
    return ["train", folder, "--steps", "1"]


def no_dataset(tmp_path, dataset, scene):
    return ["train", tmp_path / "nothing", "--steps", "1"]


def cut_checkpoint(tmp_path, dataset, scene):
    path = write(tmp_path / "checkpoint_1", tree(networks(np.random.default_rng(0))))
    path.write_bytes(path.read_bytes()[:-1000])
    return ["import", path]


def no_field(tmp_path, dataset, scene):
    return ["bake", scene]


def cut_scene(tmp_path, dataset, scene):
    folder = shutil.copytree(scene, tmp_path / "cut-scene")
    (folder / "rgba_004.png").unlink()
    return ["export", folder]


def no_cameras(tmp_path, dataset, scene):
    return ["render", scene, "--cameras", tmp_path / "none.json"]


MISTAKES = [no_frames, missing_image, cut_image, no_dataset, cut_checkpoint, no_field, cut_scene, no_cameras]


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.__name__)
def test_a_mistake_is_one_sentence_and_leaves_nothing(tmp_path, dataset, scene, capsys, mistake):
    if mistake is cut_image:
        pytest.importorskip("jax")
    out = tmp_path / "results" / "out"
    arguments = [str(a) for a in mistake(tmp_path, dataset, scene)]
    assert cli.main([*arguments, "--out", str(out)]) == 2
    output = capsys.readouterr()
    sentence = output.err.strip().splitlines()[-1]
    assert sentence.startswith("snerg: ") and sentence.endswith(".") and "Traceback" not in output.err
    assert output.out == ""
    assert not out.exists() and not list(tmp_path.glob("results/.*"))


def test_the_console_script(scene):
    command = [str(Path(sys.executable).with_name("snerg")), "info", str(scene), "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(result.stdout)["kind"] == "scene"


def test_as_a_job(scene, tmp_path):
    child = start_verb(["export", str(scene), "--out", str(tmp_path / "out")])
    assert child.wait()["kind"] == "reference scene"
    child = start_verb(["info", str(tmp_path / "nothing")])
    with pytest.raises(cli.SnergError, match="does not exist"):
        child.wait()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_the_keyboard_stops_a_training_and_keeps_it(dataset, tmp_path):
    pytest.importorskip("jax")
    out = tmp_path / "field"
    command = [sys.executable, "-m", "snerg.core.cli", "train", str(dataset), "--out", str(out), "--minutes", "5"]
    child = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    assert child.stderr is not None
    for line in child.stderr:  # nothing but progress
        if "Step" in line:
            break
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode == cli.EXIT_STOPPED, errors
    assert "kept" in errors and "Traceback" not in errors
    assert read_field(out).about["steps"] > 0


def test_the_keyboard_is_heard_between_steps_and_at_once_when_asked_twice():
    before = signal.getsignal(signal.SIGINT)
    said = []
    with cli.keyboard(lambda fraction, message: said.append(message)) as progress:
        progress(0.1, "one")
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(cli.Cancelled):
            progress(0.2, "two")
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert said == ["one"] and signal.getsignal(signal.SIGINT) is before


class Screen(io.StringIO):
    def __init__(self, tty: bool) -> None:
        super().__init__()
        self.tty = tty

    def isatty(self) -> bool:
        return self.tty


def test_progress_on_a_terminal_is_one_line(monkeypatch):
    clock = iter(np.arange(0.0, 100.0, 1.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    screen = Screen(True)
    progress = cli.Terminal(screen)
    for step in range(5):
        progress(step / 5, f"Step {step}")
    progress.end()
    assert "\n" not in screen.getvalue() and screen.getvalue().endswith("\r\x1b[K") and " 80%  Step 4" in screen.getvalue()


def test_progress_in_a_log_is_a_line_now_and_then(monkeypatch):
    clock = iter(np.arange(0.0, 100.0, 1.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    screen = Screen(False)
    progress = cli.Terminal(screen)
    for step in range(20):
        progress(step / 20, f"Step {step}")
    progress.end()
    assert 3 <= len(screen.getvalue().splitlines()) <= 5


def test_results_become_json():
    value = cli.plain({"a": np.float32(1.5), "b": (np.inf, np.nan), "c": Path("x"), 3: np.arange(2), "d": None, "e": True})
    assert json.loads(json.dumps(value, allow_nan=False)) == {"a": 1.5, "b": [None, None], "c": "x", "3": [0, 1], "d": None, "e": True}
