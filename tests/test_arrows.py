"""The plan of core: every import goes to a room on the left or stays in its own, and no files import each other in a circle."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

CORE = Path(__file__).parent.parent / "core"
ROOMS = (
    "errors",
    "units",
    "progress",
    "io",
    "jobs",
    "geometry",
    "data",
    "nerf",
    "training",
    "scene",
    "rendering",
    "baking",
    "export",
    "artifact",
    "study",
    "commands",
    "api",
    "terminal",
    "cli",
    "start",
)


def files() -> dict[str, Path]:
    """Every file of core, as 'room.file'."""
    return {".".join(path.relative_to(CORE).with_suffix("").parts): path for path in sorted(CORE.rglob("*.py"))}


def imported(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """The files of core that one imports, inside functions and for types alone too."""
    package, found = name.split(".")[:-1], set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
            assert node.level <= len(package) + 1, f"{path} imports from outside core"
            for alias in node.names:
                whole = ".".join([*base, alias.name])
                found.add(whole if whole in known else ".".join(base))
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            assert not any(n.split(".")[0] == "snerg" for n in names), f"{path} imports core by its full name"
    return {target for target in found if target in known}


@pytest.fixture(scope="module")
def arrows() -> dict[str, set[str]]:
    known = files()
    return {name: imported(name, path, known) for name, path in known.items() if not name.endswith("__init__")}


def test_no_arrow_goes_to_the_right(arrows):
    wrong = [
        f"{name} -> {target}"
        for name, targets in arrows.items()
        for target in targets
        if ROOMS.index(name.split(".")[0]) < ROOMS.index(target.split(".")[0])
    ]
    assert not wrong, "\n".join(wrong)


def test_no_circle(arrows):
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
