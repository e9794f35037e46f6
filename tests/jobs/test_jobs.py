"""Jobs as they are: real processes, well-behaved, silent, killed, stubborn and out of memory."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from snerg.core.errors import Cancelled, SnergError
from snerg.core.jobs import runner
from snerg.core.jobs.runner import Job, start_verb

ROOT = Path(runner.__file__).resolve().parents[2]

PREFIX = f"""
import importlib, importlib.util, os, signal, sys, time
spec = importlib.util.spec_from_file_location("launcher", {str(ROOT / "launcher.py")!r})
launcher = importlib.util.module_from_spec(spec)
spec.loader.exec_module(launcher)
launcher.load(launcher.Path({str(ROOT)!r}))
from snerg.core.errors import SnergError
from snerg.core.jobs.protocol import run_job
"""


def job(work: str) -> Job:
    """A child that runs `work` (the body of a function of `progress`) as a job."""
    body = "\n".join("    " + line for line in work.strip().splitlines())
    return Job([sys.executable, "-c", f"{PREFIX}\ndef work(progress):\n{body}\nsys.exit(run_job(work))"])


def test_result_and_progress_arrive():
    said: list[tuple[float, str]] = []
    child = job("for k in range(5): progress(k / 5, f'step {k} \\u00e9'); time.sleep(0.05)\nreturn {'psnr': 31.5}")
    assert child.wait(lambda fraction, message: said.append((fraction, message)), interval=0.01) == {"psnr": 31.5}
    assert child.state == "done" and child.fraction == 1.0
    assert any(message.endswith("\u00e9") for _, message in said)


def test_stray_prints_do_not_break_the_protocol():
    child = job("print('{\"error\": \"not ours\"}'); os.system('echo banner'); sys.stderr.write('x' * 300000)\nreturn {'fine': True}")
    assert child.wait() == {"fine": True}


def test_an_error_is_one_sentence():
    with pytest.raises(SnergError, match=r"^The box is flat\.$"):
        job("raise SnergError('The box is flat.')").wait()


def test_an_unforeseen_error_is_one_sentence_too():
    child = job("return {}['missing']")
    with pytest.raises(SnergError, match=r"KeyError: 'missing'"):
        child.wait()
    assert any("Traceback" in line for line in child.log)


def test_out_of_memory_says_so():
    with pytest.raises(SnergError, match="not enough memory"):
        job("raise MemoryError").wait()


def test_cancel_ends_it_at_its_next_word():
    child = job("for k in range(10**6): progress(0.5, 'working'); time.sleep(0.01)")
    while child.message != "working":
        child.poll()
        time.sleep(0.01)
    child.cancel()
    assert child.cancelling
    start = time.monotonic()
    with pytest.raises(Cancelled, match="Stopped as you asked"):
        child.wait()
    assert time.monotonic() - start < 5


def test_a_stubborn_job_is_ended(monkeypatch):
    monkeypatch.setattr(runner, "GRACE_SECONDS", 0.3)
    child = job("signal.signal(signal.SIGTERM, signal.SIG_IGN); progress(0, 'deaf'); time.sleep(60)")
    while child.message != "deaf":
        child.poll()
        time.sleep(0.01)
    child.cancel()
    with pytest.raises(Cancelled, match="Stopped"):
        child.wait()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="a POSIX signal")
def test_a_killed_job_ends_in_a_sentence():
    with pytest.raises(SnergError, match="memory ran out"):
        job("os.kill(os.getpid(), signal.SIGKILL)").wait()


def test_a_crash_ends_in_a_sentence():
    with pytest.raises(SnergError, match=r"code 7: last words"):
        job("sys.stderr.write('last words\\n'); sys.stderr.flush(); os._exit(7)").wait()


def test_progress_that_raises_stops_the_job():
    def stop(fraction: float, message: str) -> None:
        raise Cancelled("enough")

    child = job("for k in range(10**6): progress(0.5, 'working'); time.sleep(0.01)")
    with pytest.raises(Cancelled, match="enough"):
        child.wait(stop)
    assert child.state == "cancelled"


def test_a_python_that_is_not_there_is_reported():
    with pytest.raises(SnergError, match="was not found"):
        start_verb(["info", "."], python="/nowhere/python3")
    with pytest.raises(SnergError, match="Cannot start"):
        Job([os.path.join(os.sep, "nowhere", "python3")])


def test_the_launcher_runs_a_verb(tmp_path):
    child = start_verb(["info", str(tmp_path / "missing")])
    with pytest.raises(SnergError, match="missing"):
        child.wait()
    assert child.state == "failed", json.dumps(list(child.log))
