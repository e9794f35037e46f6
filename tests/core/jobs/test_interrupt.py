"""Ctrl-C ends every command within a second, in each of its phases, and leaves no unfinished files."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from scenes import make_cameras, make_dataset, make_snerg
from snerg.core import cli
from snerg.core.commands.train import train_field
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import EXIT_STOPPED, Cancelled
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import write_scene
from snerg.core.io.files import SAVING
from snerg.core.jobs.interrupt import deadline, keyboard, watched

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc to see how far a start is")
ROOT = Path(__file__).parents[3]
LONGEST = 8.0  # seconds into a command up to which it is interrupted
LOOSE = 3.0  # seconds that a busy machine may take; what is measured is printed by the slow test
TRIES = 12  # a command, in the slow test
COMMANDS = {
    "train": "train {dataset} --out {out} --minutes 5",
    "train, hierarchical": "train {dataset} --out {out} --preset paper --steps 100000",
    "import": "import {reference} --out {out}",
    "bake": "bake {field} --out {out} --resolution 96",
    "eval": "eval {field} --out {out}",
    "render": "render {scene} --cameras {cameras} --out {out} --width 500",
    "export": "export {scene} --out {out}",
    "bundle": "bundle {scene} --out {out} --codec avif",
    "bundle in one file": "bundle {scene} --out {out} --single-file",
    "effects": "effects {field}",
    "estimate": "estimate {field}",
    "study": "study {field} --out {out} --minutes 5 --resolution 64",
    "info": "info {scene}",
}


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """Paths by name: a dataset whose images take a moment to read, a field, scenes and cameras."""
    pytest.importorskip("jax")
    folder = tmp_path_factory.mktemp("material")
    snerg = make_snerg((100, 100, 100))
    write_scene(snerg, folder / "scene")
    write_reference(snerg, folder / "reference")
    cameras = make_cameras()
    write_transforms(folder / "cameras.json", cameras, [camera.name for camera in cameras], None)
    make_dataset(folder / "dataset", 12, 3, 80)
    values = {"family.grid.levels": "4", "family.grid.log2_size": "12", "samples": "4096", "view_dependence": "deferred"}
    train_field(folder / "dataset", folder / "field", steps=20, values=values)
    return {name: folder / name for name in ("scene", "reference", "dataset", "field")} | {"cameras": folder / "cameras.json"}


def interrupted(words: list[str], delay: float, out: Path, command: tuple[str, ...] = ("-m", "snerg.core.start")) -> tuple[float, bool]:
    """Interrupt a process `delay` seconds after NumPy came in: (seconds from Ctrl-C to the end, whether it came before the end);
    (seconds that it ran, False) where it had ended."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}  # nothing is compiled before
    log = out.with_name("errors.txt")
    with open(log, "w") as errors:
        child = subprocess.Popen([sys.executable, *command, *words], stdout=subprocess.DEVNULL, stderr=errors, cwd=ROOT, env=environment)
        maps = Path(f"/proc/{child.pid}/maps")
        while child.poll() is None and "_multiarray_umath" not in maps.read_text():
            time.sleep(0.002)
        started = time.perf_counter()
        with suppress(subprocess.TimeoutExpired):
            child.wait(delay)
        pressed = time.perf_counter()
        child.send_signal(signal.SIGINT)
        code = child.wait(120)
    seconds, said = time.perf_counter() - (pressed if code else started), log.read_text()
    if code == -signal.SIGINT:  # Python's own last moments, when all is done: it hears nothing any more, and a shell says 130 too
        return seconds, True
    assert code in (EXIT_STOPPED, 0), said
    assert "Traceback" not in said and (code == 0 or said.splitlines()[-1].startswith("snerg: S")), said
    assert not [path for path in out.parent.rglob(".*") if path.suffix in (".part", ".old")]
    return seconds, code != 0


def whole(command: str, out: Path) -> bool:
    """Whether the result at `out` is absent or complete."""
    if not out.exists() or command == "study":
        return True
    if command in ("eval", "render"):
        return any(out.glob("*.png"))
    if command.startswith("train") and not (out / "field.npz").exists():
        return {path.name for path in out.iterdir()} <= {".snerg", "log.jsonl"}
    return cli.main(["info", str(out)]) == 0


@pytest.mark.parametrize("command, delay", [("train", 2.5), ("bake", 3.0), ("bundle", 0.8), ("study", 4.0), ("info", 0.0), ("info", 0.1)])
def test_a_command_stops_at_once(material, tmp_path, command, delay):
    """While it compiles, encodes and starts."""
    out = tmp_path / "out"
    seconds, stopped = interrupted(COMMANDS[command].format(out=out, **material).split(), delay, out)
    assert stopped and seconds < LOOSE and whole(command, out)


def test_the_launcher_stops_while_it_starts(material, tmp_path):
    seconds, stopped = interrupted(["info", str(material["scene"])], 0.0, tmp_path / "out", (str(ROOT / "launcher.py"),))
    assert stopped and seconds < LOOSE


