"""The side that starts a job, or finds one that was started before, watches it and stops it."""

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
from typing import Any

from ..errors import SnergError
from ..io.files import cannot_write
from ..progress import Progress, ProgressEvent
from . import folder as folders
from .protocol import GRACE_SECONDS, UNSAVED
from .task import POLL_SECONDS, Outcome, Task

LAUNCHER = Path(__file__).resolve().parents[2] / "launcher.py"
IMPORT_PATH = "SNERG_IMPORT_PATH"  # as launcher.py reads it
LOG_BYTES = 16384  # of standard error, from its end, that are read for the error of a job that died

KILLED = (-9, 137)  # exit codes of a process that was killed: as Popen has it, and as a shell does
KILLED_FOR_MEMORY = (
    "The system ended the job, most likely because the memory ran out; lower the resolution or close other programs, then run it again."
)

_children: set[subprocess.Popen[bytes]] = set()  # kept so that their exit codes are collected after their `Job` is gone


class Job(Task):
    """A command in a process of its own, which writes its progress to its folder (protocol.py, folder.py).

    `begin` starts a job; `found` is one that was started before, by this process or another. folder: its folder, None before `begin`.
    record: the folder's job.json.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None, prepare: Callable[[Path], None] | None = None
    ) -> None:
        """command: the program and its arguments. prepare: writes files that the command needs into the folder it is called with."""
        super().__init__()
        self.folder: Path | None = None
        self.record: dict[str, Any] = {}
        self._command, self._environment, self._prepare = list(command), environment, prepare
        self._process: subprocess.Popen[bytes] | None = None
        self._cancelled_at: float | None = None  # time.monotonic()
        self._outcome: Outcome | None = None
        self._read, self._rest = 0, b""  # bytes of the events that were read, and the last line's beginning

    @classmethod
    def found(cls, folder: Path) -> Job:
        """The job of an existing folder. It may wait, run, or have ended."""
        job = cls([])
        job.folder, job.record = folder, folders.read_record(folder)
        if (folder / folders.STOP).exists():
            job.state, job._cancelled_at = "cancelling", time.monotonic()
        else:
            job.state = "running"
        return job

    @property
    def arguments(self) -> list[str]:
        """Its command: two jobs with the same command do the same work."""
        return self._command or list(self.record.get("command", []))

    def begin(self, project: Path, record: Mapping[str, Any], attached: bool = False) -> Job:
        """Start the job in the folder `project`; it runs when the older jobs of that project have ended. Returns itself.

        record: entries of its job.json. attached: the job stops when this process ends; else it runs on.
        Raises SnergError when the folder cannot be written, or the system cannot start the process.
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
        self.state = "running"
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
                start_new_session=not attached,  # so that neither a closed terminal nor Ctrl-C ends it
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0) | group,
            )

    def _advance(self) -> None:
        if self.folder is None:
            return
        ended = self._process.poll() is not None if self._process else not folders.is_alive(self.folder)
        self._read_events()  # after the check whether it ended: its last line is there by then
        if ended:
            self._close(self._outcome or self._silent_end())
        elif self._process and self._cancelled_at is not None and time.monotonic() - self._cancelled_at > 2 * GRACE_SECONDS:
            self._process.kill()  # the job could not even end itself

    def _stop(self) -> None:
        """The job ends by itself within GRACE_SECONDS."""
        if self.folder is not None:
            try:
                (self.folder / folders.STOP).touch()
            except OSError as error:
                raise cannot_write(self.folder, error) from error
        self._cancelled_at = time.monotonic()

    @property
    def log(self) -> list[str]:
        """The last LOG_BYTES of its standard error, as lines."""
        if self.folder is None:
            return []
        try:
            with open(self.folder / folders.LOG, "rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_BYTES))
                return file.read().decode(errors="replace").splitlines()
        except OSError:
            return []

    def wait(self, progress: Progress | None = None, interval: float = POLL_SECONDS) -> dict[str, Any]:
        """`Task.wait`. A job that was not begun runs in a temporary folder, attached."""
        if self.folder is not None:
            return super().wait(progress, interval)
        with tempfile.TemporaryDirectory(prefix="snerg-job-", ignore_cleanup_errors=True) as project:
            return self.begin(Path(project), {}, attached=True).wait(progress, interval)

    def _read_events(self) -> None:
        """Take in the lines that the job wrote since the last call."""
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
            with contextlib.suppress(ValueError, RecursionError):  # other output, from before the job took over its standard output
                line = json.loads(raw)
                if isinstance(line, dict):
                    self._take(line)

    def _take(self, line: dict[str, Any]) -> None:
        """Take in one line (see protocol.py)."""
        if event := ProgressEvent.from_json(line):
            self._report(event, "waiting" if line.get("waiting") is True else "running")
        elif self._outcome is not None:  # the first outcome counts: a job may be asked to stop while it cleans up
            return
        elif isinstance(line.get("result"), dict):
            self._outcome = Outcome("done", line["result"])
        elif "error" in line:
            self._outcome = Outcome("failed", error=str(line["error"]))
        elif "cancelled" in line:
            self._outcome = Outcome("cancelled", error=str(line["cancelled"]))

    def _close(self, outcome: Outcome) -> None:
        """The process has ended."""
        self._finish(outcome)
        if self._process is not None:
            _children.discard(self._process)
            if self._process.stdin:
                with contextlib.suppress(OSError):
                    self._process.stdin.close()

    def _silent_end(self) -> Outcome:
        """The outcome of a job that ended without writing one."""
        assert self.folder is not None
        code = self._process.returncode if self._process else None
        if self._cancelled_at is not None:
            return Outcome("cancelled", error=UNSAVED)
        if code in KILLED:
            return Outcome("failed", error=KILLED_FOR_MEMORY)
        last = next((line for line in reversed(self.log) if line.strip()), "it left no message")
        how = "killed, or the machine went off" if code is None else f"signal {-code}" if code < 0 else f"code {code}"
        return Outcome("failed", error=f"The job ended without a result ({how}: {last.strip()}); {self.folder / folders.LOG} has the rest.")


def job_environment() -> dict[str, str]:
    """The environment for a job's process: this process's, with its import path."""
    return {
        **os.environ,
        IMPORT_PATH: json.dumps([entry for entry in sys.path if entry]),
        "PYTHONIOENCODING": "utf-8:backslashreplace",
        "PYTHONDONTWRITEBYTECODE": "1",  # the extension's folder may be read-only, and its files are Blender's to manage
    }


def environment_of(python: str | None) -> dict[str, str]:
    """`job_environment`; another Python (a path) gets no import path, because it has packages of its own."""
    environment = job_environment()
    if python is not None:
        del environment[IMPORT_PATH]
    return environment


def command_line(arguments: Sequence[str], python: str | None = None) -> list[str]:
    """The program and arguments that run a command of the command line. python: see `start_command`."""
    return [python or sys.executable, str(LAUNCHER), *arguments]


def start_command(arguments: Sequence[str], python: str | None = None) -> Job:
    """A command of the command line (`["bake", FIELD, "--out", SCENE]`) as a job that `begin` or `wait` starts.

    python: another interpreter, which has the packages itself; by default this process's, inside Blender that is Blender's own.
    Raises SnergError when it does not exist.
    """
    if python is not None and not Path(python).is_file():
        raise SnergError(f"The Python for training was not found at {python!r}; choose another in the add-on's preferences.")
    if python is None and not (sys.executable and Path(sys.executable).is_file()):
        raise SnergError(f"Blender's Python was not found at {sys.executable!r}; reinstall Blender from blender.org.")
    return Job([*command_line(arguments, python), "--job"], environment_of(python))
