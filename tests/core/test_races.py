"""A folder that is read while another process replaces it is of one generation: never half old, half new."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes import make_snerg
from snerg.core.commands.bundle import bundle_scene
from snerg.core.errors import Cancelled, SnergError
from snerg.core.export.bundle import write_bundle
from snerg.core.export.reference import read_reference, write_reference
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.io.files import new_folder
from snerg.core.io.generation import one_generation

READS = 40
REWRITE = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_races import WRITERS, generation
write, out = WRITERS[sys.argv[1]][0], Path(sys.argv[2])
number = 0
while True:
    write(generation(number), out)
    number += 1
    if number == 2:
        print("both", flush=True)
"""


def generation(number: int):
    """A scene of which every cell and `about` say which it is."""
    scene = make_snerg((34, 20, 20))
    return replace(scene, cells=np.full_like(scene.cells, number % 250), about={"number": number})


def check(snerg) -> int:
    """The number of the generation that all of a scene is of."""
    number = snerg.about["number"]
    assert (snerg.cells == number % 250).all(), f"{np.unique(snerg.cells)} in generation {number}"
    return number


def bundled(scene: Path, page: Path):
    """The scene in a page that copies the files of one."""
    bundle_scene(scene, page)
    return read_scene(page / "scene")


WRITERS = {
    "scene": (write_scene, lambda out, page: read_scene(out)),
    "reference": (write_reference, lambda out, page: read_reference(out)),
    "page": (lambda snerg, out: write_bundle(snerg, (), out), lambda out, page: read_scene(out / "scene")),
    "copy": (write_scene, bundled),
}


@contextmanager
def rewriting(kind: str, out: Path):
    """A process that replaces `out` as fast as it can."""
    script = REWRITE.format(tests=os.pathsep.join([str(Path(__file__).parent)]))
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    child = subprocess.Popen([sys.executable, "-W", "ignore", "-c", script, kind, str(out)], stdout=subprocess.PIPE, env=environment)
    try:
        assert child.stdout is not None and child.stdout.readline() == b"both\n"
        yield
        assert child.poll() is None
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("kind", WRITERS)
def test_every_read_is_of_one_generation(tmp_path, kind):
    read, seen = WRITERS[kind][1], []
    with rewriting(kind, tmp_path / "out"):
        end = time.monotonic() + 30  # a machine that does much else rewrites slowly
        while len(seen) < READS or (len(set(seen)) < 3 and time.monotonic() < end):
            seen.append(check(read(tmp_path / "out", tmp_path / "page")))
    assert seen == sorted(seen) and len(set(seen)) >= 3


def test_a_folder_replaced_in_the_middle_is_read_again(tmp_path):
    """Whatever came of the first read: a value, or an error about a file that was gone."""
    for fails in (False, True):
        write(tmp_path / "out", "old")
        reads = []

        def read(fails=fails, reads=reads) -> str:
            reads.append((tmp_path / "out" / "text").read_text())
            if len(reads) == 1:
                write(tmp_path / "out", "new")
                if fails:
                    raise SnergError("A file is gone.")
            return reads[-1]

        assert one_generation(tmp_path / "out", read) == "new" and reads == ["old", "new"]


def test_errors_of_a_folder_that_stays_are_told(tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        for kind in (SnergError, Cancelled, ZeroDivisionError):
            reads = []

            def read(kind=kind, reads=reads) -> None:
                reads.append(1)
                raise kind("As it is.")

            with pytest.raises(kind, match="As it is"):
                one_generation(path, read)
            assert reads == [1]


def test_one_that_is_always_replaced_is_given_up(tmp_path):
    write(tmp_path / "out", "0")
    with pytest.raises(SnergError, match="again and again"):
        one_generation(tmp_path / "out", lambda: write(tmp_path / "out", "1"))


def test_a_scene_that_becomes_another_kind_while_it_is_bundled(tmp_path, monkeypatch):
    from snerg.core.export import bundle
    from snerg.core.export.codecs import CodecSettings

    write_scene(generation(1), tmp_path / "scene")
    read = bundle.check_showable

    def swapped(*args):
        read(*args)
        write_scene(generation(2), tmp_path / "scene", codec=CodecSettings("webp"))

    monkeypatch.setattr(bundle, "check_showable", swapped)
    with pytest.raises(SnergError, match="another kind"):
        bundle_scene(tmp_path / "scene", tmp_path / "page")
    assert not (tmp_path / "page").exists()


def write(path: Path, text: str) -> None:
    with new_folder(path) as folder:
        (folder / "text").write_text(text)
        time.sleep(0.001)
