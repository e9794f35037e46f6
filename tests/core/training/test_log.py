"""The training log: whole lines, whatever happens to the process that writes them."""

import math

import pytest

from snerg.core.errors import SnergError
from snerg.core.io.files import check_replaceable
from snerg.core.training.log import FILE, Log, read_log


def test_lines_come_back_in_order(tmp_path):
    log = Log(tmp_path / "field", 0)
    log.add(step=1, seconds=0.5, loss=0.25)
    log.add(step=2, seconds=1.0, held_out_psnr=20.5)
    assert read_log(tmp_path / "field") == [
        {"step": 1, "seconds": 0.5, "loss": 0.25},
        {"step": 2, "seconds": 1.0, "held_out_psnr": 20.5},
    ]
    check_replaceable(tmp_path / "field")  # a training killed before it saved anything must not block its folder


def test_no_log_is_an_empty_one(tmp_path):
    assert read_log(tmp_path) == []


def test_a_cut_last_line_is_left_out_at_every_length(tmp_path):
    log = Log(tmp_path, 0)
    for step in (1, 2, 3):
        log.add(step=step, loss=0.5)
    data = (tmp_path / FILE).read_bytes()
    last = data.rindex(b"\n", 0, -1) + 1
    for size in range(last, len(data)):
        (tmp_path / FILE).write_bytes(data[:size])
        assert [line["step"] for line in read_log(tmp_path)] == [1, 2]


def test_what_is_not_ours_is_left_out(tmp_path):
    (tmp_path / FILE).write_bytes(b'\xff\xfe\n[1]\n{"loss": 1}\n{"step": 4}\n' + b"[" * 100_000 + b"\n")
    assert read_log(tmp_path) == [{"step": 4}]


def test_going_on_takes_back_what_came_after(tmp_path):
    log = Log(tmp_path, 0)
    for step in range(1, 6):
        log.add(step=step)
    with open(tmp_path / FILE, "ab") as file:
        file.write(b'{"step": 6, "lo')  # killed here
    log = Log(tmp_path, 3)
    log.add(step=4, again=True)
    assert read_log(tmp_path) == [{"step": 1}, {"step": 2}, {"step": 3}, {"step": 4, "again": True}]
    Log(tmp_path, 0)
    assert read_log(tmp_path) == []


@pytest.mark.hard_case(59)
def test_nothing_that_is_not_finite_is_logged(tmp_path):
    log = Log(tmp_path, 0)
    with pytest.raises(SnergError, match="not finite"):
        log.add(step=1, loss=math.nan)
    assert (tmp_path / FILE).read_bytes() == b""
