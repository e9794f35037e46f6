"""Another Python for training: it is asked for its devices, and its jobs run with its own packages."""

from __future__ import annotations

import json
import sys
import time

import pytest

from snerg.core.errors import SnergError
from snerg.core.jobs.runner import IMPORT_PATH
from snerg.snerg_addon import training_python


@pytest.fixture
def chosen(preference):
    """Names a Python in the preferences."""
    yield lambda path: preference("training_python", path)
    training_python.stop()


def answer():
    """Its answer, when it has come."""
    end = time.monotonic() + 120
    while (said := training_python.devices()).good is None and time.monotonic() < end:
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
    assert said.good and said.text.startswith("Training uses")
    assert training_python.devices() is said, "it is asked once"
    job = training_python.start_training(["info", "--devices"])
    assert IMPORT_PATH not in job._environment
    assert json.dumps(job.begin(tmp_path, {}, attached=True).wait()["training"]) == json.dumps(said.text)
    training_python.ask_again()
    assert training_python.devices().good is None


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script stands for a Python without packages")
def test_a_python_that_cannot_train_is_said_and_refused(chosen, tmp_path):
    chosen(str(tmp_path / "none"))
    assert "cannot be started" in answer().text
    with pytest.raises(SnergError, match="cannot be started"):
        training_python.start_training(["info", "."])
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -I "$@"\n')
    bare.chmod(0o755)
    chosen(str(bare))
    said = answer()
    assert said.good is False and "ModuleNotFoundError" in said.text and "install numpy" in said.text
    with pytest.raises(SnergError, match="does not serve"):
        training_python.start_training(["info", "."])
