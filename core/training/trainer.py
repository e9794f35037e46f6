"""The training loop: steps until the set time or number of steps is over; validates, saves, and stops on request. Needs JAX."""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
import time
from ast import literal_eval
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import Cancelled, SnergError
from ..io.files import SAVING
from ..io.guard import reading
from ..nerf.checkpoint import read_field_and_state, write_field
from ..nerf.field import Field
from ..progress import Note, Progress, silent
from . import view_dependence_test
from .config import TrainSettings
from .decisions import Decision
from .device_sampler import DeviceSampler
from .dispatch import compiled_step
from .non_finite import cause
from .parallel import Devices
from .prepare import held_out_of, prepare
from .saving import Saver, TrainProgress, trained_field
from .state import StepReport, initial_state, restored_state, state_arrays
from .validation import ValidationRays, mean_psnr_of

PATIENCE = 5  # steps in a row that are not finite end the training
SCORE_EVERY, SCORE_SHARE = 20.0, 0.01  # seconds between two scores of held-out rays, and the share of the time that they may take
TELL_EVERY = 0.2  # seconds between two reports of progress, which is also how long Ctrl-C may wait


class Trainer:
    """A running training: its prepared inputs, its state, and the compiled step from one state to the next.

    With settings.steps a training is deterministic on one CPU device: the result has the same bytes, whether it was interrupted and
    resumed or not. With settings.seconds it depends on the clock, so that two runs differ.
    """

    def __init__(self, dataset: Dataset, settings: TrainSettings, progress: Progress = silent, held_out: Dataset | None = None) -> None:
        """held_out: views to score now and then and never to train on. Raises SnergError where the dataset cannot be trained on."""
        keep_memory()
        self.devices = Devices()
        self.prepared = prepare(dataset, settings, progress, held_out)
        self.state = initial_state(self.prepared, self.devices)
        self.report = StepReport(0.0, 0.0, 0, 0)  # of the last step
        self.held_out_psnr: float | None = None
        self.trial: view_dependence_test.Trial | None = None  # while a diffuse field is on trial
        self.stopping = False  # set where the other processes of the training must stop with this one
        progress(0.0, "Compiling the training step")
        self.train_step = compiled_step(settings, self.devices, self.prepared.sampler)

    def fraction(self) -> float:
        """How much of the training is done, in [0, 1]."""
        return self.state.fraction(self.prepared.settings)

    def run(self) -> Iterator[TrainProgress]:
        """Train to the end, reporting every TELL_EVERY seconds. Close the generator to stop; the trainer can go on.

        Raises SnergError when PATIENCE steps in a row are not finite; the parameters are those before them. Raises Cancelled when
        another process of the training stops.
        """
        began, reported, scored = time.perf_counter() - self.state.elapsed, 0.0, self.state.elapsed
        compiled = False
        while self.fraction() < 1:
            self.test_view_dependence()
            self.advance()
            if not compiled:  # compiling, most of the first step, counts as set-up
                compiled, began = True, time.perf_counter() - self.state.elapsed
            elapsed = self._agreed(time.perf_counter() - began)
            self.state = replace(self.state, elapsed=elapsed)
            ended = self.fraction() >= 1
            if self.prepared.held_out is not None and (ended or elapsed - scored > SCORE_EVERY):
                held_out = self.prepared.held_out
                self.held_out_psnr = mean_psnr_of(self.errors(held_out), held_out.view)
                took = time.perf_counter() - began - elapsed
                scored = elapsed + max(took / SCORE_SHARE - SCORE_EVERY, 0)
            if ended or elapsed - reported > TELL_EVERY:
                reported = elapsed
                yield self.progress()

    def _agreed(self, elapsed: float) -> float:
        """Process 0's seconds. Raises Cancelled in all processes when one is `stopping`."""
        elapsed, stop = self.devices.agreed(elapsed, self.stopping)
        if stop:
            self.devices.leave()
            raise Cancelled("Stopped together with the other processes of this training; start them all again to go on.")
        return elapsed

    def progress(self) -> TrainProgress:
        """The progress after the last step."""
        state, report = self.state, self.report
        last = (int(report.rays), int(report.samples), report.rate)
        return TrainProgress(self.fraction(), state.step, state.loss, state.psnr, state.elapsed, *last, self.held_out_psnr)

    def advance(self) -> None:
        """One step, or those of one dispatch. Raises SnergError when the last PATIENCE steps are not finite."""
        sampler = self.prepared.sampler
        batch = self.train_step.draw(sampler, self.state)
        self.state, self.report = self.train_step(self.state, batch)
        params = self.devices.local(self.state.params)
        sampler.learn(params, self.state.step, self.report.aux)
        self.state = self.train_step.recorded(self.state, self.report)
        if (failed := self.state.non_finite_steps) >= PATIENCE:
            why, first = cause(sampler.loss, params, self.train_step.last(batch)), self.state.step - failed + 1
            raise SnergError(f"Training went wrong at step {first}, and {failed} times in a row: {why}.")

    def test_view_dependence(self) -> None:
        """Decide between a deferred and a diffuse field when it is time, and go on as decided; see `view_dependence_test`."""
        if not self.state.undecided or self.fraction() < view_dependence_test.AT:
            return
        if self.trial is not None:
            return self._end_trial(self.trial) if self.fraction() >= self.trial.ends else None
        if self.state.step < view_dependence_test.LEAST:
            return self.decide(view_dependence_test.too_short())
        prepared = self.prepared
        rays = view_dependence_test.tested_rays(prepared.rays, prepared.validation_views, prepared.settings)
        decision = view_dependence_test.run(self.field(), rays, prepared.validation_views)
        if self.devices.shared(decision.chosen == "deferred"):  # process 0 decides for all
            return self.decide(decision)
        checkpoint, before = self.checkpoint(), float(self.errors(rays).mean())
        self.state = replace(self.state, params=self.devices.place(view_dependence_test.silenced(self.devices.local(self.state.params))))
        if view_dependence_test.TRIAL * self.state.step / self.fraction() < view_dependence_test.RECOVERY:
            return self.decide(decision)
        ends = self.fraction() + view_dependence_test.TRIAL
        self.trial = view_dependence_test.Trial(ends, rays, before, decision, checkpoint)

    def _end_trial(self, trial: view_dependence_test.Trial) -> None:
        """Keep the diffuse field, or go back to the deferred one, at the present time of the training."""
        decision = trial.judged(float(self.errors(trial.rays).mean()))
        self.trial = None
        if self.devices.shared(decision.chosen == "deferred"):
            now = self.state
            self.restore(trial.checkpoint[1])
            self.state = replace(self.state, step=now.step, elapsed=now.elapsed)
        self.decide(decision)

    def decide(self, decision: Decision) -> None:
        """Go on as the view-dependence test decided; its validation views are trained on from now on."""
        self.state = self.state.decided(decision)
        self.prepared.rays.withheld = np.zeros_like(self.prepared.validation_views)

    def errors(self, rays: ValidationRays) -> NDArray[Any]:
        """Squared colour errors [R] of validation rays."""
        return rays.errors(self.prepared.sampler.colours(self.state.best(self.devices), rays, self.fraction()))

    def field(self) -> Field:
        """The field as trained so far."""
        return trained_field(self.prepared, self.state, self.state.best(self.devices), self.held_out_psnr)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What `restore` reads, named arrays of any shape: the state, the random state and the sampler's.

        Raises SnergError as `state_arrays` does.
        """
        random = np.frombuffer(repr(self.prepared.rng.bit_generator.state).encode(), np.uint8)
        sampler = {name: np.array(value) for name, value in self.prepared.sampler.state().items()}
        return state_arrays(self.state, self.devices) | {"random": random} | sampler

    def checkpoint(self) -> tuple[Field, dict[str, NDArray[Any]]]:
        """The field, and the named arrays of any shape to continue from. While a diffuse field is on trial, those from before it."""
        return (self.field(), self.arrays()) if self.trial is None else self.trial.checkpoint

    def restore(self, arrays: dict[str, NDArray[Any]], decisions: list[dict[str, Any]] | None = None) -> None:
        """Continue from `arrays` (of any shape), and from the decisions in the field's `about`.

        Raises SnergError when they are another network's, and ValueError or KeyError when they are damaged.
        """
        prepared = self.prepared
        self.state = restored_state(self.state, arrays, self.devices, prepared.settings)
        prepared.sampler.restore(arrays)
        prepared.rng.bit_generator.state = literal_eval(arrays["random"].tobytes().decode())
        withheld = prepared.validation_views
        prepared.rays.withheld = withheld.copy() if self.state.undecided else np.zeros_like(withheld)
        for known in decisions or []:
            if known["effect"] == view_dependence_test.EFFECT:
                self.decide(Decision(**known))


def keep_memory() -> None:
    """Ask glibc to keep freed memory: XLA allocates the same temporaries every step, and above 32 MB glibc would
    map and fault them in afresh each time, which takes longer than the step. Elsewhere this does nothing."""
    if sys.platform != "linux":
        return
    try:
        libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6")
        for option, value in ((-1, 2**31 - 1), (-3, 2**30), (-8, 1)):  # trim threshold, mmap threshold, one arena
            libc.mallopt(option, value)
    except (OSError, AttributeError):
        pass


def writes() -> bool:
    """Whether this process writes the training's files: process 0, or the only one."""
    return bool(jax.process_index() == 0)


