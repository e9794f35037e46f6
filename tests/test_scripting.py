"""The public face, as docs/scripting.md shows it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import snerg

PAGE = (Path(__file__).parent.parent / "docs" / "scripting.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, dataset):
    """With the dataset that the examples begin with; each of them uses what those before it made."""
    made = tmp_path_factory.mktemp("scripting")
    (made / "dataset").symlink_to(dataset)
    return made


@pytest.mark.slow
def test_the_examples_run(folder, monkeypatch, capsys):
    pytest.importorskip("jax")
    monkeypatch.chdir(folder)
    for example in EXAMPLES:
        assert len([line for line in example.splitlines() if line.strip()]) <= 8
        exec(compile(example, "docs/scripting.md", "exec"), {"__name__": "example"})
    assert (folder / "page" / "index.html").is_file() and (folder / "one" / "index.html").is_file()
    assert "%" in capsys.readouterr().out


def test_every_name_is_there():
    for name in snerg.__all__:
        assert getattr(snerg, name).__doc__, name
    assert set(snerg.__all__) <= set(dir(snerg))
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        snerg.nothing_of_the_kind  # noqa: B018


def test_importing_the_package_imports_nothing_else():
    script = "import sys, snerg; sys.exit('numpy' in sys.modules or 'jax' in sys.modules or 'bpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0
    script = "import sys, snerg; snerg.Box, snerg.render, snerg.Scene; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_what_a_path_is_not_is_said(folder, tmp_path):
    with pytest.raises(snerg.SnergError, match=r"\.$"):
        snerg.open_artifact(tmp_path)
