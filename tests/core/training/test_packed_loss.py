"""The loss of packed samples and what the sampler learns from it, against the same formulas in float64, one ray at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import golden
from scenes import looking
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.model import MlpModelConfig, init_params
from snerg.core.nerf.sampling import CELLS, Domain, cell_index
from snerg.core.training.config import TrainSettings
from snerg.core.training.losses import backgrounds
from snerg.core.training.occupancy_sampler import DrawnRays, OccupancySampler, batch_loss, coarse_share
from snerg.core.training.ray_dataset import RayDataset

FAMILY = MlpModelConfig(width=12, depth=2, degrees=2)
SETTINGS = TrainSettings(family=FAMILY, view_dependence="deferred", sparsity=0.02, alpha=0.3, hardness=0.15, samples=512, steps=100)
RAYS, SAMPLES, REAL = 14, 90, 78  # of a batch: rays, places for samples, and samples
LENGTH = np.float32(0.07)


def parameters(view: str = "deferred") -> Any:
    """Random ones, with densities from nothing to a wall and a residual that is not small."""
    params = init_params(FAMILY, view, False, np.random.default_rng(2))
    params["field"][FAMILY.depth].kernel[:] *= 4
    if "view" in params:
        params["view"][5][:] = [-0.5, 0.3, -1.0]
    return params


def batch_of(**changes: Any) -> dict[str, Any]:
    """Rays with 0 to 25 samples; one is unused, three are cut, one of these in the light; the last places are filled up."""
    draw = np.random.default_rng(7)
    points = draw.uniform(-1, 1, (SAMPLES, 3)).astype(np.float32)
    ray = np.sort(draw.choice([0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12], SAMPLES)).astype(np.int32)
    ray[:20], ray[20] = 0, 1  # one long ray, and one of one sample
    ray = np.sort(ray)
    valid = np.arange(SAMPLES) < REAL
    ray[~valid] = RAYS - 1
    used = np.zeros(RAYS, bool)
    used[ray[valid]] = True
    used[4] = False
    cut = np.zeros(RAYS, bool)
    cut[[0, 1, 8]] = True
    directions = draw.normal(size=(RAYS, 3))
    target = draw.integers(0, 256, (RAYS, 4)).astype(np.uint8)
    batch = {
        "inputs": points,
        "ray": ray,
        "valid": valid,
        "directions": (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32),
        "target": target,
        "used": used,
        "cut": cut,
        "length": LENGTH,
        "count": np.float32(REAL),
        "rays": np.float32(used.sum()),
    }
    return batch | changes


def expected(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> dict[str, Any]:
    """The loss in float64: eq. 3 of each used ray, eq. 8 of each sample, w (1 - w) of each weight, the squared error of alpha."""
    view = params.get("view")
    error = sparsity = soft = opacity = 0.0
    lit, whole = np.zeros(RAYS), np.zeros(RAYS)
    for ray in range(RAYS):
        densities, values = [], []
        for i in np.flatnonzero((batch["ray"] == ray) & batch["valid"]):
            raw, value = golden.raw_mlp(settings.family, params["field"], batch["inputs"][i])
            densities.append(golden.density_of(settings.family, raw + float(batch["noise"][i]) if "noise" in batch else raw))
            values.append(value)
        sparsity += sum(np.log1p(density**2 / 0.5) for density in densities)
        depths = np.array(densities) * float(batch["length"])
        gathered, through, weights = golden.march(depths, np.array(values).reshape(len(values), -1) if values else np.zeros((0, 7)))
        before = np.concatenate([[0.0], np.cumsum(np.clip(depths, 0, 80))[:-1]]) if len(depths) else np.zeros(0)
        lit[ray], whole[ray] = (np.exp(-before) > 1e-3).sum(), depths.sum()
        if not batch["used"][ray] or (batch["cut"][ray] and through > 1e-2):
            continue
        background = batch["background"][ray] if "background" in batch else np.ones(3)
        alpha = batch["target"][ray, 3] / 255
        wanted = batch["target"][ray, :3] / 255 * alpha + (1 - alpha) * background
        error += ((golden.shown(view, gathered, through, batch["directions"][ray], background) - wanted) ** 2).mean()
        soft += (weights * (1 - weights)).sum()
        opacity += (1 - through - alpha) ** 2
    error, soft, opacity = (value / float(batch["rays"]) for value in (error, soft, opacity))
    loss = error + settings.sparsity * sparsity / REAL + settings.hardness * soft + (settings.alpha * opacity if has_alpha else 0)
    return {"loss": loss, "error": error, "lit_samples": lit, "depth": whole}


DRAW = np.random.default_rng(11)
CASES = {
    "white": ({}, {}, True),
    "random background and noise": ({}, {"background": DRAW.random((RAYS, 3), np.float32), "noise": DRAW.normal(size=SAMPLES)}, False),
    "diffuse, without hardness": ({"hardness": 0.0, "view_dependence": "diffuse"}, {}, True),
    "nothing in places": ({"family": replace(FAMILY, density="relu")}, {"length": np.float32(0.0015)}, True),
}


@pytest.mark.hard_case(8, 18, 20, 23, 43)
@pytest.mark.parametrize("case", CASES)
def test_the_packed_loss_is_that_of_float64(case):
    changed, arrays, has_alpha = CASES[case]
    settings = replace(SETTINGS, **changed)
    params, batch = parameters(settings.view_dependence), batch_of(**arrays)
    found, told = jax.jit(lambda p, b: batch_loss(settings, has_alpha, p, b))(params, batch)
    truth = expected(settings, has_alpha, params, batch)
    assert float(found) == pytest.approx(truth["loss"], rel=2e-6) and float(told["error"]) == pytest.approx(truth["error"], rel=2e-6)
    assert np.asarray(told["lit_samples"]).tolist() == truth["lit_samples"].tolist()  # also of the last ray, whose places are filled up
    assert np.allclose(told["depth"], truth["depth"], rtol=2e-6)
    through = np.exp(-truth["depth"][batch["used"]])
    if case == "nothing in places":
        assert ((through > 254 / 255) & (through < 1)).any() and ((through > 0.5) & (through < 254 / 255)).any()
    else:
        assert (truth["lit_samples"] < np.bincount(batch["ray"][:REAL], minlength=RAYS)).any(), "no ray ends in the dark"


@pytest.mark.hard_case(20, 22)
def test_the_gradient_of_the_packed_loss_is_the_slope_of_float64():
    """Of every kind of array, by central differences of the float64 loss: no part of the loss is held still."""
    params, batch = parameters(), batch_of()
    slope = jax.jit(jax.grad(lambda p: batch_loss(SETTINGS, True, p, batch)[0]))(params)
    leaves, tree = jax.tree.flatten(params)
    for number, (leaf, found) in enumerate(zip(leaves, jax.tree.leaves(slope), strict=True)):
        place = np.unravel_index(np.argmax(np.abs(found)), leaf.shape)
        ends = []
        for step in (1e-5, -1e-5):
            moved = leaf.astype(np.float64)
            moved[place] += step
            ends.append(expected(SETTINGS, True, jax.tree.unflatten(tree, [*leaves[:number], moved, *leaves[number + 1 :]]), batch)["loss"])
        assert float(found[place]) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=2e-3, abs=1e-6), number


def sampler_of(settings: TrainSettings = SETTINGS, alive: np.ndarray | None = None, near: float = 0.0) -> OccupancySampler:
    cameras = [Camera(12, 12, (15.0, 15.0), (6.0, 6.0), looking(eye, (0, 0, 0)), near=near) for eye in ((2.4, 0, 0.8), (0, -2.4, 0.5))]
    pool = RayDataset([np.full((12, 12, 4), (200, 100, 50, 51), np.uint8)] * 2, cameras, Domain.around(np.full(3, -0.8), np.full(3, 0.8)))
    alive = np.ones(CELLS**3, bool) if alive is None else alive
    return OccupancySampler(settings, pool, pool.domain, alive, np.random.default_rng(settings.seed))


def test_a_batch_holds_whole_rays_and_what_fills_it_up_counts_nothing():
    """Rays that do not fit are left out whole; the last ray is nobody's, and it is where the filling points."""
    settings = replace(SETTINGS, samples=512, spacing=2 / 64, steps=5 * 1200)
    scheme = sampler_of(settings)
    for _ in range(6):
        batch = scheme.batch(None, 1.0)
        arrays = batch.arrays
        count, most = batch.samples, scheme.most_rays
        assert arrays["valid"].tolist() == [True] * count + [False] * (512 - count) and arrays["count"] == count > 300
        assert (arrays["ray"][count:] == most - 1).all() and not arrays["used"][most - 1]
        assert set(np.flatnonzero(arrays["used"])) == set(arrays["ray"][:count]) and arrays["rays"] == batch.rays == arrays["used"].sum()
        assert arrays["length"] == np.float32(2 / 64)
        points, ray = arrays["inputs"][:count], arrays["ray"][:count]
        gaps = np.linalg.norm(np.diff(points, axis=0), axis=-1)[np.diff(ray) == 0]
        assert np.abs(gaps - 2 / 64).max() < 1e-5
        ends = points[np.flatnonzero(np.diff(ray, append=-1))]
        assert (np.abs(ends).max(axis=-1) > 1 - 2 / 64 - 1e-5).all(), "a ray ends before it leaves the domain"


