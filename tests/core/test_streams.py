"""The command line where the system refuses: nobody reads, the disk is full, a folder is closed, a name is absurd. One sentence each."""

import importlib
import os
import subprocess
import sys
from contextlib import contextmanager, nullcontext

import pytest

from scenes import make_snerg
from snerg.core import cli
from snerg.core.errors import MAX_MESSAGE, SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.progress import Note
from snerg.core.terminal import Terminal

COMMAND = [sys.executable, "-m", "snerg.core.start"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("baked") / "scene"
    write_scene(make_snerg((31, 30, 33), diffuse=True), folder)
    return folder


def sentence(text: str) -> str:
    """The one line that `text` is."""
    assert text.startswith("snerg: ") and text.endswith(".\n") and text.count("\n") == 1, text
    return text


@pytest.mark.skipif(os.name != "posix", reason="pipes that nobody reads")
@pytest.mark.parametrize("option", [[], ["--json"]])
def test_nobody_reads_the_result(scene, option):
    read, write = os.pipe()
    os.close(read)
    result = subprocess.run([*COMMAND, "info", str(scene), *option], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert result.returncode == 2 and "Broken pipe" in sentence(result.stderr)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_behind_the_standard_output(scene):
    with open("/dev/full", "w") as full:
        result = subprocess.run([*COMMAND, "info", str(scene)], stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.returncode == 2 and "No space left" in sentence(result.stderr)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_work_goes_on_when_nobody_sees_its_progress(scene, tmp_path):
    with open("/dev/full", "w") as full:
        command = [*COMMAND, "export", str(scene), "--out", str(tmp_path / "out"), "--json"]
        result = subprocess.run(command, stderr=full, stdout=subprocess.PIPE, text=True)
    assert result.returncode == 0 and '"reference scene"' in result.stdout and (tmp_path / "out" / "scene_params.json").exists()


@pytest.mark.parametrize(
    "command", ["info", "effects", "eval", "estimate", "export", "bundle", "bake", "import", "render", "train", "study"]
)
@pytest.mark.parametrize("where", ["closed", "long", "longer"])
def test_a_path_that_the_system_refuses(command, where, tmp_path, capfd):
    """A folder that may not be searched, a name of 300 characters, and a path of 300,000."""
    path = {"closed": tmp_path / "closed" / "scene", "long": tmp_path / ("x" * 300), "longer": tmp_path / ("x/" * 150_000)}[where]
    arguments = [command, str(path), *([] if command in ("info", "effects", "eval", "estimate") else ["--out", str(tmp_path / "out")])]
    arguments += ["--cameras", str(tmp_path / "cameras.json")] if command == "render" else []
    if where == "closed":
        (tmp_path / "closed").mkdir(mode=0)
        if os.name != "posix":
            pytest.skip("folders are not closed like this here")
    pytest.importorskip("jax")
    for name in ("study.study", "training.trainer"):  # nobody may be shut out of the interpreter's own folder
        importlib.import_module(f"snerg.core.{name}")
    with as_nobody(tmp_path) if where == "closed" else nullcontext():
        assert cli.main(arguments) == 2
    assert len(sentence(capfd.readouterr().err)) < MAX_MESSAGE + 100


@contextmanager
def as_nobody(folder):
    """Without root's rights, which open every folder."""
    if os.name != "posix" or os.geteuid() != 0:
        yield
        return
    folder.chmod(0o777)
    for part in folder.parents[:3]:
        part.chmod(part.stat().st_mode | 0o011)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_names_in_messages_stay_on_one_line_and_short(tmp_path, capsys):
    name = "a\nsnerg: \x1b[2J\x1b]0;gone\x07 \u202edetrever\r" + "b" * 300_000
    text = str(SnergError(f"{name} is wrong; write it again."))
    assert text.isprintable() and len(text) <= MAX_MESSAGE and text.startswith("a snerg:  [2J") and text.endswith("write it again.")
    assert cli.main(["info", str(tmp_path / "a\nb\x1b[2Jc")]) == 2
    error = capsys.readouterr().err
    assert "a b [2Jc" in sentence(error) and "\x1b" not in error
    (tmp_path / "dir\x1b[2J\n").mkdir()
    write_scene(make_snerg((31, 30, 33), diffuse=True), tmp_path / "dir\x1b[2J\n" / "scene")
    assert cli.main(["info", str(tmp_path / "dir\x1b[2J\n" / "scene")]) == 0
    assert "\x1b" not in capsys.readouterr().out
    terminal = Terminal(sys.stderr)
    terminal(0.5, Note("one\x1b[2J\ntwo"))
    assert capsys.readouterr().err == "one [2J two\n"


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text")
def test_a_name_that_is_no_text(tmp_path, capsys):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    write_scene(make_snerg((31, 30, 33), diffuse=True), folder)
    for option in ([], ["--json"]):
        assert cli.main(["info", str(folder), *option]) == 0
        assert "udce9" in capsys.readouterr().out
    assert cli.main(["info", str(folder / "nothing")]) == 2
