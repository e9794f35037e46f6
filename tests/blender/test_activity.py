"""What the status bar tells of the task that ended last."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from snerg.core.jobs.task import ThreadTask
from snerg.operators import watch
from snerg.snerg_addon import activity


@pytest.fixture
def bar(scene, tmp_path, monkeypatch) -> Any:
    """A function that gives the texts of the status bar."""
    activity.stop()
    monkeypatch.setattr(activity, "_last", None)

    def texts() -> list[str]:
        found: list[str] = []
        layout: Any = SimpleNamespace(label=lambda **more: found.append(more["text"]), progress=lambda **more: found.append(more["text"]))
        layout.row = lambda **_: layout
        watch.draw_status(SimpleNamespace(layout=layout), None)
        return found

    yield texts
    activity.stop()


def test_it_tells_what_runs_and_then_how_that_ended(bar, tmp_path, monkeypatch):
    assert bar() == []
    running = activity.Activity("field", "Training", ThreadTask(lambda progress: {}), project=tmp_path)
    activity.begin(running)
    assert bar() == ["SNeRG: Training", "0%"]
    running.task.wait()
    activity.end(running)
    activity.report(tmp_path, f"Trained the field; it is in {tmp_path / 'fields' / '001'}", True)
    assert bar() == ["SNeRG: Trained the field; it is in fields/001"] and watch.report_changed() and not watch.report_changed()
    monkeypatch.setattr(activity, "RECENT_SECONDS", -1.0)
    assert bar() == [] and watch.report_changed() and not watch.report_changed()
