"""What the field panel shows of a training: its curve, and whether it can be continued."""

from __future__ import annotations

import json

import numpy as np
import pytest

from snerg.operators.train import training_arguments
from snerg.snerg_addon.curve import POINTS, Curve, curve_of, read_curve
from snerg.snerg_addon.panels.field import can_continue, curve_texts
from snerg.snerg_addon.pictures import LEFT, RIGHT, SIZE, curve_picture, ticks_between
from snerg.snerg_addon.project import project_of

LINES = [
    {"step": 10, "seconds": 2.0, "fraction": 0.25, "loss": 0.1, "psnr": 20.0, "rate": 0.01, "samples": 9, "rays": 3},
    {"step": 30, "seconds": 6.0, "held_out_psnr": 21.5},
    {"step": 40, "seconds": 71.0, "fraction": 0.5, "loss": 0.1, "psnr": 24.0, "rate": 0.01, "samples": 9, "rays": 3},
]


def write_log(folder, lines):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"step": 50, "sec')


def test_the_curve_is_that_of_the_log(tmp_path):
    assert curve_of(tmp_path) is None
    write_log(tmp_path, LINES)
    curve = curve_of(tmp_path)
    assert curve == Curve(0.5, 40, 71.0, 24.0, 21.5, ((2.0, 20.0), (71.0, 24.0)))
    assert curve_texts(curve) == ("21.5 dB on held-out views", "40 steps, 1:11 min")
    write_log(tmp_path, [*LINES, {**LINES[0], "step": 80, "fraction": 1.0, "psnr": 28.0}])  # it grew
    assert curve_of(tmp_path).steps == 80
    assert curve_of(tmp_path) is curve_of(tmp_path)  # read once
    assert curve_texts(read_curve(LINES[:1]))[0] == "20.0 dB on training rays"
    assert read_curve([]) == Curve()
    assert curve_texts(Curve()) == ("", "")  # not '0 steps, 0:00 min'


def test_a_long_log_becomes_few_points():
    lines = [{**LINES[0], "step": step, "seconds": float(step)} for step in range(1000)]
    points = read_curve(lines).points
    assert len(points) == POINTS and points[0] == (0.0, 20.0) and points == tuple(sorted(points))


def test_the_curves_picture_shows_the_curve():
    picture = np.asarray(curve_picture(((0.0, 10.0), (50.0, 20.0), (100.0, 20.0))))
    line = (picture[..., 2] == 255) & (picture[..., 0] == 90)
    rows, columns = np.nonzero(line)
    assert columns.min() <= LEFT + 2 and columns.max() >= SIZE[0] - RIGHT - 3, "from the first second to the last"
    flat = rows[columns > (LEFT + SIZE[0] - RIGHT) / 2 + 5]
    assert np.ptp(flat) <= 3 and rows.max() - flat.min() > 100, "it rises, then is flat; y points upwards"


@pytest.mark.parametrize(("low", "high"), [(9.5, 31.2), (0, 0.3), (30.0, 30.0), (0, 1200), (-3, 4)])
def test_ticks_are_few_and_enclose_the_values(low, high):
    ticks = ticks_between(low, high)
    assert 2 <= len(ticks) <= 6 and ticks[0] <= low and ticks[-1] >= high and ticks == sorted(ticks)


def test_only_a_training_that_was_stopped_goes_on(scene):
    project = project_of(scene)

    def can():
        return can_continue(scene)

    assert not can()
    write_log(project.field, LINES)
    project.note("training", {"arguments": training_arguments(scene, project)})
    assert not can()  # it has left nothing to go on with
    (project.field / "field.npz").write_bytes(b"half-way")
    assert can()
    scene.snerg.view_dependence = "diffuse"
    assert not can()  # another training
    scene.snerg.view_dependence = "auto"
    write_log(project.field, [*LINES, {**LINES[0], "step": 80, "fraction": 1.0}])
    assert not can()  # finished


def test_the_background_goes_by_its_name_or_its_colour(scene):
    def background():
        arguments = training_arguments(scene, project_of(scene))
        return arguments[arguments.index("--background") + 1]

    assert background() == "white"
    scene.snerg.train_background, scene.snerg.train_colour = "colour", (1.0, 0.5, 0.0)
    assert background() == "#ff8000"
