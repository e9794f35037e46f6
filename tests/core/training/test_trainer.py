"""Training for real, small: it learns, stops cleanly, resumes to the bit, and refuses what cannot work."""

import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenes import looking
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.data.dataset import Dataset, View
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.images import write_png
from snerg.core.nerf.checkpoint import read_field, read_field_and_state, write_field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, ViewNetwork, init_field
from snerg.core.nerf.render import render_field
from snerg.core.study.metrics import psnr
from snerg.core.training import view_dependence_test
from snerg.core.training.config import TrainSettings
from snerg.core.training.decisions import Decision
from snerg.core.training.log import read_log
from snerg.core.training.losses import mse_to_psnr
from snerg.core.training.non_finite import cause
from snerg.core.training.sampler import Batch
from snerg.core.training.trainer import Trainer, train
from snerg.core.training.validation import ValidationRays
from snerg.core.training.weight_average import EVERY

FAMILY = HashModelConfig(HashGrid(levels=4, coarsest=8, finest=64, features=4, log2_size=14))
SETTINGS = TrainSettings(family=FAMILY, samples=4096, spacing=2 / 96, seconds=None, steps=40)
pytestmark = pytest.mark.usefixtures("carved_once")


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


@pytest.mark.slow
def test_the_loss_for_hard_surfaces_makes_light_end_sooner(views, tmp_path):
    """Ten times the usual weight, so that hundreds of steps show what thousands do: fewer voxels on a ray's way, and fewer kept. The loss
    alone: a mean of steps makes soft surfaces a little harder by itself."""
    settings = replace(SETTINGS, steps=600, average=0.0)
    told = []
    for hardness in (0.0, 5e-3):
        field = train(views, replace(settings, hardness=hardness), tmp_path / f"{hardness}")
        told.append(bake(field, field.domain.world_box(), views.cameras, BakeSettings(64, supersampling=1)).about["bake"])
    soft, hard = told
    assert hard["light"]["voxels"] < 0.8 * soft["light"]["voxels"] and hard["light"]["passes"] < soft["light"]["passes"]
    assert hard["voxels"]["seen"] < 0.8 * soft["voxels"]["seen"]


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
        if trainer.state.step >= 17:
            break
    write_field(trainer.field(), tmp_path / "broken", trainer.arrays())
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
    before = jax.tree.map(np.asarray, (trainer.state.params, trainer.state.moments))
    batch = dict(trainer.prepared.sampler.batch(trainer.state.params, 0.0).arrays)
    batch["directions"] = np.full_like(batch["directions"], np.nan)
    params, moments, (_, _, finite) = trainer.train_step.compiled(*jax.tree.map(jnp.asarray, before), batch, 1e-2, 5)
    assert not finite
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves((params, moments)), strict=True):
        assert np.array_equal(a, np.asarray(b))


@pytest.mark.hard_case(27)
def test_training_that_breaks_stops_with_a_sentence_and_the_last_good_state(views):
    trainer = Trainer(views, SETTINGS)
    trainer.advance()
    good = jax.tree.map(np.asarray, trainer.state.params)
    draw = trainer.prepared.sampler.batch

    def broken(params: object, fraction: float) -> Batch:
        batch = draw(params, fraction)
        return replace(batch, arrays={**batch.arrays, "directions": batch.arrays["directions"] * np.nan})

    trainer.prepared.sampler.batch = broken  # type: ignore[method-assign]
    with pytest.raises(SnergError, match=r"5 times in a row: the rays .directions. are not finite; look for a broken pose"):
        for _ in range(12):
            trainer.advance()
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(trainer.state.params), strict=True):
        assert np.array_equal(a, np.asarray(b))


@pytest.mark.hard_case(24)
def test_no_initialisation_is_dead():
    from snerg.core.nerf.model import field_inputs, field_outputs

    x = np.random.default_rng(0).uniform(-1, 1, (64, 3)).astype(np.float32)
    for family in (HashModelConfig(HashGrid(levels=2, log2_size=8)), MlpModelConfig(width=16, depth=4)):
        for seed in range(200):
            params = init_field(family, "diffuse", np.random.default_rng(seed))
            density, _ = field_outputs(np, family, params["field"], field_inputs(np, family, x))
            assert density.max() > 1e-3


@pytest.mark.parametrize("family", [FAMILY, MlpModelConfig(width=32, depth=3)])
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


RUN_AND_SAVE_EACH_STEP = """
import pickle, sys
from pathlib import Path
from snerg.core.data.load import read_dataset
from snerg.core.training import saving, trainer as train, view_dependence_test
from snerg.core.nerf.checkpoint import is_field
train.TELL_EVERY, saving.SAVE_SHARE, view_dependence_test.LEAST, view_dependence_test.RECOVERY = 0.0, 1e9, 2, 0
dataset, folder, settings = sys.argv[1:]
def tell(fraction, what):
    print(what, flush=True)
folder = Path(folder)
train.train(read_dataset(Path(dataset)), pickle.loads(bytes.fromhex(settings)), folder, tell, is_field(folder), 0.0)
"""


