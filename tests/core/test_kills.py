"""Commands that are killed at seeded moments and started again: the old result is there until the new one is, which equals an
uninterrupted one."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from scenes import make_snerg
from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.export import export_reference
from snerg.core.commands.train import train_field
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.io.files import check_replaceable
from snerg.core.nerf.checkpoint import flatten, read_field
from snerg.core.training.log import read_log

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals")
FEW, MANY = 3, int(os.environ.get("SNERG_KILLS", "10"))  # kills; by hand 50
SAVE_ALWAYS = """
import sys
from snerg.core import cli, terminal
from snerg.core.baking import resume
from snerg.core.training import saving
from snerg.core.training import trainer as train
train.TELL_EVERY, saving.SAVE_SHARE, resume.SAVE_SECONDS = -1.0, 1e9, -1.0
class Saver(train.Saver):
    def __init__(self, folder, checkpoint, save_every, *more):
        super().__init__(folder, checkpoint, 0.0, *more)
train.Saver, terminal.LINE_SECONDS = Saver, 0.0
sys.exit(cli.main(sys.argv[1:]))
"""


@dataclass(frozen=True)
class Command:
    """arguments: of the command line without --out; begins: what it says when it writes; state: what is at `out`, to compare."""

    arguments: list[str]
    begins: str
    state: Callable[[Path], object]


def start(arguments: list[str], out: Path) -> subprocess.Popen:
    """What it says goes to the file `said` beside `out`, so that it never waits for anybody to read it."""
    command = [sys.executable, "-W", "ignore", "-c", SAVE_ALWAYS, *arguments, "--out", str(out)]
    with open(out.parent / "said", "wb") as said:
        return subprocess.Popen(command, stderr=said, stdout=subprocess.DEVNULL)


def killed(command: Command, out: Path, after: float, seconds: float) -> str:
    """Start it and kill it `after` so many seconds from its start, or from its first word about its work where that is negative:
    then a part of `seconds` later. Says how it ended."""
    child = start(command.arguments, out)
    if after < 0:
        while child.poll() is None and command.begins not in (out.parent / "said").read_text():
            time.sleep(0.005)
        after = -after * seconds
    end = time.monotonic() + after
    while time.monotonic() < end and child.poll() is None:
        time.sleep(0.005)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert child.returncode in (0, -signal.SIGKILL), (out.parent / "said").read_text()
    return "finished" if child.returncode == 0 else "killed"


def check(command: Command, folder: Path, kills: int) -> None:
    """Kill it so many times over an old result, a third of them while it starts; then let it end. Begin again where it ended first."""
    draw, out, old = random.Random(5), folder / "out", folder / "old"
    shutil.copytree(old, folder / "whole")
    began = time.monotonic()
    assert start(command.arguments, folder / "whole").wait() == 0
    seconds = time.monotonic() - began
    whole, before = command.state(folder / "whole"), command.state(old)
    assert whole != before
    shutil.copytree(old, out)
    done, finished = 0, 0
    while done < kills:
        after = draw.uniform(0, seconds) if draw.random() < 0.33 else -draw.random()
        ended = killed(command, out, after, seconds / 4)
        done += ended == "killed"
        state = command.state(out)
        assert state in (before, whole), f"half of a result after kill {done}"
        if state == whole:
            finished += 1
            assert len(leftovers(out)) <= 2 + done
            shutil.rmtree(out)
            shutil.copytree(old, out)
    assert start(command.arguments, out).wait() == 0 and command.state(out) == whole
    assert all(re.fullmatch(r"\.out\.[0-9a-f]{8}\.(part|old)", name) for name in leftovers(out))  # tidied an hour later
    print(f"{command.arguments[0]}: {done} kills, {finished} ended between them, equal to an uninterrupted run")


def leftovers(out: Path) -> list[str]:
    """What lies hidden beside a result."""
    return [path.name for path in out.parent.glob(f".{out.name}.*")]


def field_state(folder: Path) -> object:
    """All that a field has learnt, and the steps that its log has lines of."""
    field = read_field(folder)
    steps = [line["step"] for line in read_log(folder) if "loss" in line]
    assert steps == sorted(set(steps)) and steps[-1] == field.about["steps"]
    return field.about["steps"], *(array.tobytes() for array in flatten(field.params).values()), field.occupancy.tobytes()


def scene_state(folder: Path) -> object:
    snerg = read_scene(folder)
    return snerg.cells.tobytes(), snerg.indirection.tobytes()


def files_state(folder: Path) -> object:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def train(folder: Path, dataset: Path) -> Command:
    train_field(dataset, folder / "old", steps=6)
    return Command(["train", str(dataset), "--steps", "160"], "Step", field_state)


def bake(folder: Path, dataset: Path) -> Command:
    train_field(dataset, folder / "field", steps=12)
    bake_scene(folder / "field", folder / "old", BakeSettings(40, supersampling=1), refine=False)
    arguments = ["bake", str(folder / "field"), "--resolution", "80", "--samples", "1", "--no-refine"]
    return Command(arguments, "%", scene_state)


def export(folder: Path, dataset: Path) -> Command:
    snerg = make_snerg((60, 50, 50))
    write_scene(snerg, folder / "scene")
    write_scene(replace(snerg, cells=np.zeros_like(snerg.cells)), folder / "dark")
    export_reference(folder / "dark", folder / "old")
    return Command(["export", str(folder / "scene")], "%", files_state)


COMMANDS = (train, bake, export)


@pytest.mark.slow
@pytest.mark.hard_case(60)
def test_killed_a_few_times(tmp_path, dataset):
    """The quickest of them; trainings and bakes that are killed once or twice: test_trainer.py, test_resume.py."""
    check(export(tmp_path, dataset), tmp_path, FEW)


@pytest.mark.slow
@pytest.mark.hard_case(29, 60)
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.__name__)
def test_killed_many_times(tmp_path, dataset, command):
    pytest.importorskip("jax")
    check(command(tmp_path, dataset), tmp_path, MANY)


def test_a_kill_while_a_folder_gets_its_mark_does_not_block_it(tmp_path):
    """Found by killing bakes: the folder of what was finished held half a mark, and every later bake was refused."""
    half = tmp_path / "out" / "..snerg.0123abcd.part"
    half.mkdir(parents=True)
    check_replaceable(tmp_path / "out")
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    with pytest.raises(SnergError, match="other files"):
        check_replaceable(tmp_path / "out")