def test_the_first_sample_of_a_ray_lies_anywhere_in_its_interval():
    """The jitter is uniform, each ray's own, and another in each batch."""
    scheme = sampler_of(replace(SETTINGS, samples=8192, spacing=2 / 64, steps=5 * 1200))
    places = []
    for _ in range(3):
        arrays = scheme.batch(None, 1.0).arrays
        drawn = scheme.drawn
        first = np.flatnonzero(np.diff(drawn.ray, prepend=-1))
        points, along = np.asarray(arrays["inputs"], np.float64)[first], arrays["directions"][drawn.ray[first]].astype(np.float64)
        with np.errstate(divide="ignore"):
            behind = np.where(along > 0, points + 1, 1 - points) / np.abs(along)  # distances back to the walls
        places.append(behind.min(axis=-1) * 32)
    for place in places:
        assert np.abs(np.histogram(place, 4, (0, 1))[0] / len(place) - 0.25).max() < 0.09 and place.min() > -1e-3 and place.max() < 1 + 1e-3
    least = min(map(len, places))
    assert abs(np.corrcoef(places[0][:least], places[1][:least])[0, 1]) < 0.2


@pytest.mark.parametrize(("minutes", "fraction", "factor"), [(1, 0.0, 8), (1, 0.11, 4), (1, 0.26, 2), (1, 0.61, 1), (1, 1.0, 1)])
def test_spacings_are_coarse_at_first(minutes, fraction, factor):
    scheme = sampler_of(replace(SETTINGS, steps=1200 * minutes))
    assert scheme.spacing(fraction) == pytest.approx(factor * SETTINGS.spacing)