@pytest.mark.slow
@pytest.mark.hard_case(29)
def test_killed_at_any_moment_and_resumed_it_ends_where_an_uninterrupted_run_does(views, dataset, tmp_path, monkeypatch):
    """Saving after every step, most kills fall into a save; view dependence is tried on the way."""
    monkeypatch.setattr(view_dependence_test, "LEAST", 2)
    monkeypatch.setattr(view_dependence_test, "RECOVERY", 0)
    settings = replace(SETTINGS, steps=60)
    whole = train(views, settings, tmp_path / "whole")
    folder = tmp_path / "killed"
    draw = np.random.default_rng(0)
    for _ in range(2):
        command = [sys.executable, "-c", RUN_AND_SAVE_EACH_STEP, str(dataset), str(folder), pickle.dumps(settings).hex()]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        steps = (line for line in child.stdout if line.startswith("Step"))
        next(steps), next(steps)  # it has saved between them
        time.sleep(draw.uniform(0, 0.3))
        child.send_signal(signal.SIGKILL)
        child.communicate()
    state = read_field_and_state(folder)[1]
    assert 0 < state["clock"][0] < 60
    resumed = train(views, settings, folder, resume=True)
    for a, b in zip(jax.tree.leaves((whole.params, whole.network)), jax.tree.leaves((resumed.params, resumed.network)), strict=True):
        assert a.tobytes() == b.tobytes()
    assert np.array_equal(whole.occupancy, resumed.occupancy)
    assert [d["effect"] for d in resumed.about["decisions"]] == [d["effect"] for d in whole.about["decisions"]]
    steps = [line["step"] for line in read_log(folder) if "loss" in line]
    assert steps == sorted(set(steps)) and steps[-1] == 60


