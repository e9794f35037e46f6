"""The parent's side of a job: start it, watch it, stop it. Nothing here blocks but `wait`."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal

from ..errors import Cancelled, SnergError

LAUNCHER = Path(__file__).resolve().parents[2] / "launcher.py"
IMPORT_PATH = "SNERG_IMPORT_PATH"  # as launcher.py reads it
GRACE_SECONDS = 15.0  # for a job to put its work away after it was told to stop, before it is ended
LOG_LINES = 60  # of standard error, kept for the sentence about a job that died

State = Literal["running", "done", "failed", "cancelled"]


class Job:
    """A process that speaks the protocol of `protocol.py`.

    Read `state`, `fraction` (0..1), `message`, `result` and `error` after `poll`.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        """Start `command`. Raises SnergError when the system cannot start it."""
        self.state: State = "running"
        self.fraction = 0.0
        self.message = "Starting"
        self.result: dict[str, Any] = {}
        self.error = ""
        self.log: deque[str] = deque(maxlen=LOG_LINES)
        self.started = time.monotonic()
        self._cancelled_at: float | None = None
        self._verdict: tuple[State, Any] | None = None
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        try:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=dict(environment) if environment is not None else None,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            raise SnergError(f"Cannot start {command[0]} ({error.strerror or error}); check Blender's installation.") from error
        self._readers = [
            threading.Thread(target=self._read_lines, args=(self._process.stdout,), daemon=True, name="snerg-job-out"),
            threading.Thread(target=self._read_log, args=(self._process.stderr,), daemon=True, name="snerg-job-log"),
        ]
        for reader in self._readers:
            reader.start()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self.started

    def poll(self) -> bool:
        """Take in what the job said since the last call; True while it runs."""
        if self.state != "running":
            return False
        ended = self._process.poll() is not None
        if ended:
            for reader in self._readers:  # the pipes are closed, so this only lets them finish
                reader.join(timeout=5)
        self._take_lines()
        if ended:
            self._settle(self._process.returncode)
        elif self._cancelled_at is not None:
            self._press(time.monotonic() - self._cancelled_at)
        return self.state == "running"

    def cancel(self) -> None:
        """Ask the job to stop. It ends by itself within GRACE_SECONDS, or is ended."""
        if self.state == "running" and self._cancelled_at is None:
            self._cancelled_at = time.monotonic()
            self.message = "Stopping"
            self._close_input()

    @property
    def cancelling(self) -> bool:
        """Told to stop and not yet ended."""
        return self.state == "running" and self._cancelled_at is not None

    def wait(self, progress: Callable[[float, str], None] | None = None, interval: float = 0.1) -> dict[str, Any]:
        """Block until the job ends and return its result.

        Raises SnergError with the job's sentence, or Cancelled; also when `progress` raises, which stops the job.
        """
        said: tuple[float, str] | None = None
        try:
            while self.poll():
                if progress and said != (self.fraction, self.message):
                    said = (self.fraction, self.message)
                    progress(*said)
                time.sleep(interval)
        except BaseException:
            self.cancel()
            while self.poll():
                time.sleep(interval)
            raise
        return outcome(self.state, self.result, self.error)

    def _press(self, seconds: float) -> None:
        """Of a job that was told to stop `seconds` ago: end it if it does not."""
        if seconds > 2 * GRACE_SECONDS:
            self._process.kill()
        elif seconds > GRACE_SECONDS:
            self._process.terminate()

    def _take_lines(self) -> None:
        while not self._lines.empty():
            line = self._lines.get()
            if "progress" in line:
                self.fraction = float(line["progress"])
                if self._cancelled_at is None:
                    self.message = str(line.get("message", ""))
            elif "result" in line:
                self._verdict = ("done", line["result"])
            elif "error" in line:
                self._verdict = ("failed", str(line["error"]))
            elif "cancelled" in line:
                self._verdict = ("cancelled", str(line["cancelled"]))

    def _settle(self, code: int) -> None:
        verdict: tuple[State, Any] = self._verdict or self._unspoken_end(code)
        self.state = verdict[0]
        if self.state == "done":
            self.result, self.fraction = verdict[1], 1.0
        else:
            self.error = verdict[1]
        self._close_input()

    def _unspoken_end(self, code: int) -> tuple[State, str]:
        """What to say of a job that ended without a word."""
        if self._cancelled_at is not None:
            return "cancelled", "Stopped; what it had not yet saved is lost."
        if code in (-9, 137):
            return "failed", (
                "The system ended the job, most likely because the memory ran out; lower the resolution or close other programs, "
                "then run it again."
            )
        last = next((line for line in reversed(self.log) if line.strip()), "it left no message")
        how = f"signal {-code}" if code < 0 else f"code {code}"
        return "failed", f"The job ended without a result ({how}: {last.strip()}); the console has the rest."

    def _close_input(self) -> None:
        if self._process.stdin and not self._process.stdin.closed:
            with contextlib.suppress(OSError):  # it has ended already, which is what this is for
                self._process.stdin.close()

    def _read_lines(self, stream: IO[bytes]) -> None:
        with stream:
            for raw in stream:
                try:
                    line = json.loads(raw)
                except ValueError:
                    line = None
                if isinstance(line, dict):
                    self._lines.put(line)
                else:
                    self.log.append(raw.decode(errors="replace").rstrip())

    def _read_log(self, stream: IO[bytes]) -> None:
        with stream:
            for raw in stream:
                self.log.append(raw.decode(errors="replace").rstrip())


def outcome(state: State, result: dict[str, Any], error: str) -> dict[str, Any]:
    """The result of work that has ended. Raises Cancelled or SnergError with its sentence when it did not end well."""
    if state == "cancelled":
        raise Cancelled(error)
    if state == "failed":
        raise SnergError(error)
    return result


def start_verb(arguments: Sequence[str], python: str | None = None) -> Job:
    """Run a verb of the command line (`["bake", FIELD, "--out", SCENE]`) as a job, with this process's imports.

    python: the interpreter, by default the one that runs this; inside Blender that is Blender's own.
    Raises SnergError when it cannot be started.
    """
    python = python or sys.executable
    if not python or not Path(python).is_file():
        raise SnergError(f"Blender's Python was not found at {python!r}; reinstall Blender from blender.org.")
    environment = {
        **os.environ,
        IMPORT_PATH: json.dumps([entry for entry in sys.path if entry]),
        "PYTHONIOENCODING": "utf-8:backslashreplace",
        "PYTHONDONTWRITEBYTECODE": "1",  # the extension's folder may be read-only, and its files are Blender's to manage
    }
    return Job([python, str(LAUNCHER), *arguments, "--job"], environment)
