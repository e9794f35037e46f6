"""Trainings that take several steps in one dispatch and pack their samples on the device."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from snerg.core.data.dataset import Dataset
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.io.images import over
from snerg.core.nerf.checkpoint import read_field_and_state
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.render import render_field
from snerg.core.study.metrics import psnr
from snerg.core.training import trainer as training
from snerg.core.training import view_dependence_test
from snerg.core.training.config import TrainSettings
from snerg.core.training.device_sampler import DeviceSampler, step_of
from snerg.core.training.dispatch import Dispatch, train_steps
from snerg.core.training.optimizer import learning_rate, train_step, zero_moments
from snerg.core.training.parallel import Devices
from snerg.core.training.saving import TrainProgress
from snerg.core.training.state import TrainState
from snerg.core.training.trainer import Trainer, train
from snerg.core.training.weight_average import WeightAverage

FAMILY = HashModelConfig(HashGrid(levels=2, coarsest=16, finest=64, features=4, log2_size=14))
SETTINGS = TrainSettings(family=FAMILY, samples=2048, spacing=2 / 96, packing="device", seconds=None, steps=44, average=0.5)


@pytest.fixture(scope="module")
def views(dataset) -> Dataset:
    return read_dataset(dataset)


@pytest.fixture(scope="module", autouse=True)
def all_is_told() -> Iterator[None]:
    """Progress after every dispatch, and a test of view dependence in a training this short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view_dependence_test, "LEAST", 2)
        patch.setattr(training, "TELL_EVERY", -1.0)
        yield


class Finished:
    """A whole training: after each dispatch its report, its parameters, and what it takes to go on."""

    def __init__(self, views: Dataset) -> None:
        self.trainer, self.told, self.params, self.arrays = Trainer(views, SETTINGS), [], {}, {}
        for told in self.trainer.run():
            self.told.append(told)
            self.params[told.step] = jax.tree.map(np.array, self.trainer.state.params)
            self.arrays[told.step] = self.trainer.arrays(), [d.to_json() for d in self.trainer.state.decisions]
        self.field = self.trainer.field()


@pytest.fixture(scope="module")
def finished(views) -> Finished:
    return Finished(views)


def state_at(step: int, seconds: float = 0.0) -> TrainState:
    return TrainState((), ((), ()), WeightAverage(), (), "deferred", False, step, seconds)


@pytest.mark.parametrize(
    ("changed", "places", "ends"),
    [
        ({"steps": 44, "average": 0.5}, 16, [16, 24, 32, 40, 44]),
        ({"steps": 50, "average": 0.0}, 16, [16, 32, 48, 50]),
        ({"steps": 5, "average": 0.5}, 2, [2, 4, 5]),
        ({"steps": 3, "average": 0.5}, 1, [1, 2, 3]),
    ],
)
def test_dispatches_end_at_the_same_steps_wherever_they_begin(changed, places, ends):
    """Where parameters are averaged, at every step whose parameters are."""
    dispatch = Dispatch(replace(SETTINGS, **changed), None, None, None, places)
    for begin in [0, *ends[:-1]]:
        step, found = begin, []
        while step < ends[-1]:
            step += dispatch.count(state_at(step))
            found.append(step)
        assert found == [end for end in ends if end > begin]


def test_dispatches_of_a_training_by_the_clock_follow_it():
    dispatch = Dispatch(replace(SETTINGS, steps=None, seconds=100.0, average=0.1), None, None, None, 16)
    assert [dispatch.count(state_at(160, seconds)) for seconds in (0.0, 89.0, 91.0)] == [16, 16, 8]
    assert dispatch.count(state_at(165, 50.0)) == 11 and dispatch.fraction(state_at(160, 50.0), 9) == 0.5


def test_a_loop_of_steps_is_steps_one_after_another():
    def loss_of(params: Any, batch: Any) -> Any:
        miss = (params["weights"] - batch["length"] * batch["target"]) ** 2
        return miss.sum(), {"error": miss.mean(), "each": miss}

    draw = np.random.default_rng(0)
    params = {"weights": draw.normal(size=3).astype(np.float32)}
    batch = {"target": draw.normal(size=(4, 3)).astype(np.float32), "length": np.float32(2)}
    batch["target"][3] = np.nan  # of no step
    rates = np.array([0.1, 0.2, 0.05, 9.0], np.float32)
    found, moments, (loss, aux, finite) = jax.jit(partial(train_steps, SETTINGS, loss_of))(params, zero_moments(params), batch, rates, 7, 3)
    state, after, losses = params, zero_moments(params), []
    for i in range(3):
        state, after, result = train_step(SETTINGS, loss_of, state, after, step_of(batch, i), rates[i], 7 + i)
        losses.append(result)
    for a, b in zip(jax.tree.leaves((found, moments)), jax.tree.leaves((state, after)), strict=True):
        assert np.allclose(a, b, rtol=1e-6)
    assert np.allclose(loss, [*(one[0] for one in losses), 0]) and finite.tolist() == [True, True, True, False]
    assert np.allclose(aux["each"], [*(one[1]["each"] for one in losses), np.zeros(3)]) and aux["error"].shape == (4,)


