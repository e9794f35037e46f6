"""Files and folders are whole or absent, whatever happens meanwhile: kills, a full disk, a stale half."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from snerg.core.errors import SnergError
from snerg.core.io import files
from snerg.core.io.files import new_folder, write_bytes

WRITERS = {
    "scene": ("write_scene(snerg, out)", "read_scene(out).about['which']"),
    "bundle": ("write_bundle(snerg, (), out)", "read_scene(out / 'scene').about['which']"),
    "page in one file": (
        "write_bundle(snerg, (), out, single_file=True)",
        "[(len(t), t.count('</html>')) for t in [(out / 'index.html').read_text()]]",
    ),
    "reference": ("write_reference(snerg, out)", "read_reference(out).about['which']"),
    "file": ("write_bytes(out, snerg.about['which'].encode() * 2**18)", "out.read_bytes() in (b'A' * 2**18, b'B' * 2**18) or 1 / 0"),
}
KILLS = 16
KILLER = """
import os, random, signal, sys, time
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, {tests!r})
from scenes import make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.core.export.reference import read_reference, write_reference
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.io.files import write_bytes
out = Path({out!r})
scene = make_snerg((34, 20, 20))
scenes = [replace(scene, about={{"which": which}}) for which in "AB"]
snerg = scenes[0]
began = time.perf_counter()
{write}
seconds = time.perf_counter() - began
draw = random.Random(7)
for kill in range({kills}):
    child = os.fork()
    if child == 0:
        while True:  # again and again, so that the kill falls anywhere
            for snerg in scenes:
                {write}
    end = time.perf_counter() + draw.uniform(0, 3 * seconds)
    there = True
    while time.perf_counter() < end:
        there &= out.exists()
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert there, "for an instant there was neither"
    {read}
print("whole", {kills})
"""


def run(script: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, env=environment, timeout=60)


@pytest.mark.hard_case(60)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork to kill")
@pytest.mark.parametrize("kind", WRITERS)
def test_killed_at_any_moment_the_old_or_the_new_is_there(tmp_path, kind):
    write, read = WRITERS[kind]
    out = tmp_path / "out"
    result = run(KILLER.format(tests=str(Path(__file__).parents[2]), out=str(out), write=write, read=read, kills=KILLS))
    assert result.stdout == f"whole {KILLS}\n", result.stderr


@pytest.mark.hard_case(60)
def test_a_system_that_cannot_swap_in_one_step(tmp_path, monkeypatch):
    """The old folder is set aside and put back when a kill came between the two renames."""
    monkeypatch.setattr(files, "_exchange", lambda a, b: False)
    for text in ("old", "new"):
        with new_folder(tmp_path / "out") as folder:
            (folder / "text").write_text(text)
        assert (tmp_path / "out" / "text").read_text() == text
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
    os.replace(tmp_path / "out", tmp_path / ".out.0123abcd.old")  # it bears our mark
    with pytest.raises(RuntimeError), new_folder(tmp_path / "out"):
        raise RuntimeError
    assert (tmp_path / "out" / "text").read_text() == "new"


HALF = """
import os, signal, sys
from pathlib import Path
from snerg.core.io.files import new_file, new_folder
with {writer}(Path(sys.argv[1])):
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kills")
@pytest.mark.parametrize("writer", ["new_file", "new_folder"])
def test_what_a_kill_left_is_deleted_later(tmp_path, writer):
    """A folder and a file, after an hour, by the next that write there; another's name, and what is fresh, stay."""
    for name in ("out", "out", "other"):
        subprocess.run([sys.executable, "-c", HALF.format(writer=writer), str(tmp_path / name)])
    left = sorted(path for path in tmp_path.iterdir())
    assert len(left) == 3 and all(path.suffix == ".part" for path in left)
    for path in left[:2]:  # of "other" and the first of "out"
        os.utime(path, (time.time() - 7200,) * 2)
    with getattr(files, writer)(tmp_path / "out"):
        pass
    assert set(tmp_path.iterdir()) == {tmp_path / "out", left[0], left[2]}


