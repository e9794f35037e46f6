"""The command line as scripts use it: streams, JSON, exit codes and one sentence for each mistake."""

import io
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flax_checkpoint import networks, tree, write
from scenes import make_snerg
from snerg.core import cli
from snerg.core.baking.bake import BakeSettings
from snerg.core.commands import bake, render
from snerg.core.commands import eval as eval_command
from snerg.core.commands.train import settings_of
from snerg.core.errors import EXIT_STOPPED, SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import write_scene
from snerg.core.jobs.runner import start_command
from snerg.core.nerf.checkpoint import read_field
from snerg.core.progress import Note
from snerg.core.rendering.render import MarchSettings
from snerg.core.terminal import Terminal


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


def test_a_scene_says_how_its_pictures_are_stored(scene, tmp_path, capsys):
    snerg = make_snerg((31, 30, 33), diffuse=True)
    write_scene(snerg, tmp_path / "jpeg", codec=CodecSettings("jpeg", 80))
    write_scene(replace(snerg, cells=snerg.cells / np.float32(255)), tmp_path / "float")
    for path, codec in ((scene, "png"), (tmp_path / "jpeg", "jpeg, quality 80"), (tmp_path / "float", "float")):
        assert cli.main(["info", str(path), "--json"]) == 0
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["codec"] == codec


def test_people_get_a_table(scene, capsys):
    assert cli.main(["info", str(scene)]) == 0
    out = capsys.readouterr().out
    assert "voxels" in out and "[31, 30, 33]" in out and "{" not in out.splitlines()[0]


def test_every_command_has_help(capsys):
    for command in ("train", "import", "bake", "eval", "render", "export", "bundle", "effects", "estimate", "study", "info"):
        assert cli.main([command, "--help"]) == 0
        assert f"snerg {command}" in capsys.readouterr().out
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
        ["bake", "x", "--out", "y", "--resolution", "9", "--voxel-size", "0.1"],
        ["bake", "x", "--out", "y", "--voxel-size", "0"],
        ["bake", "x", "--out", "y", "--samples", "some"],
        ["bake", "x", "--out", "y", "--samples", "65"],
        ["bake", "x", "--out", "y", "--quality", "9"],
        ["bake", "x", "--out", "y", "--quality", "9", "--codec", "png"],
        ["bake", "x", "--out", "y", "--float", "--codec", "webp"],
        ["eval", "x", "--tolerance", "2"],
        ["render", "x", "--cameras", "y", "--out", "z", "--tolerance", "nan"],
        ["train", "x", "--out", "y", "--view-dependence", "some"],
        ["train", "x", "--out", "y", "--background", "1,2"],
        ["train", "x", "--out", "y", "--background", "0,0,256"],
        ["train", "x", "--out", "y", "--ndc", "maybe"],
        ["train", "x", "--out", "y", "--downscale", "0"],
        ["train", "x", "--out", "y", "--set", "rate"],
        ["train", "x", "--out", "y", "--set", "frobnicate=1"],
        ["train", "x", "--out", "y", "--set", "rate=fast"],
        ["train", "x", "--out", "y", "--background", "pinkish"],
        ["train", "x", "--out", "y", "--process", "1"],
        ["train", "x", "--out", "y", "--coordinator", "nowhere", "--processes", "2"],
        ["train", "x", "--out", "y", "--holdout", "1"],
        ["info"],
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
    for path in (folder / "train").iterdir():  # one alone is left out
        path.write_bytes(path.read_bytes()[:200])
    return ["train", folder, "--steps", "1"]


def no_dataset(tmp_path, dataset, scene):
    return ["train", tmp_path / "nothing", "--steps", "1"]


def cut_checkpoint(tmp_path, dataset, scene):
    path = write(tmp_path / "checkpoint_1", tree(networks(np.random.default_rng(0))))
    path.write_bytes(path.read_bytes()[:-1000])
    return ["import", path]


def other_checkpoint(tmp_path, dataset, scene):
    (tmp_path / "checkpoint_1").write_bytes(b"\x80\x04\x95 a pickle")
    return ["import", tmp_path / "checkpoint_1"]


def transforms(tmp_path, dataset, change):
    """A copy of the dataset whose transforms_train.json `change` has changed."""
    folder = shutil.copytree(dataset, tmp_path / "changed")
    value = frames_of(folder)
    change(value)
    (folder / "transforms_train.json").write_text(json.dumps(value))
    return ["train", folder, "--steps", "1"]


def nan_pose(tmp_path, dataset, scene):
    return transforms(tmp_path, dataset, lambda value: [f["transform_matrix"][0].__setitem__(0, float("nan")) for f in value["frames"]])


def singular_pose(tmp_path, dataset, scene):
    return transforms(tmp_path, dataset, lambda value: [f.update(transform_matrix=np.zeros((4, 4)).tolist()) for f in value["frames"]])


def no_pose(tmp_path, dataset, scene):
    return transforms(tmp_path, dataset, lambda value: [f.pop("transform_matrix") for f in value["frames"]])


