"""The lists of mutations, mutation/KIND.toml: naive forms of numeric lines, each with why it is wrong and the tests that must see it.

An entry is a table `[[mutation]]` with
    name      unique in its list
    file      from the repository's root
    old, new  the line or lines as they are, and the naive form; `old` occurs exactly once in the file
    after     optional: a text that occurs exactly once; `old` is then searched for from there on
    why       what goes wrong with `new`
    tests     ["tests/core/.../test_file.py::test_name", ...]: all parameters of a test
    cases     optional: the rows of docs/hard-cases.md that the line is there for
    slow      optional: takes minutes (a browser, a window), left out of a seeded part
    survives  optional: why no test can tell `new` from `old`
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LISTS = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Mutation:
    """One entry of a list; kind: the list's name. See above."""

    kind: str
    name: str
    file: str
    old: str
    new: str
    why: str
    tests: tuple[str, ...]
    after: str = ""
    cases: tuple[int, ...] = ()
    slow: bool = False
    survives: str = ""

    @property
    def title(self) -> str:
        """'kind/name'"""
        return f"{self.kind}/{self.name}"

    def place(self, text: str) -> int:
        """Where in the file's text `old` begins. Raises ValueError where it is not there exactly once: the list is stale."""
        start = 0
        if self.after:
            if text.count(self.after) != 1:
                raise ValueError(f"{self.title}: 'after' occurs {text.count(self.after)} times in {self.file}")
            start = text.index(self.after)
        elif text.count(self.old) != 1:
            raise ValueError(f"{self.title}: 'old' occurs {text.count(self.old)} times in {self.file}")
        if self.old not in text[start:]:
            raise ValueError(f"{self.title}: 'old' does not occur after 'after' in {self.file}")
        return text.index(self.old, start)

    def apply(self, text: str) -> str:
        """The file's text with the naive form in it. Raises ValueError: see `place`; also where the result is not Python."""
        at = self.place(text)
        changed = text[:at] + self.new + text[at + len(self.old) :]
        if changed == text:
            raise ValueError(f"{self.title}: 'new' is 'old'")
        if self.file.endswith(".py"):
            try:
                ast.parse(changed)
            except SyntaxError as error:
                raise ValueError(f"{self.title}: the result is not Python: {error}") from None
        return changed

    def line(self, text: str) -> int:
        """The number of the first line that changes."""
        return text.count("\n", 0, self.place(text)) + 1


def read_list(path: Path) -> list[Mutation]:
    """The entries of a list. Raises ValueError where one lacks a field, has an unknown one, or its name is taken."""
    found: list[Mutation] = []
    for entry in tomllib.loads(path.read_text()).get("mutation", []):
        lists = {name: tuple(entry.pop(name, ())) for name in ("tests", "cases")}
        try:
            found.append(Mutation(kind=path.stem, **entry, **lists))
        except TypeError as error:
            raise ValueError(f"{path.name}: {entry.get('name', 'an entry without a name')}: {error}") from None
        if sum(other.name == found[-1].name for other in found) > 1:
            raise ValueError(f"{path.name}: {found[-1].name} is there twice")
        if not (found[-1].why and found[-1].tests):
            raise ValueError(f"{found[-1].title}: 'why' or 'tests' is empty")
    return found


def read_lists(folder: Path = LISTS) -> list[Mutation]:
    """The entries of all lists. Raises ValueError: see `read_list`."""
    return [mutation for path in sorted(folder.glob("*.toml")) for mutation in read_list(path)]


@cache
def tests_in(path: Path) -> frozenset[str]:
    """The names of the test functions of a file, 'test_name' or 'TestClass::test_name'; none where there is no such file."""
    if not path.is_file():
        return frozenset()
    body = ast.parse(path.read_text()).body
    classes = [node for node in body if isinstance(node, ast.ClassDef)]
    inner = {f"{c.name}::{node.name}" for c in classes for node in c.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}
    return frozenset(inner | {node.name for node in body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)})


def faults(mutations: Sequence[Mutation], root: Path = ROOT) -> list[str]:
    """What is stale in the lists, a sentence an entry: a line that is not there once, a test that does not exist."""
    wrong = []
    for mutation in mutations:
        path = root / mutation.file
        try:
            mutation.apply(path.read_text())
        except (OSError, ValueError) as error:
            wrong.append(str(error))
        for test in mutation.tests:
            file, _, name = test.partition("::")
            if name not in tests_in(root / file):
                wrong.append(f"{mutation.title}: there is no test {test}")
    return wrong
