"""Blender as a module in this process: a new file for each test, with the add-on registered."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from stage import empty_scene

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def addon() -> Iterator[None]:
    """The add-on, registered from the source tree."""
    import snerg

    snerg.register()
    yield
    snerg.unregister()


@pytest.fixture
def preference(monkeypatch: pytest.MonkeyPatch, scene: Any) -> Any:
    """A function that gives a preference of the add-on a value: Blender as a module has no add-on preferences of a source tree."""
    from snerg.snerg_addon import preferences

    def choose(chosen: str, value: Any) -> None:
        monkeypatch.setattr(preferences, "_chosen", lambda name, otherwise: value if name == chosen else otherwise)

    return choose


@pytest.fixture
def scene(addon: None, tmp_path: Path) -> Any:
    """The empty scene of a new file, whose project is in the test's temporary folder."""
    scene = empty_scene()
    scene.snerg.folder = str(tmp_path / "project")
    return scene
