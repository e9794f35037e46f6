"""A short run of `make fuzz`: readers accept what is damaged, or refuse it with one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.skipif(os.name != "posix", reason="Windows limits no process's memory")
def test_damaged_files_are_accepted_or_refused_with_a_sentence():
    run = subprocess.run([sys.executable, "bench/fuzz.py", "--count", "300", "--seed", "5"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-4000:]
    last = run.stdout.splitlines()[-1]
    assert last.startswith("300 inputs: ") and "accepted" in last and "refused" in last