def test_a_field_is_the_mean_over_the_last_steps_resumed_or_not(views, tmp_path):
    settings = replace(SETTINGS, steps=60, average=0.5)
    trainer, seen, halfway = Trainer(views, settings), [], {}
    while trainer.fraction() < 1:
        trainer.advance()
        if trainer.state.step > 30 and trainer.state.step % EVERY == 0:
            seen.append(np.asarray(trainer.state.params["field"]["weights_0"], np.float64))
        if trainer.state.step == 45:
            halfway = trainer.arrays()
    last, mean = seen[-1], trainer.field().params["weights_0"]
    assert np.abs(mean - np.mean(seen, axis=0)).max() < 1e-6 < np.abs(mean - last).max()
    other = Trainer(views, settings)
    other.restore(halfway)
    while other.fraction() < 1:
        other.advance()
    for a, b in zip(jax.tree.leaves(trainer.field().params), jax.tree.leaves(other.field().params), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize(("coarse", "networks"), [(8, 2), (200, 1)])
def test_the_fine_network_is_there_where_it_is_needed(views, coarse, networks):
    """The ball's rays go up to 2 through the domain: 128 samples at this spacing."""
    trainer = Trainer(views, replace(SETTINGS, sampler="hierarchical", coarse=coarse, spacing=2 / 128))
    assert trainer.state.decisions[-2].chosen is (networks == 2) and ("coarse" in trainer.state.params) is (networks == 2)


def test_it_logs_as_it_goes(trained):
    lines = read_log(trained[1])
    assert {"step", "seconds", "fraction", "loss", "psnr", "rate", "samples", "rays"} <= set(lines[0])
    held = [line["held_out_psnr"] for line in lines if "held_out_psnr" in line]
    assert lines[-1]["step"] == 200 and held[-1] > 15
    assert trained[0].about["psnr_held_out_rays"] == held[-1]


@pytest.mark.hard_case(27)
def test_the_cause_of_a_broken_step_is_named(views):
    trainer = Trainer(views, SETTINGS)
    arrays = trainer.prepared.sampler.batch(trainer.state.params, 0.0).arrays
    params = jax.tree.map(np.array, trainer.state.params)
    nan = np.float32(np.nan)
    assert "a broken pose" in cause(trainer.prepared.sampler.loss, params, {**arrays, "directions": arrays["directions"] * nan})
    assert "a broken image" in cause(trainer.prepared.sampler.loss, params, {**arrays, "target": arrays["target"] * nan})
    for name, where in (("table_2", "the hash table"), ("weights_1", "the field's network")):
        broken = {**params, "field": {**params["field"], name: params["field"][name] * nan}}
        assert cause(trainer.prepared.sampler.loss, broken, arrays).startswith(where)
    view = tuple(a * nan if i == 4 else a for i, a in enumerate(params["view"]))
    assert cause(trainer.prepared.sampler.loss, {**params, "view": view}, arrays).startswith("the view-dependence network")
    huge = {**params, "field": {**params["field"], "weights_0": np.full_like(params["field"]["weights_0"], 1e30)}}
    assert "lower the learning rate" in cause(trainer.prepared.sampler.loss, huge, arrays)
    assert "the step made of it" in cause(trainer.prepared.sampler.loss, params, arrays)  # nothing is wrong with any of them


@pytest.mark.hard_case(27)
def test_nothing_that_is_not_finite_reaches_the_disk(views, tmp_path):
    trainer = Trainer(views, SETTINGS)
    trainer.advance()
    write_field(trainer.field(), tmp_path, trainer.arrays())
    data = (tmp_path / "field.npz").read_bytes()
    first, second = trainer.state.moments
    broken = {**first, "field": {**first["field"], "bias_0": first["field"]["bias_0"] * jnp.nan}}
    trainer.state = replace(trainer.state, moments=(broken, second))
    with pytest.raises(SnergError, match="field's network"):
        write_field(trainer.field(), tmp_path, trainer.arrays())
    assert (tmp_path / "field.npz").read_bytes() == data


@pytest.mark.hard_case(30)
def test_the_psnr_of_no_error_is_finite():
    assert mse_to_psnr(0.0) == 100 and mse_to_psnr(0.01) == pytest.approx(20)


def test_a_diffuse_decision_leaves_a_diffuse_field(views):
    trainer = Trainer(views, SETTINGS)
    trainer.advance()
    trainer.decide(Decision(view_dependence_test.EFFECT, "diffuse", "So this test says."))
    field = trainer.field()
    assert field.view == "diffuse" and field.network is None
    assert field.query(np.zeros((1, 3)))[2].shape == (1, 0)
    deferred = Trainer(views, replace(SETTINGS, view_dependence="deferred"))
    assert deferred.field().network is not None and not deferred.state.undecided and not deferred.prepared.rays.withheld.any()


def on_trial(views, monkeypatch) -> Trainer:
    """A training whose test found the scene diffuse, on its first step without view dependence."""
    monkeypatch.setattr(view_dependence_test, "LEAST", 2)
    monkeypatch.setattr(view_dependence_test, "RECOVERY", 0)
    found = Decision(view_dependence_test.EFFECT, "diffuse", "So this test says.", 0.0, 0.1)
    monkeypatch.setattr(view_dependence_test, "run", lambda *_: found)
    trainer = Trainer(views, SETTINGS)
    while trainer.trial is None:
        trainer.test_view_dependence()
        before = trainer.state
        trainer.advance()
    assert before.step == view_dependence_test.AT * 40
    return trainer


@pytest.mark.parametrize("worse", [True, False])
def test_a_diffuse_field_that_shows_less_than_before_gives_way_to_the_deferred_one(views, monkeypatch, worse):
    trainer = on_trial(views, monkeypatch)
    trial, (field, arrays) = trainer.trial, trainer.checkpoint()
    assert field.view == "deferred" and arrays["clock"][0] == 12 and trainer.state.undecided  # a save keeps what was before the trial
    before = [np.array(a) for a in field.network]
    while trainer.trial is not None:
        trainer.advance()
        if trainer.fraction() >= trial.ends:
            error = float(trainer.errors(trial.rays).mean())
            trainer.trial = replace(trial, before=error * (0.99 if worse else 1.01))
        trainer.test_view_dependence()
    assert trainer.state.step == 16 and not trainer.state.undecided and not trainer.prepared.rays.withheld.any()
    (decision,) = [d for d in trainer.state.decisions if d.effect == view_dependence_test.EFFECT]
    assert decision.chosen == trainer.field().view == ("deferred" if worse else "diffuse")
    assert decision.measured == pytest.approx(0.0436 if worse else -0.0432, abs=1e-3)
    assert decision.evidence.endswith(f"0.04 dB {'worse' if worse else 'better'} than before.")
    if worse:
        assert all(np.array_equal(a, b) for a, b in zip(before, trainer.field().network, strict=True))
        trainer.advance()
        assert trainer.state.step == 17 and not np.array_equal(before[0], trainer.field().network[0])  # and it goes on learning


def test_short_trainings_have_no_trial(views, monkeypatch):
    monkeypatch.setattr(view_dependence_test, "RECOVERY", 0)
    assert on_trial(views, monkeypatch).trial is not None
    monkeypatch.setattr(view_dependence_test, "RECOVERY", 5)  # more than a tenth of 40 steps
    trainer = Trainer(views, SETTINGS)
    while trainer.state.undecided:
        trainer.advance()
        trainer.test_view_dependence()
    assert trainer.state.step == 12 and trainer.trial is None and trainer.state.view == "diffuse"


def test_once_the_scene_is_found_diffuse_the_view_network_learns_nothing(views):
    trainer = Trainer(views, SETTINGS)
    assert trainer.prepared.rays.withheld.any()
    trainer.state = replace(trainer.state, params=view_dependence_test.silenced(trainer.state.params))
    before = [np.array(a) for a in trainer.state.params["view"]]
    for _ in range(3):
        trainer.advance()
    assert all(np.array_equal(a, np.asarray(b)) for a, b in zip(before, trainer.state.params["view"], strict=True))


@pytest.mark.parametrize("degrees", [0, 2, 4])
def test_the_view_network_sees_so_many_frequencies_of_the_direction(views, degrees):
    trainer = Trainer(views, replace(SETTINGS, view_degrees=degrees))
    trainer.advance()
    first = np.asarray(trainer.state.params["view"][0])
    direction, waves, rest = first[:3], first[3:27].reshape(2, 4, 3, 16), first[27:]
    assert not waves[:, degrees:].any() and all(part.any() for part in (direction, rest, *waves[:, :degrees].reshape(-1, 3, 16)))


def test_view_dependence_is_held_against_its_own_average(views):
    """With a network that adds nothing both are the same; with one that follows the direction they are not."""
    trainer = Trainer(views, SETTINGS)
    rays = ValidationRays(trainer.prepared.rays, trainer.prepared.validation_views, 512, SETTINGS)
    field = trainer.field()
    silent = replace(field, network=ViewNetwork(*map(np.asarray, view_dependence_test.silenced(trainer.state.params)["view"])))
    averaged, own = view_dependence_test.errors(silent, rays, views.cameras)
    assert np.allclose(averaged, own, atol=1e-9) and own.any()
    *rest, last = field.network
    awake = replace(field, network=ViewNetwork(*rest, last + 3))
    averaged, own = view_dependence_test.errors(awake, rays, views.cameras)
    assert np.abs(averaged - own).max() > 1e-3
    behind = [replace(c, camera_to_world=c.camera_to_world @ np.diag([-1.0, 1, -1, 1])) for c in views.cameras]
    assert np.array_equal(
        *view_dependence_test.errors(awake, rays, behind)
    )  # nobody else sees these points: there is nothing to compare with


def test_a_forward_facing_capture_trains_in_device_coordinates(views, tmp_path):
    """Pictures of a wall of stripes far away, from cameras side by side."""
    stripes = np.tile(np.where(np.arange(40) // 8 % 2, 230, 60).astype(np.uint8)[None, :, None], (30, 1, 3))
    write_png(tmp_path / "stripes.png", stripes)
    poses = [looking((x, 0, z), (x, 9, z)) for x in (-0.3, 0, 0.3) for z in (-0.3, 0, 0.3)]
    shots = tuple(View(Camera(40, 30, (40.0, 40.0), (20.0, 15.0), pose), tmp_path / "stripes.png") for pose in poses)
    wall = Dataset(tmp_path, "train", shots, bounds=np.tile([5.0, 50.0], (9, 1)))
    field = train(wall, replace(SETTINGS, steps=30), tmp_path / "field")
    assert field.ndc is not None and read_field(tmp_path / "field").ndc is not None
    assert next(d for d in field.about["decisions"] if d["effect"] == "NDC")["chosen"]
    assert np.isfinite(render_field(field, shots[0].camera).colour).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("random", np.frombuffer(b"{'a': (", np.uint8)),
        ("random", np.frombuffer(b"{'bit_generator': 'MT19937'}", np.uint8)),
        ("most", np.ones(5, np.float32)),
        ("reach", np.ones(3, np.float32)),
        ("samples_per_ray", np.array(np.nan)),
        ("clock", np.full(5, np.nan)),
        ("leaf_000", np.array(["text"] * 4)),
        ("decided", np.frombuffer(b"\xff\xfe", np.uint8)),
        ("mean_000", np.ones(3, np.float32)),
    ],
)
def test_a_damaged_training_state_is_a_sentence(views, tmp_path, name, value):
    settings = replace(SETTINGS, view_dependence="auto")
    trainer = Trainer(views, settings)
    state = trainer.arrays() | {"averaged": np.array(1), name: value}
    write_field(trainer.field(), tmp_path, state)
    with pytest.raises(SnergError, match=r"training state|another network"):
        train(views, settings, tmp_path, resume=True)


@pytest.mark.parametrize("far", [1e2, 1e6])
def test_a_box_that_no_camera_sees_is_refused_before_training(views, far):
    box = Box.axis_aligned([far] * 3, [far + 1] * 3)
    with pytest.raises(SnergError, match=r"No camera sees the training box, .* none of 65536 rays tried crosses it; give a box"):
        Trainer(replace(views, box=box), replace(SETTINGS, ndc="off"))