@pytest.mark.slow
def test_dispatches_end_where_parameters_are_averaged_and_where_training_ends(finished):
    assert [told.step for told in finished.told] == [16, 24, 32, 40, 44] and isinstance(finished.trainer.prepared.sampler, DeviceSampler)
    assert all(isinstance(told, TrainProgress) and type(told.rays) is type(told.samples) is int for told in finished.told)
    assert all(0 < told.rays < 512 and 1000 < told.samples <= 2048 and np.isfinite(told.loss) for told in finished.told[1:])
    mean = np.mean([finished.params[step]["field"]["weights_0"] for step in (24, 32, 40)], axis=0, dtype=np.float64)
    assert np.abs(finished.field.params["weights_0"] - mean).max() < 1e-6
    assert finished.trainer.state.average.count == 3
    assert not finished.trainer.state.undecided and finished.told[-1].psnr > finished.told[0].psnr + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("step", [16, 32])
def test_what_is_resumed_ends_with_the_same_bytes(finished, step):
    trainer = finished.trainer
    whole = trainer.arrays()
    trainer.restore(*finished.arrays[step])
    assert trainer.state.step == step
    again = [told.step for told in trainer.run()]
    assert again == [s for s in (16, 24, 32, 40, 44) if s > step]
    found = trainer.arrays()
    clock, before = found.pop("clock"), whole.pop("clock")
    assert clock[[0, 2, 3, 4]].tobytes() == before[[0, 2, 3, 4]].tobytes()  # without the seconds
    assert found.keys() == whole.keys() and all(found[name].tobytes() == whole[name].tobytes() for name in whole)
    whole["clock"] = before
    for a, b in zip(jax.tree.leaves(finished.field.params), jax.tree.leaves(trainer.field().params), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.slow
def test_a_dispatch_that_breaks_is_a_sentence_and_changes_nothing(finished, monkeypatch):
    trainer = finished.trainer
    trainer.restore(*finished.arrays[24])
    sampler = trainer.prepared.sampler
    draw = sampler.batches

    def broken(*of: Any) -> Any:
        batch = draw(*of)
        return replace(batch, arrays={**batch.arrays, "directions": batch.arrays["directions"] * np.float32(np.nan)})

    monkeypatch.setattr(sampler, "batches", broken)
    with pytest.raises(
        SnergError, match=r"wrong at step 25, and 8 times in a row: the rays .directions. are not finite; look for a broken pose"
    ):
        trainer.advance()
    for a, b in zip(jax.tree.leaves(finished.params[24]), jax.tree.leaves(trainer.state.params), strict=True):
        assert np.array_equal(a, np.asarray(b))


@pytest.mark.slow
def test_steps_of_one_dispatch_are_steps_one_after_another(views):
    trainer = Trainer(views, SETTINGS)
    sampler, devices = trainer.prepared.sampler, Devices()
    single = devices.step(SETTINGS, sampler.loss)
    batch = trainer.train_step.draw(sampler, trainer.state)
    params, moments = jax.tree.map(np.array, (trainer.state.params, trainer.state.moments))
    _, report = trainer.train_step(trainer.state, batch)
    losses = []
    for i in range(batch.steps):
        rate = learning_rate(SETTINGS, i, i / 44)
        params, moments, (loss, _, finite) = single(params, moments, step_of(batch.arrays, i), rate, i + 1)
        losses.append(float(loss))
        assert finite
    assert batch.steps == 16 and np.allclose(report.loss, losses, rtol=1e-3) and losses[-1] < 0.95 * losses[0]
    assert float(report.loss[0]) == pytest.approx(losses[0], rel=1e-6)


@pytest.mark.slow
def test_cancelling_keeps_what_was_learned(views, tmp_path):
    def stop(fraction: float, what: str) -> None:
        if fraction > 0:
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        train(views, replace(SETTINGS, steps=None, seconds=600.0), tmp_path / "field", stop)
    field, state = read_field_and_state(tmp_path / "field")
    assert field.about["steps"] % 16 == 0 < field.about["steps"] and "overflow" in state


@pytest.mark.slow
def test_it_learns_as_much_as_on_the_host(views, dataset, tmp_path):
    """Over seeds, the PSNR of one way has a standard deviation of 0.3 dB: the difference of two means of three, of 0.25 dB."""
    held = read_dataset(dataset, "test")
    scores = {}
    for packing in ("host", "device"):
        for seed in range(3):
            settings = replace(SETTINGS, samples=4096, steps=200, average=0.1, seed=seed, packing=packing)
            field = train(views, settings, tmp_path / f"{packing}{seed}")
            for i in range(3):
                wanted = over(held.read(i))
                scores.setdefault(packing, []).append(psnr(render_field(field, held.cameras[i]).over(), wanted))
    assert np.mean(scores["device"]) > np.mean(scores["host"]) - 0.75 and min(scores["device"]) > 20
