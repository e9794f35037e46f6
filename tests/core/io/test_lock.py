"""One writer a result: a second is refused with a sentence that names the first, and a kill gives the lock back."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from scenes import make_snerg
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.export import export_reference
from snerg.core.commands.import_artifact import import_source
from snerg.core.commands.render import render_views
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.io import lock
from snerg.core.io.lock import one_writer
from snerg.core.study.evaluate import evaluate

HOLD = """
import sys, time
from pathlib import Path
from snerg.core.io.lock import one_writer
with one_writer(Path(sys.argv[1]), "a training"):
    print("held", flush=True)
    time.sleep(60)
"""
COUNT = """
import sys, time
from pathlib import Path
from snerg.core.errors import SnergError
from snerg.core.io.lock import one_writer
out, inside = Path(sys.argv[1]), Path(sys.argv[2])
turns = 0
while turns < 60:
    try:
        with one_writer(out, "a test"):
            inside.mkdir()  # fails where another is inside
            time.sleep(0.001)
            inside.rmdir()
            turns += 1
    except SnergError as error:
        assert "is being written by" in str(error), error
"""


def hold(out) -> subprocess.Popen:
    """A process that writes to `out`."""
    child = subprocess.Popen([sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "held\n"
    return child


def test_a_second_writer_is_told_of_the_first(tmp_path):
    out = tmp_path / "results" / "field"
    child = hold(out)
    try:
        with pytest.raises(SnergError) as caught, one_writer(out, "a bake"):
            pass
        said = rf"{re.escape(str(out))} is being written by a training that was started at \d\d:\d\d \(process {child.pid} on .+\); wait"
        assert re.match(said, str(caught.value))
        (tmp_path / "link").symlink_to(out.parent)
        with pytest.raises(SnergError, match="is being written"), one_writer(tmp_path / "link" / "field", "a bake"):
            pass
        with one_writer(tmp_path / "results" / "other", "a bake"):
            pass
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    assert list(out.parent.iterdir()) == [out.parent / ".field.lock"]  # a kill leaves the file, but not the lock
    with one_writer(out, "a bake"):
        pass
    assert not list(out.parent.iterdir())


def test_nothing_is_left_behind(tmp_path):
    with one_writer(tmp_path / "new" / "folders" / "field", "a training"):
        assert (tmp_path / "new" / "folders" / ".field.lock").is_file()
    assert not list(tmp_path.iterdir())
    with one_writer(tmp_path / "new" / "field", "a training"):
        (tmp_path / "new" / "field").mkdir()
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "field"]


def test_threads_are_kept_apart_too(tmp_path):
    entered, leave = threading.Event(), threading.Event()

    def work() -> None:
        with one_writer(tmp_path / "out", "an export"):
            entered.set()
            leave.wait(30)

    thread = threading.Thread(target=work)
    thread.start()
    entered.wait(30)
    try:
        with pytest.raises(SnergError, match="an export"), one_writer(tmp_path / "out", "an export"):
            pass
    finally:
        leave.set()
        thread.join()


def test_never_two_at_once(tmp_path):
    """Four processes that take turns as fast as they can: the file is deleted and made again all the time."""
    command = [sys.executable, "-c", COUNT, str(tmp_path / "out"), str(tmp_path / "inside")]
    children = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    errors = [child.communicate(timeout=60)[1] for child in children]
    assert errors == [""] * 4 and not list(tmp_path.iterdir())


def test_a_lock_file_that_says_nothing_good(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "WAIT_SECONDS", 0.0)
    for text in ("", "[]", "{", '{"pid": "x", "doing": 1, "since": 1e400}', "null"):
        with one_writer(tmp_path / "out", "a bake"):
            (tmp_path / ".out.lock").write_text(text)
            with pytest.raises(SnergError, match="being written by another process"), one_writer(tmp_path / "out", "a bake"):
                pass


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody can write to")
def test_where_no_lock_can_be_written(tmp_path):
    with pytest.raises(SnergError, match="Cannot write /proc/"), one_writer(Path("/proc/self/out"), "a bake"):
        pass
    os.symlink(tmp_path / "elsewhere", tmp_path / ".out.lock")
    with pytest.raises(SnergError, match="Cannot write"), one_writer(tmp_path / "out", "a bake"):
        pass
    assert not (tmp_path / "elsewhere").exists()


def test_every_command_that_writes_is_the_only_one(tmp_path, dataset, monkeypatch):
    monkeypatch.setattr(lock, "WAIT_SECONDS", 0.0)
    write_scene(make_snerg((31, 30, 33)), tmp_path / "scene")
    scene, out = tmp_path / "scene", tmp_path / "out"
    writers = {
        "import": lambda: import_source(scene, out),
        "export": lambda: export_reference(scene, out),
        "bundle": lambda: bundle_scene(scene, out),
        "eval": lambda: evaluate(scene, dataset, out=out),
        "render": lambda: render_views(scene, dataset / "transforms_test.json", out),
        "bake": lambda: bake_scene(tmp_path / "field", out),
    }
    with one_writer(out, "a training"):
        for name, write in writers.items():
            with pytest.raises(SnergError, match="is being written by a training"):
                write()
                pytest.fail(name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene"]


@pytest.mark.slow
def test_two_trainings_into_one_folder(tmp_path, dataset):
    """The second is refused at once, and the log is the first's alone."""
    pytest.importorskip("jax")
    command = [sys.executable, "-m", "snerg.core.cli", "train", str(dataset), "--out", str(tmp_path / "field"), "--steps", "60"]
    children = [subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    ended, end = [], time.monotonic() + 120
    while not ended and time.monotonic() < end:
        ended = [child for child in children if child.poll() is not None]
        time.sleep(0.05)
    (refused,) = ended
    assert refused.returncode == 2
    said = refused.communicate()[1]
    first = next(child for child in children if child is not refused)
    assert re.search(rf"is being written by a training that was started at \d\d:\d\d \(process {first.pid} on .*\n$", said)
    assert said.count("\n") == 1
    first.communicate(timeout=120)
    assert first.returncode == 0


def test_a_process_that_ends_in_the_middle_takes_its_lock_file_along(tmp_path):
    with one_writer(tmp_path / "out", "a bake"):
        lock.remove_locks()
        assert not list(tmp_path.iterdir())