def one_image(tmp_path, dataset, scene):
    return transforms(tmp_path, dataset, lambda value: value.update(frames=value["frames"][:1]))


def path_that_leaves(tmp_path, dataset, scene):
    (tmp_path / "secret.png").write_bytes((dataset / "train" / "0.png").read_bytes())
    return transforms(tmp_path, dataset, lambda value: value["frames"][0].update(file_path="../secret.png"))


def enormous_header(tmp_path, dataset, scene):
    folder = shutil.copytree(dataset, tmp_path / "enormous")
    for path in (folder / "train").iterdir():
        data = bytearray(path.read_bytes())
        data[16:24] = struct.pack(">II", 100_000, 100_000)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        path.write_bytes(data)
    return ["train", folder, "--steps", "1"]


def colmap_of_unknown_cameras(tmp_path, dataset, scene):
    model = tmp_path / "colmap" / "sparse" / "0"
    model.mkdir(parents=True)
    shutil.copytree(dataset / "train", tmp_path / "colmap" / "images")
    (model / "cameras.txt").write_text("1 HOLOGRAM 40 40 50 20 20\n")
    (model / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 0 0 {i} 1 {i}.png\n\n" for i in range(3)))
    (model / "points3D.txt").write_text("")
    return ["train", tmp_path / "colmap", "--steps", "1"]


def damaged_llff(tmp_path, dataset, scene):
    (tmp_path / "llff" / "images").mkdir(parents=True)
    np.save(tmp_path / "llff" / "poses_bounds.npy", np.zeros((3, 16)))
    return ["train", tmp_path / "llff", "--steps", "1"]


def pickled_llff(tmp_path, dataset, scene):
    (tmp_path / "llff" / "images").mkdir(parents=True)
    np.save(tmp_path / "llff" / "poses_bounds.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return ["train", tmp_path / "llff", "--steps", "1"]


def not_forward_facing(tmp_path, dataset, scene):
    return ["train", dataset, "--steps", "1", "--ndc", "on"]


def eval_without_dataset(tmp_path, dataset, scene):
    return ["eval", scene]


def eval_of_a_split_that_is_not_there(tmp_path, dataset, scene):
    return ["eval", scene, dataset, "--split", "mars"]


def eval_over_other_files(tmp_path, dataset, scene):
    (tmp_path / "results" / "out").mkdir(parents=True)
    (tmp_path / "results" / "out" / "thesis.txt").write_text("years of work")
    return ["eval", scene, dataset]


def no_field(tmp_path, dataset, scene):
    return ["bake", scene]


def cut_scene(tmp_path, dataset, scene):
    folder = shutil.copytree(scene, tmp_path / "cut-scene")
    (folder / "rgba_004.png").unlink()
    return ["export", folder]


def no_cameras(tmp_path, dataset, scene):
    return ["render", scene, "--cameras", tmp_path / "none.json"]


MISTAKES = [no_frames, missing_image, cut_image, no_dataset, cut_checkpoint, other_checkpoint, no_field, cut_scene, no_cameras]
MISTAKES += [nan_pose, singular_pose, no_pose, one_image, path_that_leaves, enormous_header, colmap_of_unknown_cameras]
MISTAKES += [damaged_llff, pickled_llff, not_forward_facing, eval_without_dataset, eval_of_a_split_that_is_not_there]
MISTAKES += [eval_over_other_files]


@pytest.mark.hard_case(59, 61, 62)
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.__name__)
def test_a_mistake_is_one_sentence_and_leaves_nothing(tmp_path, dataset, scene, capsys, mistake):
    if mistake is not_forward_facing:
        pytest.importorskip("jax")
    out = tmp_path / "results" / "out"
    arguments = [str(a) for a in mistake(tmp_path, dataset, scene)]
    assert cli.main([*arguments, "--out", str(out)]) == 2
    output = capsys.readouterr()
    sentence = output.err.strip().splitlines()[-1]
    assert sentence.startswith("snerg: ") and sentence.endswith(".") and "Traceback" not in output.err
    assert output.out == ""
    assert [p.name for p in out.rglob("*")] == (["thesis.txt"] if mistake is eval_over_other_files else [])
    assert not list(tmp_path.glob("results/.*"))


def test_options_reach_the_settings():
    arguments = ["train", "x", "--out", "y", "--view-dependence", "tiny", "--background", "255,128,0", "--set", "family.width=32"]
    options = cli.parser().parse_args([*arguments, "--set", "rate=0.01", "--steps", "7", "--ndc", "off", "--holdout", "5"])
    assert dict(options.set) == {"family.width": "32", "rate": "0.01"} and options.background == "#ff8000"
    settings = settings_of("fast", None, options.steps, 3, dict(options.set) | {"background": options.background})
    assert settings.family.width == 32 and settings.rate == 0.01 and settings.steps == 7 and settings.seconds is None
    assert settings.background == "#ff8000" and settings.seed == 3 and (options.holdout, options.downscale) == (5, 1)
    assert settings_of("paper", 2, None, 0, {}).seconds == 120 and settings_of("paper", 2, None, 0, {}).steps is None


def test_options_reach_the_bake_and_the_march(monkeypatch):
    seen = []
    for module, function in ((bake, "bake_scene"), (eval_command, "evaluate"), (render, "render_views")):
        monkeypatch.setattr(module, function, lambda *given: seen.append(given) or {})
    compared = ["--float", "--no-visibility", "--no-refine"]
    assert cli.main(["bake", "x", "--out", "y", "--voxel-size", "0.1", "--samples", "auto", *compared]) == 0
    assert cli.main(["bake", "x", "--out", "y", "--resolution", "90", "--samples", "3", "--no-network", "--codec", "jpeg"]) == 0
    assert seen[0][2] == BakeSettings(voxel_size=0.1, quantise=False, visibility=False) and seen[0][4] is False
    assert seen[1][2] == BakeSettings(90, 3, network=False) and seen[1][4] is True and seen[1][6].name == "jpeg"
    assert cli.main(["eval", "x", "--tolerance", "0.01"]) == 0
    assert cli.main(["render", "x", "--cameras", "y", "--out", "z", "--per-sample-network"]) == 0
    assert seen[2][-1] == MarchSettings(tolerance=0.01) and seen[3][-3:] == (MarchSettings(per_sample_network=True), None, None)


def test_devices_are_described(capsys):
    assert cli.main(["info", "--devices", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["training"].endswith(".") and report["cores"] >= 1


def test_the_console_script(scene):
    command = [str(Path(sys.executable).with_name("snerg")), "info", str(scene), "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(result.stdout)["kind"] == "scene"


def test_as_a_job(scene, tmp_path):
    child = start_command(["export", str(scene), "--out", str(tmp_path / "out")])
    assert child.wait()["kind"] == "reference scene"
    child = start_command(["info", str(tmp_path / "nothing")])
    with pytest.raises(SnergError, match="does not exist"):
        child.wait()


@pytest.mark.slow
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
    assert child.returncode == EXIT_STOPPED, errors
    assert "kept" in errors and "Traceback" not in errors
    assert read_field(out).about["steps"] > 0


def test_a_thread_leaves_the_keyboard_alone(scene, capsys):
    before, codes = signal.getsignal(signal.SIGINT), []
    thread = threading.Thread(target=lambda: codes.append((cli.main(["info", str(scene)]), signal.getsignal(signal.SIGINT))))
    thread.start()
    thread.join()
    assert codes == [(0, before)]


IN_C = """
import ctypes, signal, sys
handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(lambda number: None)
ctypes.pythonapi.PyOS_setsig.restype = ctypes.c_void_p
ctypes.pythonapi.PyOS_setsig(signal.SIGINT, handler)
del sys.modules["_signal"]
import _signal  # looks again at what is installed, as at the start of an interpreter inside Blender
assert signal.getsignal(signal.SIGINT) is None, signal.getsignal(signal.SIGINT)
from snerg.core.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_handler_that_was_installed_in_c(scene):
    """As Blender does, before its Python starts: Python cannot put it back."""
    result = subprocess.run([sys.executable, "-c", IN_C, "info", str(scene), "--json"], capture_output=True, text=True)
    assert result.returncode == 0 and result.stderr == "" and json.loads(result.stdout)["kind"] == "scene"


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
    progress = Terminal(screen)
    for step in range(5):
        progress(step / 5, f"Step {step}")
    progress.end()
    assert "\n" not in screen.getvalue() and screen.getvalue().endswith("\r\x1b[K") and " 80%  Step 4" in screen.getvalue()


def test_progress_in_a_log_is_a_line_now_and_then(monkeypatch):
    clock = iter(np.arange(0.0, 100.0, 1.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    screen = Screen(False)
    progress = Terminal(screen)
    for step in range(20):
        progress(step / 20, f"Step {step}")
    progress.end()
    assert 3 <= len(screen.getvalue().splitlines()) <= 5


@pytest.mark.parametrize("tty", [True, False])
def test_notes_stay_on_the_screen(tty):
    screen = Screen(tty)
    progress = Terminal(screen)
    progress(0.1, "Step 1")
    progress(0.1, Note("NDC: no. The cameras surround the scene."))
    progress(0.1, Note("Alpha: yes."))
    progress(0.2, "Step 2")
    progress.end()
    lines = screen.getvalue().split("\n")
    assert "NDC: no" in lines[0] and lines[1].endswith("Alpha: yes.")


def test_results_become_json():
    value = cli.json_values({"a": np.float32(1.5), "b": (np.inf, np.nan), "c": Path("x"), 3: np.arange(2), "d": None, "e": True})
    assert json.loads(json.dumps(value, allow_nan=False)) == {"a": 1.5, "b": [None, None], "c": "x", "3": [0, 1], "d": None, "e": True}
