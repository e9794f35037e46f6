"""Where the command line begins: Ctrl-C is heard before NumPy and all the rest are imported."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

from .errors import EXIT_STOPPED


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code; see cli.main. Stopped from the keyboard, the process ends here."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if "--job" not in words:  # a job tells its parent that it was stopped
        signal.signal(signal.SIGINT, stop)
    from . import cli

    code = cli.main(words)
    if code == EXIT_STOPPED:
        from .jobs.interrupt import end

        end(code)
    return code


def stop(number: int, frame: FrameType | None) -> None:
    """The keyboard's signal while nothing has begun yet, or all is done."""
    os.write(2, b"snerg: Stopped.\n")
    os._exit(EXIT_STOPPED)


if __name__ == "__main__":
    sys.exit(main())