def train(
    dataset: Dataset,
    settings: TrainSettings,
    folder: Path,
    progress: Progress = silent,
    resume: bool = False,
    save_every: float = 60.0,
    preview: Callable[[Field, float], None] | None = None,
) -> Field:
    """Train a field, and write it and its log to `folder`: every `save_every` seconds, when cancelled and at the end.

    resume: go on with the training in the folder. A kill loses what was trained since the last save. Of several processes only the
    first writes. preview: called now and then with the field so far and the fraction done (see Saver). Returns the trained field.
    Raises SnergError on bad input or when training goes wrong (then the last good state is on disk), Cancelled when `progress` does.
    """
    trainer = Trainer(dataset, settings, progress, held_out_of(dataset))
    if resume:
        resume_from(trainer, folder)
    for decision in trainer.state.decisions:
        progress(trainer.fraction(), Note(decision.text()))
    saver = None
    if trainer.devices.writes:
        saver = Saver(folder, trainer.checkpoint, save_every, trainer.state.step, trainer.held_out_psnr, preview)
    with saved_when_stopped(trainer, saver):
        run_to_the_end(trainer, saver, progress)
    sampler = trainer.prepared.sampler
    if isinstance(sampler, DeviceSampler) and (remark := sampler.remark()):
        progress(1.0, Note(remark))
    field = trainer.field()
    if saver:
        with SAVING:
            write_field(field, folder)  # without the training's state, five sixths of the file: it is finished
    return field


