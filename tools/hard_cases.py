"""Writes the last table of docs/hard-cases.md: of each case, the tests that name it and the mutations that they must kill.

The tables before it are written by hand. `python tools/hard_cases.py` writes; with --check it only says whether the page is up to date.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "hard-cases.md"
BEGIN, END = "<!-- written by tools/hard_cases.py -->", "<!-- end -->"
sys.path.insert(0, str(ROOT / "mutation"))

from mutations import read_lists  # noqa: E402


def marked(path: Path) -> Iterator[tuple[int, str]]:
    """(case, name) of each test of a file that names a case; a mark on a list of parameters counts for its test too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            for decorator in node.decorator_list:
                for call in ast.walk(decorator):
                    if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "hard_case":
                        yield from ((argument.value, node.name) for argument in call.args if isinstance(argument, ast.Constant))


def table(cases: list[int]) -> str:
    """The table, Markdown: a row a case."""
    tests: dict[int, list[str]] = defaultdict(list)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for case, name in marked(path):
            tests[case].append(f"`{path.relative_to(ROOT).as_posix()}` {name[5:].replace('_', ' ')}")
    mutations: dict[int, list[str]] = defaultdict(list)
    for mutation in read_lists():
        for case in mutation.cases:
            mutations[case].append(mutation.title)
    rows = [f"| {case} | {'<br>'.join(tests[case]) or '-'} | {', '.join(sorted(mutations[case])) or '-'} |" for case in cases]
    return "\n".join(["| # | tests | mutations |", "|---|---|---|", *rows])


def page() -> str:
    """The page with the table as the tests and lists have it now."""
    text = PAGE.read_text()
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    cases = sorted({int(number) for number in re.findall(r"^\| (\d+) \|", before + after, re.MULTILINE)})
    return f"{before}{BEGIN}\n\n{table(cases)}\n\n{END}{after}"


if __name__ == "__main__":
    wanted = page()
    if "--check" not in sys.argv:
        PAGE.write_text(wanted)
    elif wanted != PAGE.read_text():
        sys.exit("docs/hard-cases.md is not what the tests and the mutations say; run: make hard-cases")
