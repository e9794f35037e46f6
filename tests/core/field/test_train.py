"""Training for real, small: it learns, stops cleanly, resumes to the bit, and refuses what cannot work."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snerg.core.capture.dataset import Dataset, read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.field.checkpoint import read_field, read_field_and_state, write_field
from snerg.core.field.encoding import HashGrid
from snerg.core.field.networks import HashFamily, MlpFamily, init_field
from snerg.core.field.packed import Batch
from snerg.core.field.render import render_field
from snerg.core.field.settings import TrainSettings
from snerg.core.field.train import Trainer, train
from snerg.core.study.metrics import psnr

FAMILY = HashFamily(HashGrid(levels=4, coarsest=8, finest=64, features=4, log2_size=14))
SETTINGS = TrainSettings(family=FAMILY, samples=4096, spacing=2 / 96, seconds=None, steps=40)


@pytest.fixture(scope="module")
def views(dataset) -> Dataset:
    return read_dataset(dataset)


def truth(dataset: Dataset, index: int) -> np.ndarray:
    pixels = dataset.read(index).astype(np.float32) / 255
    return pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]


@pytest.fixture(scope="module")
def trained(views, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained") / "field"
    return train(views, replace(SETTINGS, steps=200), folder), folder


def test_it_learns_what_it_never_saw(trained, views, dataset):
    held = read_dataset(dataset, "test")
    field = trained[0]
    scores = [psnr(render_field(field, held.cameras[i]).over(), truth(held, i)) for i in range(3)]
    blank = [psnr(np.ones_like(truth(held, i)), truth(held, i)) for i in range(3)]
    assert min(scores) > 21 and min(np.subtract(scores, blank)) > 9


def test_a_field_comes_back_from_disk_as_it_was(trained, views):
    field, folder = trained
    again = read_field(folder)
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (500, 3))
    for a, b in zip(field.query(points), again.query(points), strict=True):
        assert np.array_equal(a, b)
    assert [c.name for c in again.cameras] == [c.name for c in views.cameras]
    assert again.about["steps"] == 200


def test_a_field_holds_nothing_outside_its_occupancy(trained):
    density, _, _ = trained[0].query(np.array([[50.0, 0, 0], [0, 0, -20]]))
    assert not density.any()


@pytest.mark.hard_case(29)
def test_a_resumed_run_equals_an_uninterrupted_one(views, tmp_path):
    whole = train(views, SETTINGS, tmp_path / "whole")

    trainer = Trainer(views, SETTINGS)
    for _ in trainer.run():
        if trainer.step >= 17:
            break
    write_field(trainer.field(), tmp_path / "broken", trainer.state())
    resumed = train(views, SETTINGS, tmp_path / "broken", resume=True)
    for a, b in zip(jax.tree.leaves(whole.params), jax.tree.leaves(resumed.params), strict=True):
        assert np.array_equal(a, b)


def test_cancelling_keeps_what_was_learned(views, tmp_path):
    def stop(fraction: float, what: str) -> None:
        if fraction > 0:
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        train(views, replace(SETTINGS, steps=None, seconds=600.0), tmp_path / "field", stop)
    field, state = read_field_and_state(tmp_path / "field")
    assert field.about["steps"] > 0 and state


@pytest.mark.hard_case(26)
def test_a_step_that_is_not_finite_changes_nothing(views):
    trainer = Trainer(views, SETTINGS)
    trainer.advance()
    before = jax.tree.map(np.asarray, (trainer.params, trainer.moments))
    batch = dict(trainer.scheme.batch(trainer.params, 0.0).arrays)
    batch["directions"] = np.full_like(batch["directions"], np.nan)
    params, moments, (_, _, finite) = trainer._step(*jax.tree.map(jnp.asarray, before), batch, 1e-2, 5)
    assert not finite
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves((params, moments)), strict=True):
        assert np.array_equal(a, np.asarray(b))


@pytest.mark.hard_case(27)
def test_training_that_breaks_stops_with_a_sentence_and_the_last_good_state(views):
    trainer = Trainer(views, SETTINGS)
    trainer.advance()
    good = jax.tree.map(np.asarray, trainer.params)
    draw = trainer.scheme.batch

    def broken(params: object, fraction: float) -> Batch:
        batch = draw(params, fraction)
        return replace(batch, arrays={**batch.arrays, "directions": batch.arrays["directions"] * np.nan})

    trainer.scheme.batch = broken  # type: ignore[method-assign]
    with pytest.raises(SnergError, match="5 times in a row: the rays .directions. are not finite; look for a broken pose"):
        for _ in range(12):
            trainer.advance()
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(trainer.params), strict=True):
        assert np.array_equal(a, np.asarray(b))


@pytest.mark.hard_case(24)
def test_no_initialisation_is_dead():
    from snerg.core.field.networks import field_inputs, field_outputs

    x = np.random.default_rng(0).uniform(-1, 1, (64, 3)).astype(np.float32)
    for family in (HashFamily(HashGrid(levels=2, log2_size=8)), MlpFamily(width=16, depth=4)):
        for seed in range(200):
            params = init_field(family, "diffuse", np.random.default_rng(seed))
            density, _ = field_outputs(np, family, params["field"], field_inputs(np, family, x))
            assert density.max() > 1e-3


@pytest.mark.parametrize("family", [FAMILY, MlpFamily(width=32, depth=3)])
@pytest.mark.parametrize("view_dependence", ["auto", "deferred", "diffuse", "sample", "tiny"])
def test_every_family_takes_a_step(views, family, view_dependence):
    trainer = Trainer(views, replace(SETTINGS, family=family, view_dependence=view_dependence, steps=3))
    told = list(trainer.run())
    assert told[-1].fraction == 1 and np.isfinite(told[-1].loss)
    assert (trainer.field().network is None) is (view_dependence in ("diffuse", "sample"))


@pytest.mark.hard_case(28)
@pytest.mark.parametrize("wrong", [{"rate": 0.0}, {"final_rate": 0.0}, {"steps": 0}, {"seconds": -1.0, "steps": None}])
def test_schedules_that_make_no_sense(wrong):
    with pytest.raises(SnergError):
        replace(SETTINGS, **wrong)


def test_a_checkpoint_cut_short(trained, tmp_path):
    data = (trained[1] / "field.npz").read_bytes()
    for size in (0, 10, len(data) // 2, len(data) - 5):
        (tmp_path / "field.npz").write_bytes(data[:size])
        with pytest.raises(SnergError, match="damaged or cut short"):
            read_field(tmp_path)


@pytest.mark.hard_case(59)
def test_nothing_that_is_not_finite_is_written(trained, tmp_path):
    field, _ = trained
    broken = replace(field, params={**field.params, "bias_1": np.full_like(field.params["bias_1"], np.nan)})
    with pytest.raises(SnergError, match=r"params\.bias_1"):
        write_field(broken, tmp_path / "field")
    assert not (tmp_path / "field").exists()