def test_nothing_heavy_is_imported_before_the_keyboard_is_heard():
    script = "import sys, snerg.core.start; sys.exit('numpy' in sys.modules or 'snerg.core.cli' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


@pytest.mark.slow
def test_every_command_stops_at_once_in_every_phase(material, tmp_path, capsys):
    """At seeded random moments of each command. Prints the median, the 99th percentile and the maximum of the latencies."""
    draw, everything = random.Random(3), []
    for number, (command, text) in enumerate(COMMANDS.items()):
        taken, longest = [], LONGEST
        for turn in range(TRIES):
            out = tmp_path / str(number) / str(turn) / "out"
            out.parent.mkdir(parents=True)
            delay = draw.uniform(0, longest) if turn else longest
            seconds, stopped = interrupted(text.format(out=out, **material).split(), delay, out)
            assert whole(command, out), (command, delay)
            if stopped:
                taken.append(seconds)
            else:  # that is how long it takes
                longest = min(longest, seconds)
        everything += taken
        _print(capsys, command, taken)
    _print(capsys, "all", everything)
    assert np.median(everything) < 1 and max(everything) < 2 * LOOSE


def _print(capsys, command: str, seconds: list[float]) -> None:
    """Print how often a command was stopped, and the median, the 99th percentile and the maximum of the seconds that it took."""
    with capsys.disabled():
        told = "".join(f"{value:8.3f}" for value in (*np.percentile(seconds, (50, 99)), max(seconds))) if seconds else ""
        print(f"{command:20} {len(seconds):4}{told}", flush=True)


def run_slow(body: str, out: Path, presses: int = 1) -> tuple[int, str, float]:
    """(exit code, standard error, seconds from the first Ctrl-C) of a command with the work `body`, interrupted once it printed 'ready'."""
    script = f"""
import sys, threading, time
from pathlib import Path
from snerg.core import cli, errors
from snerg.core.commands import info as info_command
from snerg.core.io import files
out = Path({str(out)!r})
def info(path, progress):
{body}
    return {{}}
info_command.info = info
sys.exit(cli.main(["info", "x"]))
"""
    child = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert child.stderr is not None and child.stderr.readline() == "ready\n"
    began = time.perf_counter()
    for press in range(presses):
        time.sleep(1.0 if press else 0)
        child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=60)
    return child.returncode, said, time.perf_counter() - began


def test_work_that_hears_nothing_is_left_behind_and_cleaned_up(tmp_path):
    body = """
    with files.new_folder(out) as folder, files.new_file(out.with_name("file")) as file:
        (folder / "half").write_text("half")
        print("ready", file=sys.stderr, flush=True)
        time.sleep(60)
"""
    code, said, seconds = run_slow(body, tmp_path / "out")
    assert (code, said) == (130, "snerg: Stopped.\n") and seconds < LOOSE
    assert not list(tmp_path.iterdir())


SAVE = """
    print("ready", file=sys.stderr, flush=True)
    try:
        while True:
            progress(0.5, "working")
            time.sleep(0.01)
    except errors.Cancelled:
        with files.SAVING:
            time.sleep({seconds})
            files.write_bytes(out, b"saved")
        raise
"""


def test_what_is_being_saved_is_waited_for(tmp_path):
    code, said, _ = run_slow(SAVE.format(seconds=2), tmp_path / "out")
    assert code == 130 and "Saving" in said and said.endswith("is kept.\n") and (tmp_path / "out").read_bytes() == b"saved"


def test_a_second_press_does_not_wait(tmp_path):
    code, said, seconds = run_slow(SAVE.format(seconds=30), tmp_path / "out", presses=2)
    assert code == 130 and said.endswith("snerg: Stopped.\n") and seconds < 1 + LOOSE and not list(tmp_path.iterdir())


def test_any_event_asks():
    """Work stops on any event, not only on the keyboard's."""
    asked, left = threading.Event(), []
    progress = watched(lambda fraction, message: None, asked)
    threading.Timer(0.2, asked.set).start()
    with pytest.raises(Cancelled), deadline(asked, lambda: left.append(1), lambda: None):
        while True:
            progress(0.0, "")
            time.sleep(0.01)
    with deadline(asked, lambda: left.append(1), lambda: None):
        pass  # done before the deadline
    assert not left and SAVING.acquire(timeout=0)
    SAVING.release()
    with deadline(asked, lambda: left.append(1), lambda: None):
        time.sleep(1.5)
    assert left


def test_the_keyboard_is_heard_in_the_middle_of_a_call_and_given_back():
    before, threads = signal.getsignal(signal.SIGINT), threading.active_count()
    asked, again = threading.Event(), threading.Event()
    with keyboard(asked, again.set):
        progress = watched(lambda fraction, message: None, asked)
        progress(0.1, "one")
        signal.raise_signal(signal.SIGINT)
        assert asked.wait(5) and not again.is_set()
        with pytest.raises(Cancelled):
            progress(0.2, "two")
        signal.raise_signal(signal.SIGINT)
        assert again.wait(5)
    assert signal.getsignal(signal.SIGINT) is before and threading.active_count() == threads
