"""Samples that the device packs, against those that the host packs for the same rays."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, init_params
from snerg.core.nerf.sampling import CELLS, Domain, Samples, count_steps, pack_samples
from snerg.core.training.config import TrainSettings
from snerg.core.training.config_values import with_values
from snerg.core.training.device_sampler import CANDIDATES, DeviceSampler, Packed, pack_on_device, packs_on_device, steps_at_once
from snerg.core.training.occupancy_sampler import OccupancySampler
from snerg.core.training.ray_dataset import RayDataset

SETTINGS = TrainSettings(
    family=MlpModelConfig(width=12, depth=2, degrees=3),
    view_dependence="deferred",
    samples=2048,
    spacing=2 / 64,
    packing="device",
    seconds=None,
    steps=64,
)
DOMAIN = Domain(np.zeros(3), 1.0, np.array([-1.0, -0.75, -0.5]), np.array([1.0, 0.75, 0.5]))
LENGTH = 1 / 32


def patches(seed: int) -> np.ndarray:
    """Occupied cells in cubes of 8 cells."""
    coarse = np.random.default_rng(seed).random((CELLS // 8,) * 3) < 0.4
    return coarse.repeat(8, 0).repeat(8, 1).repeat(8, 2).reshape(-1)


def rays_of(seed: int, count: int = 200) -> dict[str, Any]:
    """Rays that cross the box at any angle, along its axes and faces, past it, from within, and that are cut."""
    draw = np.random.default_rng(seed)
    origins, directions = draw.normal(0, 1.5, (count, 3)), draw.normal(size=(count, 3))
    directions[: count // 2] = draw.uniform(-0.5, 0.5, (count // 2, 3)) - origins[: count // 2]
    for i, axis in enumerate((0, 1, 2) * 6):
        directions[i] = 0
        directions[i, axis] = (-1) ** i
        origins[i] = draw.uniform(-0.5, 0.5, 3) if i < 12 else np.array([-1.0, 0.75, 0.5])  # on its edges: hard case 31
        origins[i, axis] = -3.0 * (-1) ** i
    origins[18] = [0, 2, 0]
    directions[18] = [1, 0, 0]  # beside the box
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return {
        "origins": origins,
        "directions": directions,
        "offset": draw.random(count),
        "near": np.where(draw.random(count) < 0.3, 1.0, 0.0),
        "far": np.where(draw.random(count) < 0.2, 2.5, np.inf),
        "until": np.where(draw.random(count) < 0.2, 1.7, np.inf),
    }


def on_both(rays: dict[str, Any], occupied: np.ndarray, size: int = 16384, length: float = LENGTH) -> tuple[Samples, Packed]:
    host = pack_samples(DOMAIN, occupied, length=length, **rays)
    limits = (rays[name] for name in ("near", "far", "until"))
    enter, counts, cut = count_steps(DOMAIN, rays["origins"], rays["directions"], length, rays["offset"], *limits)
    assert np.array_equal(cut, host.cut)
    single = (a.astype(np.float32) for a in (rays["origins"], rays["directions"], enter + rays["offset"] * length))
    packing = jax.jit(pack_on_device, static_argnums=(6, 7))
    packed = packing(occupied, *single, counts.astype(np.int32), np.float32(length), size, 32768)
    return host, Packed(*map(np.asarray, packed))


def steps_of(ray: np.ndarray, distance: np.ndarray, rays: dict[str, Any]) -> list[tuple[int, int]]:
    """(ray, step along it) of samples."""
    limits = (rays[name] for name in ("near", "far", "until"))
    start = count_steps(DOMAIN, rays["origins"], rays["directions"], LENGTH, rays["offset"], *limits)[0] + rays["offset"] * LENGTH
    return list(zip(ray.tolist(), np.round((distance - start[ray]) / LENGTH).astype(int).tolist(), strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_the_device_packs_the_samples_of_the_host_in_their_order(seed):
    """Those within float32's rounding of a cell's border may fall on either side of it."""
    rays = rays_of(seed)
    host, device = on_both(rays, patches(seed))
    count = int(device.valid.sum())
    ours, theirs = (
        steps_of(ray, distance, rays) for ray, distance in ((host.ray, host.distance), (device.ray[:count], device.distance[:count]))
    )
    assert theirs == sorted(theirs) and ours == sorted(ours) and len(ours) > 1300
    both = set(ours) & set(theirs)
    cell = (host.points[[pair not in both for pair in ours]] + 1) * CELLS / 2
    assert (np.abs(cell - np.round(cell)).min(axis=-1, initial=1) < 1e-3).all() and len(set(theirs) - both) <= 3 >= len(set(ours) - both)
    pairs = [([pair in both for pair in found]) for found in (ours, theirs)]
    assert np.abs(host.points[pairs[0]] - device.points[:count][pairs[1]]).max() < 2e-6
    assert np.abs(host.distance[pairs[0]] - device.distance[:count][pairs[1]]).max() < 2e-6
    assert device.valid.tolist() == [True] * count + [False] * (16384 - count) and (device.ray[count:] == len(device.kept) - 1).all()
    assert not device.points[count:].any() and np.array_equal(device.kept, np.bincount(device.ray[:count], minlength=200))
    assert np.array_equal(device.found, device.kept)


def along_axes() -> dict[str, Any]:
    """Rays along the axes whose samples are exact in float32."""
    count = 48
    draw = np.random.default_rng(5)
    origins = draw.integers(-31, 32, (count, 3)) / 64 + 1 / 256
    directions = np.zeros((count, 3))
    for i in range(count):
        directions[i, i % 3] = 1 if i % 2 else -1
        origins[i, i % 3] = -2 * directions[i, i % 3]
    plain = {"near": np.zeros(count), "far": np.full(count, np.inf), "until": np.full(count, np.inf)}
    return {"origins": origins, "directions": directions, "offset": np.full(count, 0.25), **plain}


@pytest.mark.parametrize("size", [16384, 700, 333, 20, 1])
def test_rays_along_the_axes_are_exact_and_what_does_not_fit_is_left_out_by_the_ray(size):
    host, device = on_both(along_axes(), patches(1), size)
    total = len(host.ray)
    count = total if total <= size else int(np.searchsorted(host.ray, host.ray[size]))  # as OccupancySampler.batch
    assert total > 700 and device.valid.tolist() == [True] * count + [False] * (size - count)
    assert np.array_equal(device.ray[:count], host.ray[:count]) and np.array_equal(device.distance[:count], host.distance[:count])
    assert np.array_equal(device.points[:count], host.points[:count])
    found = np.bincount(host.ray, minlength=48)
    assert np.array_equal(device.found, found) and np.array_equal(device.kept, np.where(np.cumsum(found) <= size, found, 0))


@pytest.mark.parametrize("occupied", [np.zeros(CELLS**3, bool), np.ones(CELLS**3, bool)])
def test_nothing_and_everything_is_occupied(occupied):
    rays = rays_of(3)
    host, device = on_both(rays, occupied)
    count = len(host.ray)
    assert (count > 3000) == occupied.all() and device.valid.sum() == count and np.array_equal(device.ray[:count], host.ray)
    assert np.abs(device.points[:count] - host.points).max(initial=0) < 2e-6


def test_rays_that_all_miss_have_no_samples():
    rays = {name: value[18:19].repeat(5, axis=0) for name, value in rays_of(0).items()}
    host, device = on_both(rays, np.ones(CELLS**3, bool))
    assert not len(host.ray) and not device.valid.any() and not device.found.any()


def samplers(settings: TrainSettings, alive: np.ndarray | None = None) -> tuple[OccupancySampler, DeviceSampler]:
    """One that packs on the host, and one on the device, that draw the same rays in a step at the final spacing."""
    draw = np.random.default_rng(1)
    cameras = [Camera(12, 12, (15.0, 15.0), (6.0, 6.0), looking(eye, (0, 0, 0))) for eye in ((2.4, 0, 0.8), (0, -2.4, 0.5))]
    images = draw.integers(0, 256, (2, 12, 12, 4), np.uint8)
    pool = RayDataset(list(images), cameras, Domain.around(np.full(3, -0.8), np.full(3, 0.8)))
    pool.diffuse = draw.integers(0, 256, (288, 3), np.uint8) if settings.diffuse else None
    alive = np.ones(CELLS**3, bool) if alive is None else alive
    host, device = (kind(settings, pool, pool.domain, alive, np.random.default_rng(4)) for kind in (OccupancySampler, DeviceSampler))
    return host, device


def test_the_loss_and_what_is_learned_of_it_are_those_of_the_host():
    """Samples overflow, and some rays are cut before their first sample: these forget their termination depth."""
    settings = replace(SETTINGS, samples=700, background="random", density_noise=0.5, view_dependence="diffuse", diffuse=0.5)
    alive = np.ones((CELLS,) * 3, bool)
    alive[CELLS // 4 :] = False  # far from the first camera
    host, device = samplers(settings, alive.reshape(-1))
    told = []
    for sampler in (host, device):
        sampler.samples_per_ray = 4.0
        sampler.termination.depths[:144] = np.where(np.arange(144) % 2, 1.8, 2.9)
        batch = sampler.batch(None, 1.0)
        loss, aux = jax.jit(sampler.loss)(params_of(settings), batch.arrays)
        told.append((float(loss), float(aux["error"])))
        sampler.learn(None, 1, jax.tree.map(np.asarray, aux))
    assert told[1] == pytest.approx(told[0], rel=1e-5)
    ours, theirs = host.termination.depths, device.termination.depths
    assert np.allclose(ours, theirs, rtol=1e-6) and np.isinf(theirs[:144]).any() and np.isfinite(theirs[:144]).any()
    assert device.samples_per_ray == pytest.approx(host.samples_per_ray, rel=1e-12)
    assert device.overflow[0] == batch.rays and device.overflow[1] > 0 and device.remark() is not None


def params_of(settings: TrainSettings) -> Any:
    """Random parameters, with densities that absorb much of the light."""
    params = init_params(settings.family, settings.view_dependence, False, np.random.default_rng(2))
    params["field"][2].kernel[:] *= 4
    return params


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"background": "random", "density_noise": 0.5},
        {"view_dependence": "sample"},
        {"samples": 700},
        {"family": HashModelConfig(HashGrid(levels=3, coarsest=8, finest=32, features=2, log2_size=12), width=16)},
    ],
    ids=["plain", "background and noise", "per sample", "overflow", "hash grid"],
)
def test_the_gradient_of_a_step_is_that_of_the_host(changed):
    settings = replace(SETTINGS, **changed)
    params = init_params(settings.family, settings.view_dependence, False, np.random.default_rng(2))
    results = []
    for sampler in samplers(settings):
        sampler.samples_per_ray = 12.0  # so that samples of 700 overflow
        batch = sampler.batch(None, 1.0)
        results.append(jax.jit(jax.value_and_grad(sampler.loss, has_aux=True))(params, batch.arrays))
    ((ours, _), slope), ((theirs, aux), gradient) = results
    assert float(theirs) == pytest.approx(float(ours), rel=1e-5) and int(aux["samples"]) > 600
    for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(gradient), strict=True):
        assert np.abs(a - b).max() <= 2e-5 * np.abs(a).max()


def test_the_number_of_rays_follows_the_spacing():
    device = samplers(replace(SETTINGS, samples=8192, steps=1200))[1]
    device.samples_per_ray = 32.0
    assert [device.batches(f, 2, 4).rays for f in (0.0, 0.2, 0.5, 1.0)] == [2 * 2047, 2 * 1024, 2 * 512, 2 * 256]
    assert device.batches(0.0, 1, 1).arrays["length"] == np.float32(8 * SETTINGS.spacing)


def test_rays_that_have_more_steps_than_places_are_dropped_whole_and_counted():
    device = samplers(replace(SETTINGS, samples=2048))[1]
    device.candidates, device.samples_per_ray = 500, 8.0
    arrays = device.batches(1.0, 3, 4).arrays
    assert arrays["steps"].shape == (4, device.most_rays) and (arrays["steps"].sum(axis=1)[:3] <= 500).all()
    assert (arrays["steps"].sum(axis=1)[:3] > 400).all() and not arrays["steps"][3].any()
    assert (~device.drawn_rays.fits).sum() > 300 and not (
        arrays["cut"][:3, : device.drawn_rays.cut.shape[1]] & ~device.drawn_rays.fits
    ).any()


def test_an_empty_field_is_a_sentence():
    device = samplers(SETTINGS, np.zeros(CELLS**3, bool))[1]
    with pytest.raises(SnergError, match="has become empty everywhere"):
        device.batches(1.0, 2, 2)


@pytest.mark.parametrize(("samples", "cpu", "gpu"), [(256, 16, 16), (8192, 16, 16), (32768, 4, 16), (2**18, 1, 4), (2**24, 1, 1)])
def test_a_dispatch_has_few_samples_so_that_training_stops_soon(samples, cpu, gpu):
    assert (steps_at_once(samples, "cpu"), steps_at_once(samples, "gpu")) == (cpu, gpu)
    assert steps_at_once(samples + samples // 3, "cpu") in (1, 2, 4, 8, 16)


def test_one_gpu_packs_and_other_devices_only_where_they_are_told_to(monkeypatch):
    plain, hierarchical = replace(SETTINGS, packing="auto"), replace(SETTINGS, packing="auto", sampler="hierarchical")
    assert not packs_on_device(plain) and packs_on_device(SETTINGS) and CANDIDATES > 1
    for count, expected in ((1, True), (2, False)):
        monkeypatch.setattr(jax, "devices", lambda count=count: [SimpleNamespace(platform="gpu")] * count)
        assert packs_on_device(plain) is expected and not packs_on_device(hierarchical)
        assert not packs_on_device(replace(SETTINGS, packing="host"))
    with pytest.raises(SnergError, match="JAX finds 2; set packing to auto or host"):
        packs_on_device(SETTINGS)


def test_packing_is_a_setting():
    assert with_values(replace(SETTINGS, packing="auto"), {"packing": "device"}).packing == "device"
    with pytest.raises(SnergError, match="must be one of auto, host, device"):
        replace(SETTINGS, packing="gpu")
    with pytest.raises(SnergError, match="packing is only for the packed sampler; set packing to auto"):
        replace(SETTINGS, sampler="hierarchical")


def test_the_state_of_the_sampler_comes_back_also_from_the_hosts():
    host, device = samplers(SETTINGS)
    device.overflow[:] = 70, 3
    other = samplers(SETTINGS)[1]
    other.restore(device.state())
    assert other.overflow.tolist() == [70, 3] and other.remark().startswith("4.3 % of the rays were drawn and not used")
    other.restore(host.state())
    assert other.overflow.tolist() == [0, 0] and jnp.isinf(other.occupancy.most).all()
    with pytest.raises(ValueError, match="overflow"):
        other.restore(device.state() | {"overflow": np.ones(3)})
