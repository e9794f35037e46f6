"""Another Python for training, such as one with a GPU build of JAX: it is asked for its devices, and runs the jobs that need JAX."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import tempfile
import time
from collections.abc import Sequence

from ..core.errors import SnergError
from ..core.jobs.runner import Job, command_line, environment_of, start_command
from ..core.progress import Progress
from .preferences import training_python
from .questions import Answer, Questions

PATIENCE = 120.0  # seconds to wait for a Python's answer: JAX sets up its devices
OLDEST = (3, 11)  # version of Python that runs SNeRG
VERSION = "import sys; print('Python %d.%d' % sys.version_info[:2])"  # a program for any version
NEEDED = "numpy, pillow, msgpack, jax and optax"


def start_training(arguments: Sequence[str]) -> Job:
    """A command that needs JAX, as a job of the Python that the preferences name; without one, of Blender's own.

    Raises SnergError when that Python does not exist, or has said that it cannot train.
    """
    python = training_python()
    answer = _pythons.known(python)
    if answer is not None and answer.state == "unready":
        raise SnergError(f"The Python for training, {python}, does not serve: {answer.text}")
    return start_command(arguments, python or None)


def devices() -> Answer | None:
    """What the preferences' Python says of its devices; None where they name none. It is asked once a session, in a process of its own."""
    python = training_python()
    return _pythons.answer(python) if python else None


def ask_again() -> None:
    """Forget the answer of the preferences' Python, because its packages may have changed."""
    _pythons.forget(training_python())


def _ask(python: str, progress: Progress) -> Answer:
    """Which devices a Python has. Raises SnergError where it cannot train."""
    said = _last_line([python, "-c", VERSION], python, progress)
    version = re.fullmatch(r"Python (\d+)\.(\d+)", said)
    if version is None:
        raise SnergError(f"{python} is no Python ({said[:200]}); choose a Python's program file, such as bin/python3.")
    if (int(version[1]), int(version[2])) < OLDEST:
        raise SnergError(f"It is {said}, and SNeRG needs Python {OLDEST[0]}.{OLDEST[1]} or newer; choose another.")
    said = _last_line(command_line(["info", "--devices", "--json"], python), python, progress)
    with contextlib.suppress(ValueError, TypeError, KeyError):
        report = json.loads(said)
        return Answer(str(report["training"]), "unready" if report["platform"] is None else "ready")
    raise SnergError(f"It cannot run SNeRG ({said[:200]}); install {NEEDED} in it, or choose another.")


def _last_line(command: Sequence[str], python: str, progress: Progress) -> str:
    """The last line that a command prints. Raises SnergError where it cannot be started or takes longer than PATIENCE."""
    began = time.monotonic()
    with tempfile.TemporaryFile() as output:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment_of(python),
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            reason = error.strerror or error
            raise SnergError(f"{python} cannot be started ({reason}); choose a Python's program file, such as bin/python3.") from error
        try:
            while process.poll() is None:
                progress(0.0, "Asking")
                if time.monotonic() - began > PATIENCE:
                    raise SnergError(f"It does not answer within {PATIENCE:.0f} seconds; choose another Python.")
                time.sleep(0.05)
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        lines = output.read().decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else "it says nothing"


_pythons = Questions("Asking it which devices it has ...", _ask, "unready")
poll, stop = _pythons.poll, _pythons.stop
