"""Training over a finished field: it stays readable as it was until the new one is finished, whatever happens meanwhile."""

import os
import shutil
import time
from dataclasses import replace

import pytest

pytest.importorskip("jax")

from snerg.core.commands import train as train_command
from snerg.core.commands.info import info
from snerg.core.commands.train import train_field
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.nerf.checkpoint import FILE, read_field, read_field_and_state, write_field
from snerg.core.training import trainer as train_module
from snerg.core.training.config import PRESETS
from snerg.core.training.log import read_log
from snerg.core.training.training_folder import FINISHED, NEW, UNFINISHED, finish, training_folder


class Stop:
    """Progress that cancels the training once it has told of some steps."""

    def __init__(self, times: int) -> None:
        self.left = times

    def __call__(self, fraction: float, message: str) -> None:
        self.left -= message.startswith("Step")
        if self.left < 0:
            raise Cancelled("Stopped.")


pytestmark = pytest.mark.usefixtures("carved_once")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, dataset, carved_once):
    """A folder with a finished field, to copy."""
    folder = tmp_path_factory.mktemp("finished") / "field"
    train_field(dataset, folder, steps=6)
    return folder


@pytest.fixture
def out(tmp_path, finished):
    return shutil.copytree(finished, tmp_path / "field")


@pytest.fixture
def often(monkeypatch):
    """Training tells of every step."""
    monkeypatch.setattr(train_module, "TELL_EVERY", -1.0)


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_old_field_stays_until_the_new_one_is_finished(out, dataset, often):
    before, notes = files(out), []
    with pytest.raises(Cancelled):
        train_field(dataset, out, steps=9, progress=Stop(3))
    assert files(out) == before
    (unfinished,) = info(out)["unfinished_trainings"]
    assert 0 < unfinished["steps"] < 9
    result = train_field(dataset, out, steps=9, progress=lambda fraction, message: notes.append(message))
    assert result["resumed"] and result["steps"] == 9 and result["field"] == str(out)
    assert any("stays as it is" in note for note in notes)
    assert read_field(out).about["steps"] == 9 and read_log(out)[-1]["step"] == 9
    assert [path.name for path in out.parent.iterdir()] == ["field"] and "unfinished_trainings" not in info(out)


def test_an_unfinished_training_of_a_version_without_a_setting_goes_on(tmp_path, dataset, often):
    with pytest.raises(Cancelled):
        train_field(dataset, tmp_path / "field", steps=6, progress=Stop(2))
    field, state = read_field_and_state(tmp_path / "field")
    assert field.about["settings"].pop("depth") == "off"
    write_field(field, tmp_path / "field", state)
    settings = train_command.settings_of("fast", None, 6, 0, {})
    assert training_folder(tmp_path / "field", settings, read_dataset(dataset)) == (tmp_path / "field", UNFINISHED)
    assert training_folder(tmp_path / "field", replace(settings, depth="on"), read_dataset(dataset))[1] == NEW


def test_other_settings_have_a_training_of_their_own(out, dataset, often):
    for seed in (1, 2):
        with pytest.raises(Cancelled):
            train_field(dataset, out, steps=9, seed=seed, progress=Stop(3))
    assert len(info(out)["unfinished_trainings"]) == 2
    assert read_field(out).about["steps"] == 6


def test_an_unfinished_training_is_set_aside_for_another_and_goes_on(tmp_path, dataset, often):
    out = tmp_path / "field"
    with pytest.raises(Cancelled):
        train_field(dataset, out, steps=9, progress=Stop(4))
    reached = read_field(out).about["steps"]
    assert not train_field(dataset, out, steps=6)["resumed"] and read_field(out).about["steps"] == 6
    (unfinished,) = info(out)["unfinished_trainings"]
    assert unfinished["steps"] == reached
    assert train_field(dataset, out, steps=9)["resumed"] and read_field(out).about["steps"] == 9


def test_an_import_and_a_damaged_field_stay_too(out, dataset, often):
    field = read_field(out)
    write_field(replace(field, dataset="", about={}), out)
    for damage in (False, True):
        if damage:
            (out / FILE).write_bytes((out / FILE).read_bytes()[:2000])
        before = files(out)
        with pytest.raises(Cancelled):
            train_field(dataset, out, steps=9, progress=Stop(2))
        assert files(out) == before
    assert train_field(dataset, out, steps=9)["resumed"]
    assert [path.name for path in out.parent.iterdir()] == ["field"]


def test_a_kill_before_the_new_one_takes_its_place_costs_nothing(out, dataset, monkeypatch):
    def killed(folder, real):
        raise KeyboardInterrupt

    monkeypatch.setattr(train_command, "finish", killed)
    with pytest.raises(KeyboardInterrupt):
        train_field(dataset, out, steps=9)
    monkeypatch.setattr(train_command, "finish", finish)
    monkeypatch.setattr(train_module, "train", None)  # it need not train again
    assert train_field(dataset, out, steps=9)["steps"] == 9
    assert [path.name for path in out.parent.iterdir()] == ["field"]


def test_a_kill_between_the_swap_and_the_deletion_brings_no_old_field_back(out, dataset, monkeypatch):
    settings, views = replace(PRESETS["fast"], steps=6, seconds=None), read_dataset(dataset)
    folder, state = training_folder(out, settings, views)
    assert state == NEW
    shutil.copytree(out, folder)
    os.utime(folder / FILE, (time.time() - 3600,) * 2)
    assert training_folder(out, settings, views) == (folder, NEW)
    os.utime(folder / FILE, (time.time() + 60,) * 2)
    assert training_folder(out, settings, views) == (folder, FINISHED)


def test_what_the_user_put_there_meanwhile_is_not_replaced(out, dataset, tmp_path):
    folder = shutil.copytree(out, tmp_path / ".field.training-01234567")
    shutil.rmtree(out)
    out.mkdir()
    (out / "thesis.txt").write_text("years of work")
    with pytest.raises(SnergError, match="other files"):
        finish(folder, out)
    assert folder.is_dir() and [path.name for path in out.iterdir()] == ["thesis.txt"]


def test_a_field_behind_a_link(tmp_path, out, dataset):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "link").symlink_to(out)
    train_field(dataset, tmp_path / "elsewhere" / "link", steps=9)
    assert (tmp_path / "elsewhere" / "link").is_symlink() and read_field(out).about["steps"] == 9
    assert sorted(path.name for path in tmp_path.rglob("*") if path.parent != out) == ["elsewhere", "field", "link"]
