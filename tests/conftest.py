"""What every test may use, and the list of hard cases that the tests cover."""

from __future__ import annotations

import os
import pickle
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


@pytest.fixture(scope="module")
def carved_once() -> Iterator[None]:
    """The hull of the same views is the same: trainings in this process carve it once."""
    from snerg.core.nerf.sampling import hull

    known: dict[bytes, tuple[Any, Any]] = {}

    def kept(*of: Any) -> tuple[Any, Any]:
        key = pickle.dumps(of)
        domain, alive = known[key] if key in known else known.setdefault(key, hull(*of))
        return domain, alive.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("snerg.core.training.prepare.hull", kept)
        yield
