"""The side of who starts a job, or finds one that was started before: watch it, stop it. Nothing here blocks but `wait`."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from ..errors import Cancelled, SnergError
from ..io.files import cannot_write
from ..progress import Note
from . import folder as folders
from .protocol import GRACE_SECONDS

LAUNCHER = Path(__file__).resolve().parents[2] / "launcher.py"
IMPORT_PATH = "SNERG_IMPORT_PATH"  # as launcher.py reads it
LOG_BYTES = 16384  # of standard error, from its end, for the sentence about a job that died

State = Literal["running", "done", "failed", "cancelled"]

_children: set[subprocess.Popen[bytes]] = set()  # which nobody may wait for any more: they outlive who started them


class Job:
    """A process that speaks the protocol of `protocol.py` into a folder of its own (folder.py).

    `begin` starts it; `found` is one that was started before, by whomever. Read `state`, `fraction` (0..1), `message`, `notes`
    (which stay beside the messages), `result` and `error` after `poll`.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None, prepare: Callable[[Path], None] | None = None
    ) -> None:
        """command: to start. prepare: writes into the job's folder, before it is there, what the command needs."""
        self.state: State = "running"
        self.fraction = 0.0
        self.message = "Starting"
        self.notes: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""
        self.folder: Path | None = None
        self.record: dict[str, Any] = {}
        self._command, self._environment, self._prepare = list(command), environment, prepare
        self._process: subprocess.Popen[bytes] | None = None
        self._cancelled_at: float | None = None
        self._verdict: tuple[State, Any] | None = None
        self._read, self._rest = 0, b""

    @classmethod
    def found(cls, folder: Path) -> Job:
        """The job of a folder. It may run, wait, or have ended."""
        job = cls([])
        job.folder, job.record = folder, folders.read_record(folder)
        if (folder / folders.STOP).exists():
            job._cancelled_at = time.monotonic()
        return job

    @property
    def arguments(self) -> list[str]:
        """What it is asked: two jobs that are asked the same do the same."""
        return self._command or list(self.record.get("command", []))

    def begin(self, project: Path, record: Mapping[str, Any], attached: bool = False) -> Job:
        """Start it as a job of the project whose folder is given, behind those that are there.

        attached: it stops when this process ends, because this process waits for it; else it runs on.
        Raises SnergError when the folder cannot be written, or the system cannot start it.
        """
        self.record = {**record, "command": self._command, "attached": attached, "host": platform.node()}
        self.folder = folders.new_job(project, self.record, self._prepare)
        try:
            self._process = self._start(self.folder, attached)
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise SnergError(f"Cannot start {self._command[0]} ({error.strerror or error}); check Blender's installation.") from error
        _children.difference_update([child for child in _children if child.poll() is not None])
        _children.add(self._process)
        return self

    def _start(self, folder: Path, attached: bool) -> subprocess.Popen[bytes]:
        environment = {**(os.environ if self._environment is None else self._environment), folders.VARIABLE: str(folder)}
        group = 0 if attached else getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
        with open(folder / folders.EVENTS, "ab") as events, open(folder / folders.LOG, "ab") as log:
            return subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE if attached else subprocess.DEVNULL,
                stdout=events,
                stderr=log,
                env=environment,
                start_new_session=not attached,  # so that neither a closed terminal nor its Ctrl-C ends it
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0) | group,
            )

    def poll(self) -> bool:
        """Take in what the job said since the last call; True while it runs or waits."""
        if self.state != "running" or self.folder is None:
            return self.state == "running"
        ended = self._process.poll() is not None if self._process else not folders.is_alive(self.folder)
        self._take_lines()  # after asking whether it ended: its last line is there by then
        if ended:
            self._settle()
        elif self._process and self._cancelled_at is not None and time.monotonic() - self._cancelled_at > 2 * GRACE_SECONDS:
            self._process.kill()  # so stuck that it could not even end itself
        return self.state == "running"

    def cancel(self) -> None:
        """Ask the job to stop. It ends by itself within GRACE_SECONDS. Raises SnergError when its folder cannot be written."""
        if self.state == "running" and self._cancelled_at is None:
            if self.folder is not None:
                try:
                    (self.folder / folders.STOP).touch()
                except OSError as error:
                    raise cannot_write(self.folder, error) from error
            self._cancelled_at = time.monotonic()
            self.message = "Stopping"

    @property
    def cancelling(self) -> bool:
        """Told to stop and not yet ended."""
        return self.state == "running" and self._cancelled_at is not None

    @property
    def log(self) -> list[str]:
        """The last lines of its standard error."""
        if self.folder is None:
            return []
        try:
            with open(self.folder / folders.LOG, "rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_BYTES))
                return file.read().decode(errors="replace").splitlines()
        except OSError:
            return []

    def wait(self, progress: Callable[[float, str], None] | None = None, interval: float = 0.1) -> dict[str, Any]:
        """Block until the job ends and return its result; a job that was not begun runs in a temporary folder.

        Raises SnergError with the job's sentence, or Cancelled; also when `progress` raises, which stops the job.
        """
        if self.folder is None:
            with tempfile.TemporaryDirectory(prefix="snerg-job-", ignore_cleanup_errors=True) as project:
                return self.begin(Path(project), {}, attached=True).wait(progress, interval)
        said: tuple[float, str] | None = None
        noted = 0
        try:
            while self.poll():
                if progress:
                    for note in self.notes[noted:]:
                        progress(self.fraction, Note(note))
                    noted = len(self.notes)
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

    def _take_lines(self) -> None:
        assert self.folder is not None
        try:
            with open(self.folder / folders.EVENTS, "rb") as file:
                file.seek(self._read)
                new = file.read()
        except OSError:
            return
        self._read += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        for raw in lines:
            with contextlib.suppress(ValueError, RecursionError):  # not ours: what was printed before the job took over its output
                line = json.loads(raw)
                if isinstance(line, dict):
                    self._take(line)

    def _take(self, line: dict[str, Any]) -> None:
        if isinstance(line.get("progress"), int | float):
            self.fraction = float(line["progress"])
            if line.get("note") is True:
                self.notes.append(str(line.get("message", "")))
            elif self._cancelled_at is None:
                self.message = str(line.get("message", ""))
        elif self._verdict is not None:  # the first counts: a job may be told to stop as it puts its last things away
            return
        elif isinstance(line.get("result"), dict):
            self._verdict = ("done", line["result"])
        elif "error" in line:
            self._verdict = ("failed", str(line["error"]))
        elif "cancelled" in line:
            self._verdict = ("cancelled", str(line["cancelled"]))

    def _settle(self) -> None:
        verdict: tuple[State, Any] = self._verdict or self._unspoken_end()
        self.state = verdict[0]
        if self.state == "done":
            self.result, self.fraction = verdict[1], 1.0
        else:
            self.error = verdict[1]
        if self._process is not None:
            _children.discard(self._process)
            if self._process.stdin:
                with contextlib.suppress(OSError):
                    self._process.stdin.close()

    def _unspoken_end(self) -> tuple[State, str]:
        """What to say of a job that ended without a word."""
        assert self.folder is not None
        code = self._process.returncode if self._process else None
        if self._cancelled_at is not None:
            return "cancelled", "Stopped; what it had not yet saved is lost."
        if code in (-9, 137):
            return "failed", (
                "The system ended the job, most likely because the memory ran out; lower the resolution or close other programs, "
                "then run it again."
            )
        last = next((line for line in reversed(self.log) if line.strip()), "it left no message")
        how = "killed, or the machine went off" if code is None else f"signal {-code}" if code < 0 else f"code {code}"
        return "failed", f"The job ended without a result ({how}: {last.strip()}); {self.folder / folders.LOG} has the rest."


def outcome(state: State, result: dict[str, Any], error: str) -> dict[str, Any]:
    """The result of work that has ended. Raises Cancelled or SnergError with its sentence when it did not end well."""
    if state == "cancelled":
        raise Cancelled(error)
    if state == "failed":
        raise SnergError(error)
    return result


def job_environment() -> dict[str, str]:
    """Of a job's process: this one's, with what this one can import."""
    return {
        **os.environ,
        IMPORT_PATH: json.dumps([entry for entry in sys.path if entry]),
        "PYTHONIOENCODING": "utf-8:backslashreplace",
        "PYTHONDONTWRITEBYTECODE": "1",  # the extension's folder may be read-only, and its files are Blender's to manage
    }


def start_verb(arguments: Sequence[str], python: str | None = None) -> Job:
    """A verb of the command line (`["bake", FIELD, "--out", SCENE]`) as a job, with this process's imports; `begin` or `wait` starts it.

    python: the interpreter, by default the one that runs this; inside Blender that is Blender's own.
    Raises SnergError when it is not there.
    """
    python = python or sys.executable
    if not python or not Path(python).is_file():
        raise SnergError(f"Blender's Python was not found at {python!r}; reinstall Blender from blender.org.")
    return Job([python, str(LAUNCHER), *arguments, "--job"], job_environment())
