"""The command line: `snerg COMMAND` outside Blender, `blender --command snerg COMMAND` inside, and the jobs that operators start.

Progress goes to standard error. With --json the last line of standard output is one JSON object. Exit codes: 0; 2 with
one sentence on standard error when the input is wrong; 130 when stopped by Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, cast

from .commands.command import all_commands
from .errors import EXIT_ERROR, EXIT_STOPPED, SnergError, clean
from .jobs.protocol import run_job
from .jobs.task import Outcome
from .progress import Progress
from .terminal import Terminal, run_stoppable, write_result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code. arguments: without the program's name; those of the process when None.

    In the main thread it handles Ctrl-C, and ends the process when the work does not stop within a second.
    """
    try:
        options = parser().parse_args(sys.argv[1:] if arguments is None else list(arguments))
    except SystemExit as end:  # --help or wrong arguments: inside Blender the process must go on
        return int(end.code or 0)

    def work(progress: Progress) -> dict[str, Any]:
        with system_errors():
            return cast("dict[str, Any]", json_values(options.run(options, progress)))

    if options.job:
        return run_job(work)
    terminal = Terminal(sys.stderr)
    try:
        result = run_stoppable(work, terminal)
        terminal.end()
        write_result(json.dumps(result, allow_nan=False) if options.json else options.text(result))
    except (SnergError, MemoryError) as error:
        outcome = Outcome.of_error(error)
        terminal.last(f"snerg: {outcome.error}")
        return EXIT_STOPPED if outcome.state == "cancelled" else EXIT_ERROR
    return 0


def parser() -> argparse.ArgumentParser:
    """The parser of every command and its options; parsed options have `command`, `run`, `text`, `json` and `job`."""
    top = _Parser(prog="snerg", description="Bake radiance fields into sparse grids that render in Blender and on the web.")
    subparsers: argparse._SubParsersAction[Any] = top.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for command in all_commands():
        command.add_to(subparsers)
    return top


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_ERROR, f"snerg: {clean(message)}; see '{self.prog} --help'.\n")


@contextmanager
def system_errors() -> Iterator[None]:
    """Raise SnergError in place of an OSError about a file, such as a folder without permission or a name that is too long."""
    try:
        yield
    except OSError as error:
        if error.filename is None or not error.strerror:
            raise
        raise SnergError(f"The system denies access to {error.filename} ({error.strerror}); check the path and its permissions.") from error


def json_values(value: Any) -> Any:
    """A value with JSON types alone: paths as text, NumPy numbers and arrays as Python's, None for infinity and NaN."""
    if isinstance(value, dict):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    if hasattr(value, "tolist"):
        return json_values(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool) or value is None else str(value)


if __name__ == "__main__":
    sys.exit(main())
