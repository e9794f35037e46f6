"""Another Python for training, such as one with a GPU build of JAX: it is asked for its devices, and runs the jobs that need JAX."""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO

from ..core.errors import SnergError
from ..core.jobs.runner import Job, command_line, environment_of, start_command
from .preferences import training_python

PATIENCE = 120.0  # seconds to wait for a Python's answer: JAX sets up its devices
NEEDED = "numpy, pillow, msgpack, jax and optax"


@dataclass
class Answer:
    """What a Python says of its devices. text: a sentence for the artist; good: whether it can train, None while it is asked."""

    text: str
    good: bool | None

    @property
    def icon(self) -> str:
        """Blender's name of the icon beside it."""
        return {None: "SORTTIME", True: "CHECKMARK", False: "ERROR"}[self.good]


@dataclass
class _Question:
    """A Python that is being asked: its process, and the file of its output."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]
    asked_at: float


_answers: dict[str, Answer] = {}
_questions: dict[str, _Question] = {}


def start_training(arguments: Sequence[str]) -> Job:
    """A command that needs JAX, as a job of the Python that the preferences name; without one, of Blender's own.

    Raises SnergError when that Python does not exist, or has said that it cannot train.
    """
    python = training_python()
    if python in _answers and _answers[python].good is False:
        raise SnergError(f"The Python for training, {python}, does not serve: {_answers[python].text}")
    return start_command(arguments, python or None)


def devices() -> Answer | None:
    """What the preferences' Python says of its devices; None where they name none. It is asked once a session, in a process of its own."""
    python = training_python()
    if not python:
        return None
    if python not in _answers:
        _answers[python] = _ask(python)
    return _answers[python]


def ask_again() -> None:
    """Forget the answer of the preferences' Python, because its packages may have changed."""
    python = training_python()
    _answers.pop(python, None)
    if question := _questions.pop(python, None):
        _end(question)


def _ask(python: str) -> Answer:
    output = tempfile.TemporaryFile()  # noqa: SIM115 (closed in _end)
    try:
        process = subprocess.Popen(
            command_line(["info", "--devices", "--json"], python),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment_of(python),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        output.close()
        return Answer(
            f"{python} cannot be started ({error.strerror or error}); choose a Python's program file, such as bin/python3.", False
        )
    _questions[python] = _Question(process, output, time.monotonic())
    return Answer("Asking it which devices it has ...", None)


def poll() -> bool:
    """Read the answers that have come. Returns whether there are any."""
    changed = False
    for python, question in list(_questions.items()):
        late = time.monotonic() - question.asked_at > PATIENCE
        if question.process.poll() is None and not late:
            continue
        question.output.seek(0)
        lines = question.output.read().decode(errors="replace").strip().splitlines() or ["it says nothing"]
        answer = Answer(f"It does not answer within {PATIENCE:.0f} seconds; choose another Python.", False)
        _answers[python] = answer if late else _read(lines[-1])
        _end(_questions.pop(python))
        changed = True
    return changed


def _read(line: str) -> Answer:
    """The answer in the last line of its output."""
    with contextlib.suppress(ValueError, TypeError):
        report = json.loads(line)
        return Answer(str(report["training"]), report["platform"] is not None)
    return Answer(f"It cannot run SNeRG ({line.strip()[:200]}); install {NEEDED} in it, or choose another.", False)


def _end(question: _Question) -> None:
    if question.process.poll() is None:
        question.process.kill()
    question.process.wait()
    question.output.close()


def stop() -> None:
    """Ask no longer."""
    while _questions:
        _end(_questions.popitem()[1])
    _answers.clear()
