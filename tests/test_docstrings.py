"""Every public function and class of core has a docstring, and gives the shape of each array that it takes, returns or holds."""

import ast
import re
from pathlib import Path

import pytest

CORE = Path(__file__).parent.parent / "core"
SHAPE = re.compile(r"\[[A-Za-z0-9_.,*+ /^()-]+\]|scalar|\bof any shape\b|elementwise|of the same shape|shaped like")


def public(path: Path) -> list[tuple[str, ast.AST, str]]:
    """(name, node, docstring) of the public functions, classes and methods of a file; methods may lean on their class's docstring."""
    found: list[tuple[str, ast.AST, str]] = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            told = ast.get_docstring(node) or ""
            found.append((node.name, node, told))
            for method in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                    found.append((f"{node.name}.{method.name}", method, ast.get_docstring(method) or ""))
    return found


def holds_arrays(node: ast.AST) -> bool:
    """Whether a function's arguments or result, or a class's fields, are arrays."""
    if isinstance(node, ast.ClassDef):
        notes = [item.annotation for item in node.body if isinstance(item, ast.AnnAssign)]
    else:
        assert isinstance(node, ast.FunctionDef)
        arguments = node.args
        notes = [a.annotation for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs) if a.annotation]
        notes += [node.returns] if node.returns else []
    return any("NDArray" in ast.unparse(note) for note in notes)


def fields_with_shapes(path: Path, node: ast.AST) -> bool:
    """Whether each array field of a class has its shape in a comment beside it."""
    lines = path.read_text().splitlines()
    fields = [item for item in node.body if isinstance(item, ast.AnnAssign)] if isinstance(node, ast.ClassDef) else []
    arrays = [item for item in fields if "NDArray" in ast.unparse(item.annotation)]
    return bool(arrays) and all(SHAPE.search(lines[(item.end_lineno or item.lineno) - 1].partition("#")[2]) for item in arrays)


@pytest.mark.parametrize("path", sorted(CORE.rglob("*.py")), ids=lambda path: str(path.relative_to(CORE)))
def test_docstrings_give_shapes(path):
    missing = [f"{name}: no docstring" for name, _, told in public(path) if not told]
    missing += [
        f"{name}: no shape"
        for name, node, told in public(path)
        if told and holds_arrays(node) and not SHAPE.search(told) and not fields_with_shapes(path, node)
    ]
    assert not missing, "\n".join(missing)
