"""The locks of a study that is measured in parts."""

import json

import pytest

from snerg.core.commands.study import COMMAND
from snerg.core.errors import SnergError
from snerg.core.io.lock import one_writer
from snerg.core.study import parts
from snerg.core.study.machine import describe_machine
from snerg.core.study.parts import elsewhere, no_parts, note_part, part_writer
from snerg.core.study.plan import Part

FIRST, SECOND = Part(1, 2), Part(2, 2)


def test_parts_run_beside_each_other_and_never_beside_the_whole(tmp_path, monkeypatch):
    out, begun = tmp_path / "out", []
    monkeypatch.setattr(parts, "PATIENCE", 0.1)
    with part_writer(out, FIRST, lambda: begun.append(1)), part_writer(out, SECOND, lambda: begun.append(2)):
        with pytest.raises(SnergError, match="is being written by part 1/2 of a study"), part_writer(out, FIRST, lambda: None):
            pass
        with pytest.raises(SnergError, match="is being written by part 1/2 of a study"), one_writer(out, "a study"), no_parts(out):
            pass
    refused = pytest.raises(SnergError, match="is being written by a study")
    with one_writer(out, "a study"), no_parts(out), refused, part_writer(out, FIRST, lambda: begun.append(3)):
        pass
    assert begun == [1, 2]


def test_a_killed_part_leaves_a_lock_that_stops_nobody(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / ".1-of-2.lock").write_text('{"pid": 1, "host": "gone", "doing": "part 1/2 of a study", "since": 1}')
    with (
        no_parts(tmp_path),
        pytest.raises(SnergError, match="is being written by a study"),
        one_writer(tmp_path / "parts" / "1-of-2", "other"),
    ):
        pass
    assert not list(tmp_path.rglob("*.lock"))


def test_a_part_of_another_kind_of_machine_is_said(tmp_path):
    for part in (FIRST, SECOND):
        note_part(tmp_path, part)
    assert elsewhere(tmp_path) == []
    other = {"part": "2/2", "machine": {**describe_machine(), "cores": 1000}}
    (tmp_path / "parts" / "2-of-2.json").write_text(json.dumps(other))
    assert elsewhere(tmp_path) == ["Part 2/2 was measured on machines of another kind: compare times only within a part."]


def test_what_belongs_to_the_whole_study_is_refused_for_a_part(tmp_path, capsys):
    from snerg.core.cli import main

    assert COMMAND.name == "study"
    for wrong in (["--target-db", "30"], ["--paper"]):
        assert main(["study", str(tmp_path), "--out", str(tmp_path / "out"), "--part", "1/2", *wrong]) == 2
        assert "belong to the whole study" in capsys.readouterr().err
    assert main(["study", str(tmp_path), "--out", str(tmp_path / "out"), "--part", "3/2"]) == 2
    assert "'3/2' is no part of a study" in capsys.readouterr().err
