"""The entry point of the command line: it handles Ctrl-C before NumPy and the other modules are imported."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

from .errors import EXIT_STOPPED


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see cli.main. After Ctrl-C the process ends here."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if "--job" not in given:  # a job reports to its parent process that it was stopped
        signal.signal(signal.SIGINT, stop)
    from . import cli

    code = cli.main(given)
    if code == EXIT_STOPPED:
        from .jobs.interrupt import end

        end(code)
    return code


def stop(number: int, frame: FrameType | None) -> None:
    """Handle Ctrl-C (SIGINT) before a command starts and after it ends: end the process."""
    os.write(2, b"snerg: Stopped.\n")
    os._exit(EXIT_STOPPED)


if __name__ == "__main__":
    sys.exit(main())
