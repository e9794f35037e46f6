"""What every command is made of. A file of this folder that defines COMMAND adds a command to `snerg`."""

from __future__ import annotations

import argparse
import importlib
import json
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..artifact import Result
from ..progress import Progress
from ..units import duration, file_size

LONGEST_CELL = 160  # characters of a value in `table`: about two lines of a terminal
UNITS: dict[str, tuple[str, Callable[[float], str]]] = {  # unit in a key: what is read in its place, and how a number is written
    "seconds": ("time", duration),
    "megabytes": ("size", lambda megabytes: file_size(1e6 * megabytes)),
    "bytes": ("size", file_size),
}


def table(result: Result) -> str:
    """A result as text for people, one value a line, times and sizes in the unit that suits. Long values are left to --json."""
    cells = [_cell(key, value) for key, value in result.items()]
    width = max((len(name) for name, _ in cells), default=0)
    return "\n".join(f"{name:<{width}}  {text if len(text) <= LONGEST_CELL else '… (see --json)'}" for name, text in cells)


def _cell(key: str, value: Any) -> tuple[str, str]:
    """The name and the text of a value of a result."""
    words = key.split("_")
    if unit := next((word for word in words if word in UNITS), None):
        name, write = UNITS[unit]
        words[words.index(unit)] = name
        if isinstance(value, int | float):
            return " ".join(words), write(value)
        if isinstance(value, dict) and all(isinstance(part, int | float) for part in value.values()):
            return " ".join(words), ", ".join(f"{part} {write(number)}" for part, number in value.items())
    return " ".join(words), json.dumps(value) if isinstance(value, dict | list) else "—" if value is None else str(value)


@dataclass(frozen=True)
class Command:
    """A command of the command line."""

    name: str  # as it is typed
    help: str  # one phrase in lower case, without a full stop
    add_options: Callable[[argparse.ArgumentParser], None]  # adds the command's arguments to its parser
    run: Callable[[argparse.Namespace, Progress], Result]  # does the work; raises SnergError
    text: Callable[[Result], str] = table  # the result for people

    def add_to(self, subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
        """Add the command's parser. Parsed options get `run` and `text` of this command."""
        about = f"{self.help[0].upper()}{self.help[1:]}."
        parser = subparsers.add_parser(self.name, help=self.help, description=about)
        parser.add_argument("--json", action="store_true", help="print one JSON object as the last line of standard output")
        parser.add_argument("--job", action="store_true", help=argparse.SUPPRESS)
        parser.set_defaults(run=self.run, text=self.text)
        self.add_options(parser)


def all_commands() -> list[Command]:
    """Each COMMAND that a file of this folder defines, by name."""
    package = __name__.rpartition(".")[0]
    folder = importlib.import_module(package).__path__
    modules = [importlib.import_module(f"{package}.{found.name}") for found in pkgutil.iter_modules(folder)]
    commands = [module.COMMAND for module in modules if hasattr(module, "COMMAND")]
    return sorted(commands, key=lambda command: str(command.name))
