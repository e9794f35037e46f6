"""The package holds every folder of code, whatever pyproject.toml forgets."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_every_folder_of_code_is_a_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    listed = set(project["tool"]["setuptools"]["packages"])
    rooms = ("core", "operators", "snerg_addon")
    found = {
        ".".join(("snerg", *path.parent.relative_to(ROOT).parts))
        for room in rooms
        for path in (ROOT / room).rglob("*.py")
        if "node_modules" not in path.parts
    }
    assert listed == {"snerg"} | found


def test_every_package_has_its_init_file():
    for room in ("core", "operators", "snerg_addon"):
        for path in (ROOT / room).rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), path.parent