def test_long_trainings_are_coarse_for_a_smaller_share():
    assert coarse_share(replace(SETTINGS, steps=1200)) == 1 and coarse_share(replace(SETTINGS, steps=600)) == 1
    assert coarse_share(replace(SETTINGS, steps=12000)) == pytest.approx(10**-0.4)
    assert coarse_share(replace(SETTINGS, steps=None, seconds=600.0)) == pytest.approx(10**-0.4)


def test_the_occupancy_is_updated_and_pruned_at_its_steps():
    """Measured at steps 16, 32 and every 64; emptied from step 256 on, where an interval's opacity is at most 0.01."""
    alive = np.zeros(CELLS**3, bool)
    alive[5000:7000] = True
    settings = replace(SETTINGS, spacing=0.01)
    scheme = sampler_of(settings, alive)
    edge = np.float32(0.01 / 0.01)
    level = {"now": edge}
    scheme.density = lambda params, x: np.where(np.arange(len(x)) % 2 == 0, level["now"], np.float32(3)).astype(np.float32)
    scheme._learn_termination = lambda aux: None
    measured = []
    for step in range(1, 260):
        before = scheme.occupancy.most.copy()
        level["now"] = edge if step < 200 else np.nextafter(edge, np.float32(0))
        scheme.learn(None, step, {})
        if not np.array_equal(before, scheme.occupancy.most):
            measured.append(step)
        assert scheme.occupied.sum() == (2000 if step < 256 else 1000)
    assert measured[0] == 16 and measured[-1] == 256 and not set(measured) - {16, 32, 64, 128, 192, 256}


def test_a_cell_exactly_at_the_threshold_is_emptied():
    scheme = sampler_of(replace(SETTINGS, spacing=0.5), np.arange(CELLS**3) < 3)
    scheme.occupancy.most[:3] = np.float32([0.02, np.nextafter(np.float32(0.02), np.float32(1)), np.inf])
    scheme.occupancy.prune(np.float32(0.01 / 0.5))
    assert scheme.occupancy.cells.tolist() == [1, 2] and scheme.occupancy.most[0] == 0


