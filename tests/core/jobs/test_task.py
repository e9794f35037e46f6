"""The states of a task, which are the same for every kind of task, and what its watchers see."""

from __future__ import annotations

import threading

import pytest

from snerg.core.errors import Cancelled, SnergError
from snerg.core.jobs.interrupt import STOPPED
from snerg.core.jobs.runner import Job
from snerg.core.jobs.task import OUT_OF_MEMORY, Outcome, StepTask, Task, ThreadTask
from snerg.core.progress import Note, ProgressEvent, within


class Manual(Task):
    """A task that a test advances by hand."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def _advance(self) -> None:
        pass

    def _stop(self) -> None:
        self.asked += 1


def test_a_task_waits_runs_and_is_done():
    task = Manual()
    assert (task.state, task.fraction, task.text) == ("waiting", 0.0, "Starting") and task.poll()
    task._report(ProgressEvent(0.0, "Waits for Training"), "waiting")
    assert task.state == "waiting" and task.text == "Waits for Training"
    task._report(ProgressEvent(0.5, "Step 1"))
    assert (task.state, task.fraction, task.text) == ("running", 0.5, "Step 1")
    task._finish(Outcome("done", {"psnr": 30.0}))
    assert not task.poll() and task.ended and task.fraction == 1.0 and task.result == {"psnr": 30.0}
    task.cancel()
    assert task.state == "done" and not task.asked, "what has ended cannot be stopped"


def test_a_task_that_was_asked_to_stop_says_so_until_it_ends():
    task = Manual()
    task.cancel()
    task.cancel()
    task._report(ProgressEvent(0.5, "Step 1"))
    assert task.asked == 1 and task.cancelling and (task.fraction, task.text) == (0.5, "Stopping") and task.poll()
    task._finish(Outcome("done", {"psnr": 30.0}))
    assert task.state == "done" and not task.cancelling, "it ended before it noticed"


@pytest.mark.parametrize(
    ("error", "state", "sentence"),
    [
        (Cancelled("Stopped."), "cancelled", "Stopped."),
        (SnergError("The box is flat."), "failed", "The box is flat."),
        (MemoryError(), "failed", OUT_OF_MEMORY),
        (KeyError("x"), "failed", "An unexpected error occurred (KeyError: 'x'); please report it with the console's text."),
    ],
)
def test_every_error_is_an_outcome_in_one_sentence(error, state, sentence):
    def fail(_progress):
        raise error

    task = ThreadTask(fail)
    with pytest.raises(SnergError) as raised:
        task.wait()
    assert (task.state, task.error, str(raised.value)) == (state, sentence, sentence)
    assert isinstance(raised.value, Cancelled) == (state == "cancelled")


def test_a_note_stays_and_does_not_hide_the_text_before_it():
    seen, go = [], threading.Event()

    def work(progress):
        progress(0.25, "Compiling")
        within(progress, 0.25, 1.0)(0.0, Note("Alpha: yes."))
        assert go.wait(20)
        return {}

    task = ThreadTask(work)
    while not task.notes:
        task.poll()
    assert (task.fraction, task.text, task.notes) == (0.25, "Compiling", ["Alpha: yes."])
    go.set()

    def watch(fraction, text):
        seen.append(ProgressEvent.of(fraction, text))

    task = StepTask(step for step in ((0.5, "one"), (0.5, Note("kept")), (0.75, "two")))
    assert task.wait(watch) == {}
    assert seen == [ProgressEvent(0.5, "one"), ProgressEvent(0.5, "kept", sticky=True), ProgressEvent(0.75, "two")]


def test_events_are_the_same_after_a_file():
    for event in (ProgressEvent(0.5, "Step é"), ProgressEvent(1.0, "Alpha: yes.", sticky=True)):
        assert ProgressEvent.from_json(event.to_json()) == event
    assert ProgressEvent(0.5, "x").to_json() == {"progress": 0.5, "message": "x"}, "as jobs of every version write it"
    assert ProgressEvent.from_json({"result": {}}) is None and ProgressEvent.from_json({"progress": "x"}) is None
    assert ProgressEvent.of(7, "x").fraction == 1.0 and not ProgressEvent.of(0, "x").sticky


def test_a_watcher_that_raises_stops_the_task():
    closed = []

    def steps():
        try:
            yield 0.5, "half"
            yield 0.9, "nearly"
        finally:
            closed.append(True)

    def watch(_fraction, _text):
        raise ZeroDivisionError

    task = StepTask(steps())
    with pytest.raises(ZeroDivisionError):
        task.wait(watch)
    assert closed and task.state == "cancelled" and task.error == STOPPED


def test_a_job_that_was_not_begun_waits():
    job = Job([])
    assert job.state == "waiting" and job.poll() and job.folder is None