@pytest.mark.parametrize("writer", ["new_file", "new_folder"])
def test_what_is_not_ours_is_never_tidied(tmp_path, writer):
    """A user's folders and files that happen to be called as ours are."""
    (tmp_path / ".out.0123abcd.old").mkdir()
    (tmp_path / ".out.0123abcd.old" / "thesis.txt").write_text("mine")
    (tmp_path / ".out.4567abcd.part").write_text("mine")
    (tmp_path / "marked").mkdir()
    (tmp_path / "marked" / files.MARK).touch()
    (tmp_path / ".out.89abcdef.part").symlink_to("marked")
    (tmp_path / ".out.89abcdeX.part").mkdir()
    (tmp_path / ".out.89abcdeX.part" / files.MARK).touch()
    before = sorted(tmp_path.rglob("*"))
    for path in before:
        os.utime(path, (time.time() - 7200,) * 2, follow_symlinks=False)
    with getattr(files, writer)(tmp_path / "out"):
        pass
    after = sorted(path for path in tmp_path.rglob("*") if "out" not in path.relative_to(tmp_path).parts[0].split(".")[:1])
    assert after == before


def test_a_kill_in_the_middle_of_deleting(tmp_path, monkeypatch):
    """Of a folder that is being deleted the mark goes last, so that the rest is still known as ours."""
    folder = tmp_path / "folder"
    (folder / "a").mkdir(parents=True)
    (folder / files.MARK).touch()
    (folder / "z").touch()
    gone = []
    unlink = type(folder).unlink
    monkeypatch.setattr(type(folder), "unlink", lambda self, **more: gone.append(self.name) or unlink(self, **more))
    files._remove(folder)
    assert gone == ["z", files.MARK] and not folder.exists()


@pytest.mark.skipif(os.name != "posix", reason="folders cannot be flushed elsewhere")
@pytest.mark.parametrize("writer", ["new_file", "new_folder"])
def test_a_disk_that_does_not_flush_folders(tmp_path, monkeypatch, writer):
    """The result is in its place by then: that is no failure."""
    flush = files._flush_entries

    def refuse(folder):
        if folder == tmp_path:
            raise OSError(22, "Invalid argument")
        flush(folder)

    monkeypatch.setattr(files, "_flush_entries", refuse)
    for _ in range(2):
        with getattr(files, writer)(tmp_path / "out"):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_through_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    for text in ("old", "new"):
        with new_folder(tmp_path / "link") as folder:
            (folder / "text").write_text(text)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "text").read_text() == "new"
    assert {path.name for path in tmp_path.iterdir()} == {"there", "link"}


FULL = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import numpy as np
from scenes import make_snerg
from snerg.core.errors import SnergError
from snerg.core.export.bundle import write_bundle
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import write_scene
from snerg.core.io.files import write_bytes
out, snerg = Path({out!r}), make_snerg((34, 20, 20))
snerg.about["which"] = "A"
{limit}
try:
    {write}
except SnergError as error:
    print(error)
"""
SHORT = "resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500)); signal.signal(signal.SIGXFSZ, signal.SIG_IGN)"


@pytest.mark.hard_case(60)
@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on file sizes")
@pytest.mark.parametrize("kind", WRITERS)
def test_a_write_that_fails_leaves_the_old(tmp_path, kind):
    """Files may not grow past 1500 bytes, as on a disk that is full."""
    write, _ = WRITERS[kind]
    out = tmp_path / "out"
    tests = str(Path(__file__).parents[2])
    assert run(FULL.format(tests=tests, out=str(out), limit="", write=write)).stdout == ""
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    result = run(FULL.format(tests=tests, out=str(out), limit=SHORT, write=write))
    assert result.stdout.startswith(f"Cannot write {out} (") and result.stdout.count("\n") == 1, result.stderr
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.hard_case(60)
def test_a_disk_that_is_full(tmp_path):
    """A real one of 256 KiB, where mounting it is allowed."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    if mount is None or subprocess.run([mount, "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not allowed here")
    try:
        with new_folder(disk / "out") as folder:
            (folder / "text").write_text("old")
        with pytest.raises(SnergError, match=r"Cannot write .*out \(No space left on device\)"), new_folder(disk / "out") as folder:
            for index in range(100):
                (folder / str(index)).write_bytes(bytes(8192))
        with pytest.raises(SnergError, match="No space left"):
            write_bytes(disk / "out" / "text", bytes(2**20))
        assert [path.name for path in disk.iterdir()] == ["out"] and (disk / "out" / "text").read_text() == "old"
    finally:
        subprocess.run(["umount", disk], check=True)