def test_termination_is_learnt_from_the_last_lit_sample():
    """Past a depth of -log(1e-3) the ray ended at its last lit sample; else it did not end. Cut before its first sample: look again."""
    scheme = sampler_of()
    scheme.termination.depths[:] = 5
    ray = np.repeat([0, 2, 3], [4, 3, 2])
    distance = np.arange(9, dtype=np.float32)
    scheme.drawn = DrawnRays(np.array([10, 11, 12, 13]), np.array([False, True, False, False]), ray, distance)
    lit, depth = np.zeros(20, np.float32), np.zeros(20, np.float32)
    lit[[0, 2, 3]], depth[[0, 2, 3]] = [3, 2, 0], [6.908, 6.907, 50]
    scheme._learn_termination({"lit_samples": lit, "depth": depth})
    found = scheme.termination.depths
    assert found[10] == pytest.approx(0.75 * 5 + 0.25 * 2)  # sample 2 of the first ray is its last in the light
    assert np.isinf(found[11]) and np.isinf(found[12])
    assert found[13] == 7  # not even its first sample is lit: it counts; and farther than known is believed at once


def test_rays_end_two_samples_behind_their_tiles_termination():
    scheme = sampler_of(replace(SETTINGS, samples=4096, spacing=2 / 64, steps=5 * 1200))
    scheme.termination.depths[:] = 3
    arrays = scheme.batch(None, 1.0).arrays
    farthest = np.array([scheme.drawn.distance[scheme.drawn.ray == r].max() for r in np.unique(scheme.drawn.ray)])
    assert 3 + 1 / 32 < farthest.max() < 3 + 2 / 32 and arrays["cut"].any()


def test_noise_and_backgrounds_are_drawn_where_asked_for():
    arrays = sampler_of(replace(SETTINGS, density_noise=2.0, background="random", samples=8192)).batch(None, 0.0).arrays
    assert arrays["noise"].std() == pytest.approx(2, rel=0.05) and abs(arrays["noise"].mean()) < 0.1
    assert arrays["background"].min() < 0.02 and arrays["background"].max() > 0.98 and abs(arrays["background"].mean() - 0.5) < 0.05
    assert not {"noise", "background"} & sampler_of().batch(None, 0.0).arrays.keys()


def test_another_seed_draws_other_rays_and_the_same_one_the_same():
    one, two, three = (sampler_of(replace(SETTINGS, seed=seed)).batch(None, 0.0).arrays for seed in (1, 1, 2))
    assert all(np.array_equal(one[name], two[name]) for name in one)
    assert not np.array_equal(one["inputs"], three["inputs"])
    assert (cell_index(one["inputs"]) < CELLS**3).all() and jnp.isfinite(one["inputs"]).all()


def test_plain_backgrounds_are_their_colours():
    for name, colour in (("white", (1, 1, 1)), ("black", (0, 0, 0)), ("#204060", (0x20 / 255, 0x40 / 255, 0x60 / 255))):
        assert backgrounds(name, 3, np.random.default_rng(0)) == pytest.approx(np.tile(np.float32(colour), (3, 1)))
    drawn = backgrounds("random", 1000, np.random.default_rng(0))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 0.1, "greys alone"


def test_rays_end_two_samples_behind_coarse_terminations():
    scheme = sampler_of(replace(SETTINGS, samples=4096, spacing=2 / 256, steps=1200))
    scheme.termination.depths[:] = 3
    assert scheme.batch(None, 0.0).arrays["cut"].any()
    farthest = np.array([scheme.drawn.distance[scheme.drawn.ray == r].max() for r in np.unique(scheme.drawn.ray)])
    assert 3 + 1 / 16 < farthest.max() < 3 + 2 / 16  # the spacing is 8 times the final one


def test_long_trainings_scale_their_spacings():
    scheme = sampler_of(replace(SETTINGS, steps=12000))
    assert scheme.spacing(0.6 * 10**-0.4 - 1e-6) == 2 * SETTINGS.spacing and scheme.spacing(0.6 * 10**-0.4 + 1e-6) == SETTINGS.spacing
