"""Another Python for training: it is asked for its devices, and its jobs run with its own packages."""

from __future__ import annotations

import json
import os
import sys
import time

import pytest

from snerg.core.errors import SnergError
from snerg.core.jobs.runner import IMPORT_PATH
from snerg.snerg_addon import training_python
from snerg.snerg_addon.questions import Answer

NOT_EXECUTABLE = "echo Python 3.12"


@pytest.fixture
def chosen(preference):
    """Names a Python in the preferences."""
    yield lambda path: preference("training_python", path)
    training_python.stop()


def answer():
    """Its answer, when it has come."""
    end = time.monotonic() + 120
    while (said := training_python.devices()).state == "asked" and time.monotonic() < end:
        time.sleep(0.1)
        training_python.poll()
    return said


def test_without_one_blenders_own_python_trains(chosen):
    chosen("")
    assert training_python.devices() is None
    job = training_python.start_training(["info", "."])
    assert job.arguments[0] == sys.executable and IMPORT_PATH in job._environment


def test_a_python_says_its_devices_and_runs_jobs_with_its_own_packages(chosen, tmp_path):
    chosen(sys.executable)
    said = answer()
    assert said.state == "ready" and said.text.startswith("Training uses")
    assert training_python.devices() is said, "it is asked once"
    job = training_python.start_training(["info", "--devices"])
    assert IMPORT_PATH not in job._environment
    assert json.dumps(job.begin(tmp_path, {}, attached=True).wait()["training"]) == json.dumps(said.text)
    training_python.ask_again()
    assert training_python.devices().state == "asked"


@pytest.fixture
def program(tmp_path):
    """A program of shell lines, which stands for a Python that lacks something."""
    if sys.platform == "win32":
        pytest.skip("a shell script stands for the other Python")

    def written(lines):
        path = tmp_path / "other" / "python"
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{lines}\n")
        path.chmod(0o755)
        return path

    return written


def without_jax(tmp_path):
    """A folder whose jax, found before the real one, is missing."""
    (tmp_path / "jax.py").write_text("raise ImportError('No module named jax')\n")
    return f'PYTHONPATH={tmp_path} exec {sys.executable} "$@"'


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (None, "cannot be started (No such file or directory); choose a Python's program file"),
        (NOT_EXECUTABLE, "cannot be started (Permission denied); choose a Python's program file"),
        ("echo Hello", "is no Python (Hello); choose a Python's program file"),
        ("exit 0", "is no Python (it says nothing); choose"),
        ("echo Python 3.9", "It is Python 3.9, and SNeRG needs Python 3.11 or newer; choose another."),
        (f'exec {sys.executable} -S -I "$@"', "It cannot run SNeRG (ModuleNotFoundError: No module named 'numpy'); install numpy, pillow"),
        (without_jax, "JAX is not installed in this Python, so it can neither train nor bake: run 'pip install jax'"),
    ],
    ids=("missing", "not executable", "another program", "silent", "old", "without packages", "without JAX"),
)
def test_a_python_that_cannot_train_is_said_and_refused(chosen, program, tmp_path, lines, told):
    path = tmp_path / "none" if lines is None else program(lines(tmp_path) if callable(lines) else lines)
    if lines == NOT_EXECUTABLE:
        path.chmod(0o644)
    chosen(str(path))
    said = answer()
    assert said.state == "unready" and told in said.text
    with pytest.raises(SnergError, match="does not serve"):
        training_python.start_training(["info", "."])


def test_a_python_that_vanished_is_said_when_a_training_starts(chosen, program):
    path = program("""[ "$1" = -c ] && echo Python 3.12 || echo '{"training": "Training uses a GPU.", "platform": "gpu"}'""")
    chosen(str(path))
    assert answer() == Answer("Training uses a GPU.", "ready")
    path.unlink()
    with pytest.raises(SnergError, match=r"was not found at .*; choose another in the add-on's preferences"):
        training_python.start_training(["info", "."])
    training_python.ask_again()
    assert "cannot be started" in answer().text


def test_a_program_that_never_answers_is_ended(chosen, program, tmp_path, monkeypatch):
    monkeypatch.setattr(training_python, "PATIENCE", 1.0)
    chosen(str(program(f"echo $$ > {tmp_path / 'pid'}; exec sleep 60")))
    assert "does not answer within" in answer().text
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
