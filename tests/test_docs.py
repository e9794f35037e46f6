"""README, CONTRIBUTING and docs/: what they name exists. The links between pages of the site are checked by `make docs`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import snerg
from snerg.core.cli import parser

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\(([^)#\s]+)")
FOLDERS = ("core", "operators", "snerg_addon", "viewer", "tests", "bench", "demo", "tools", "examples", "docs")
NAMED = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w./]*)`")
MOST_WORDS, MOST_BYTES = 900, 150_000  # a page that is read in minutes; pictures that open at once


def found(pattern: re.Pattern[str]) -> Iterator[tuple[Path, str]]:
    """Each page, and what the pattern finds in it."""
    for page in PAGES:
        for text in pattern.findall(page.read_text()):
            yield page, text


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text().split()) < MOST_WORDS


def test_every_link_leads_to_a_file():
    wrong = [f"{page.name}: {link}" for page, link in found(LINK) if "://" not in link and not (page.parent / link).exists()]
    assert not wrong, wrong


def test_every_file_that_is_named_exists():
    wrong = [f"{page.name}: {name}" for page, name in found(NAMED) if not (ROOT / name).exists()]
    assert not wrong, wrong


def test_every_function_that_is_named_exists():
    for page, name in found(re.compile(r"\bsnerg\.([a-z]\w+)\(")):
        assert hasattr(snerg, name), f"{page.name} names snerg.{name}"
    for page, name in found(re.compile(r"\bsnerg\.(core\.[\w.]+\w)")):
        module, _, last = f"snerg.{name}".rpartition(".")
        assert hasattr(import_module(module), last), f"{page.name} names snerg.{name}"


def test_every_operator_that_is_named_exists():
    code = "".join(path.read_text() for path in (ROOT / "operators").glob("*.py"))
    names = re.search(r"`bpy.ops.snerg`: (.*?)\. In", (ROOT / "docs" / "blender.md").read_text(), re.DOTALL)
    assert names is not None
    for name in re.findall(r"`(\w+)`", names[1]):
        assert f'"snerg.{name}"' in code, f"docs/blender.md names the operator {name}"


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.stem)
def test_every_command_and_option_that_is_named_exists(page):
    commands = {name: sub for action in parser()._actions if isinstance(action.choices, dict) for name, sub in action.choices.items()}
    known = {option for command in commands.values() for action in command._actions for option in action.option_strings}
    for line in page.read_text().splitlines():
        for command, options in re.findall(r"(?:^|\bsnerg |bin/snerg |--command snerg )([a-z]+) ([^`]*)", line):
            if command in commands and "snerg " + command in line:
                own = {option for action in commands[command]._actions for option in action.option_strings}
                assert set(re.findall(r"(?<!\S)--[a-z][\w-]+", options)) <= own, f"{page.name}: {line}"
        if page.stem in ("settings", "accuracy-and-time", "web", "captures"):
            for option in re.findall(r"`(--[a-z][\w-]+)", line):
                assert option in known, f"{page.name} names {option}"


def test_pictures_are_small():
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert pictures and all(path.stat().st_size <= MOST_BYTES for path in pictures)


def test_every_hard_case_that_a_test_names_has_its_reason():
    page = re.sub("<!-- written .*<!-- end -->", "", (ROOT / "docs" / "hard-cases.md").read_text(), flags=re.DOTALL)
    rows = [int(number) for number in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)]
    assert rows == list(range(1, len(rows) + 1))
    marks = (numbers for path in (ROOT / "tests").rglob("test_*.py") for numbers in re.findall(r"hard_case\(([\d, ]+)\)", path.read_text()))
    assert {int(number) for numbers in marks for number in numbers.split(",") if number.strip()} <= set(rows)
