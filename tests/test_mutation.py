"""The lists of `make mutation`: every entry still applies, its tests exist, and a run kills what it should and lists what it cannot."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def load():
    """mutation/mutations.py, which is a script's part and in no package."""
    spec = importlib.util.spec_from_file_location("mutations", ROOT / "mutation" / "mutations.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutations"] = module
    spec.loader.exec_module(module)
    return module


mutations = load()


def test_every_entry_applies_and_its_tests_exist():
    assert mutations.faults(mutations.read_lists()) == []


def test_every_case_that_an_entry_names_is_in_the_table():
    rows = {int(number) for number in re.findall(r"^\| (\d+) \|", (ROOT / "docs" / "hard-cases.md").read_text(), re.MULTILINE)}
    assert {case for mutation in mutations.read_lists() for case in mutation.cases} <= rows


ENTRY = """
[[mutation]]
name = "wrong-sign"
file = "part.py"
old = "a + b"
new = "a - b"
why = "It subtracts."
tests = ["test_part.py::test_sum"]
"""


@pytest.fixture
def project(tmp_path):
    (tmp_path / "part.py").write_text("def add(a, b):\n    return a + b\n\n\ndef again(a, b):\n    return b + a\n")
    (tmp_path / "test_part.py").write_text("def test_sum():\n    pass\n")
    return tmp_path


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"a + b"', '"a + c"', "'old' occurs 0 times"),
        ('"a + b"', '"return"', "'old' occurs 2 times"),
        ('"a - b"', '"a + b"', "'new' is 'old'"),
        ('"a - b"', '"a +"', "not Python"),
        ("test_sum", "test_other", "there is no test test_part.py::test_other"),
        ("part.py", "gone.py", "No such file"),
    ],
)
def test_a_stale_entry_is_an_error(project, tmp_path, old, new, sentence):
    (tmp_path / "kind.toml").write_text(ENTRY)
    assert mutations.faults(mutations.read_list(tmp_path / "kind.toml"), project) == []
    (tmp_path / "kind.toml").write_text(ENTRY.replace(old, new, 1))
    (fault,) = mutations.faults(mutations.read_list(tmp_path / "kind.toml"), project)
    assert sentence in fault


def test_old_is_searched_for_after_a_line(project, tmp_path):
    entry = ENTRY.replace('"a + b"', '"return"\nafter = "def again"').replace('"a - b"', '"return -"')
    (tmp_path / "kind.toml").write_text(entry)
    (mutation,) = mutations.read_list(tmp_path / "kind.toml")
    text = (project / "part.py").read_text()
    assert mutation.apply(text) == text.replace("return b", "return - b") and mutation.line(text) == 6


@pytest.mark.parametrize(
    ("entry", "sentence"), [(ENTRY * 2, "twice"), (ENTRY + 'colour = "red"', "colour"), (ENTRY.replace("It subtracts.", ""), "'why'")]
)
def test_a_wrong_list_is_refused(tmp_path, entry, sentence):
    (tmp_path / "kind.toml").write_text(entry)
    with pytest.raises(ValueError, match=sentence):
        mutations.read_list(tmp_path / "kind.toml")