def resume_from(trainer: Trainer, folder: Path) -> None:
    """Resume the training in a folder when its field.npz contains a training state. Raises SnergError when the state is damaged or belongs
    to another network."""
    old, arrays = read_field_and_state(folder)
    if arrays:
        with reading(folder, "train into a new folder", f"The training state in {folder}"):
            trainer.restore(arrays, old.about.get("decisions"))


def run_to_the_end(trainer: Trainer, saver: Saver | None, progress: Progress) -> None:
    """Run the trainer; report to `progress`, and log and save with the saver."""
    known = len(trainer.state.decisions)
    together = trainer.devices.processes > 1
    notify = _together(trainer, progress) if together else progress
    # One process that left at once would leave the others waiting: like a save, parting may take longer than Ctrl-C otherwise does.
    with SAVING if together else nullcontext(), closing(trainer.run()) as run:  # type: ignore[type-var]
        for report in run:
            notify(report.fraction, report.text())
            for decision in trainer.state.decisions[known:]:
                notify(report.fraction, Note(decision.text()))
            known = len(trainer.state.decisions)
            if saver:
                saver.after(report)


@contextmanager
def saved_when_stopped(trainer: Trainer, saver: Saver | None) -> Iterator[None]:
    """Save the training when it is cancelled or goes wrong. Raises SnergError where another process of it is gone."""
    try:
        yield
    except (Cancelled, KeyboardInterrupt):
        if saver and trainer.state.step:
            saver.save()
        raise
    except RuntimeError as error:  # of JAX: the connection to another process broke
        if trainer.devices.processes == 1:
            raise
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SnergError(f"Another process of this training is gone ({why}); start them all again to go on from the last save.") from error
    except SnergError:
        with suppress(SnergError):  # the first error is the one to report, not that of saving
            if saver and trainer.state.step:
                saver.save()
        raise


def _together(trainer: Trainer, progress: Progress) -> Progress:
    """The progress function of one of several processes. When one is cancelled, all stop after the same step: otherwise the others would
    wait for it."""

    def notify(fraction: float, what: str, /) -> None:
        try:
            progress(fraction, what)
        except Cancelled:
            trainer.stopping = True

    return notify
