"""Bakes that are killed, cancelled and started again."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from scenes import looking, random_network
from snerg.core.baking import resume as resume_module
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.resume import ResumeCache, run_parts
from snerg.core.errors import Cancelled, SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.files import discard
from snerg.core.nerf.field import Field
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.sampling import Domain

BOX = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
SETTINGS = BakeSettings(100, supersampling=2)
CAMERAS = tuple(Camera(24, 24, (30, 30), (12, 12), looking(eye, (0, 0, 0))) for eye in ((3, 0, 0.2), (0, -3, 0.3), (0.2, 0.1, 3)))


class Asked(Field):
    """A ball by arithmetic that counts how many points it is asked for, and takes its time over them."""

    points = 0
    seconds = 0.0

    def evaluate(self, x):
        type(self).points += len(x)
        time.sleep(self.seconds)
        density = np.where(np.linalg.norm(x, axis=-1) < 0.7, 40.0, 0).astype(np.float32)
        return density, np.concatenate([np.clip(0.5 + 0.5 * x, 0, 1), np.full((len(x), 4), 0.25)], axis=-1).astype(np.float32)


def asked() -> Asked:
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    return Asked(HashModelConfig(), {"table": np.arange(4.0)}, random_network(), domain, None, 0.01)


def bake_slowly(folder: str) -> None:
    """What the child does: keep every part at once, and say so by its files."""
    resume_module.SAVE_SECONDS = -1.0
    Asked.seconds = 0.03
    bake(asked(), BOX, CAMERAS, SETTINGS, resume=Path(folder))


def test_killed_at_any_moment_it_goes_on_and_ends_the_same(tmp_path):
    whole = bake(asked(), BOX, CAMERAS, SETTINGS)
    total, draw = Asked.points, random.Random(0)
    folder = tmp_path / "kept"
    path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    for parts in (2, 10):
        child = subprocess.Popen(
            [sys.executable, "-c", "import sys, test_resume; test_resume.bake_slowly(sys.argv[1])", str(folder)],
            env={**os.environ, "PYTHONPATH": path},
        )
        while len(list(folder.glob("*.npz"))) < parts and child.poll() is None:
            time.sleep(0.01)
        time.sleep(draw.uniform(0, 0.1))
        child.send_signal(signal.SIGKILL)
        child.wait()
    Asked.points = 0
    again = bake(asked(), BOX, CAMERAS, SETTINGS, resume=folder)
    assert 0 < Asked.points < 0.8 * total
    assert np.array_equal(whole.cells, again.cells) and np.array_equal(whole.indirection, again.indirection)
    Asked.points = 0
    bake(asked(), BOX, CAMERAS, SETTINGS, resume=folder)
    assert Asked.points == 0  # all of it was kept
    discard(folder)
    assert not folder.exists()


def test_other_settings_begin_anew(tmp_path):
    bake(asked(), BOX, CAMERAS, SETTINGS, resume=tmp_path / "kept")
    Asked.points = 0
    other = bake(asked(), BOX, CAMERAS, BakeSettings(60, supersampling=2), resume=tmp_path / "kept")
    assert Asked.points > 0
    assert np.array_equal(other.cells, bake(asked(), BOX, CAMERAS, BakeSettings(60, supersampling=2)).cells)


def test_a_damaged_part_is_done_again(tmp_path):
    whole = bake(asked(), BOX, CAMERAS, SETTINGS, resume=tmp_path / "kept")
    for path in (tmp_path / "kept").glob("*.npz"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert np.array_equal(whole.cells, bake(asked(), BOX, CAMERAS, SETTINGS, resume=tmp_path / "kept").cells)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "diary.txt").write_text("Mine.")
    with pytest.raises(SnergError, match="other files"):
        bake(asked(), BOX, CAMERAS, SETTINGS, resume=tmp_path)
    discard(tmp_path)
    assert (tmp_path / "diary.txt").exists()


@pytest.mark.parametrize("message", ["Finding", "Visibility", "Baking"])
def test_cancelled_in_any_stage_it_keeps_what_it_has(tmp_path, message):
    def stop(fraction: float, what: str) -> None:
        if what.startswith(message):
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        bake(asked(), BOX, CAMERAS, SETTINGS, stop, tmp_path / "kept")
    whole = bake(asked(), BOX, CAMERAS, SETTINGS, resume=tmp_path / "kept")
    assert np.array_equal(whole.cells, bake(asked(), BOX, CAMERAS, SETTINGS).cells)


def test_a_long_part_is_not_waited_for():
    def stop(fraction: float) -> None:
        raise Cancelled("Stopped.")

    began = time.monotonic()
    with pytest.raises(Cancelled):
        list(run_parts("slow", 1, lambda part: time.sleep(2) or {}, ResumeCache(None, ""), stop))
    assert time.monotonic() - began < 1.5


def test_parts_of_the_wrong_shape_are_done_again(tmp_path):
    whole, folder = bake(asked(), BOX, CAMERAS, SETTINGS), tmp_path / "kept"
    bake(asked(), BOX, CAMERAS, SETTINGS, resume=folder)
    edited = [path for path in folder.iterdir() if path.suffix == ".npz"]
    assert {path.name.split("-")[1] for path in edited} == {"occupancy", "visibility", "grain", "prefilter"}
    for path in edited:
        arrays = dict(np.load(path))
        np.savez(path, **{name: array[:-1] for name, array in arrays.items()})
    again = bake(asked(), BOX, CAMERAS, SETTINGS, resume=folder)
    assert np.array_equal(whole.cells, again.cells) and np.array_equal(whole.indirection, again.indirection)
