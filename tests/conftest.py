"""What every test may use, and the list of hard cases that the tests cover."""

from __future__ import annotations

import os
from collections import defaultdict
from pathlib import Path

import pytest

from scenes import make_dataset

# Trainers with the same settings compile the same step: keep what was compiled, for processes that tests start too.
COMPILED = Path(__file__).resolve().parent.parent / "build" / "compiled"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(COMPILED))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--list-hard-cases", action="store_true", help="list which tests cover which hard cases, and run none")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--list-hard-cases"):
        return
    tests: dict[int, list[str]] = defaultdict(list)
    for item in items:
        for mark in item.iter_markers("hard_case"):
            for number in mark.args:
                tests[number].append(item.nodeid)
    for number in sorted(tests):
        print(f"{number:3d}  {len(tests[number]):3d} tests, such as {tests[number][0]}")
    items.clear()


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data that SNERG_DATA names; tests that want it are skipped where it is unset."""
    folder = os.environ.get("SNERG_DATA", "")
    if not folder:
        pytest.skip("SNERG_DATA names no folder of real data")
    return Path(folder)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset with splits train (12 views) and test (3), 40 x 40 pixels with alpha; read it, do not change it."""
    return make_dataset(tmp_path_factory.mktemp("captured") / "dataset")
