"""The optimiser of fitted voxels against one in float64: gradients, moments, both rates, small gradients, bounds, and when it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import random_network, snerg_from_volume
from snerg.core.baking.fit_batches import Batch, Neighbourhoods, Voxels, batches
from snerg.core.errors import SnergError
from snerg.core.scene.scene import Scene
from snerg.tests.core.baking.test_fit_numbers import given, plain_weights

jax = pytest.importorskip("jax")
jnp = jax.numpy

from snerg.core.baking.fit_voxels import FitSettings, Fitted, _Fit, _step  # noqa: E402 it wants JAX

BLACK, GREY = (0.0, 0.0, 0.0), (0.3, 0.5, 0.8)
TINY = 1e-30  # of a complex step, which is exact to float64's rounding


def sigmoid(x: NDArray) -> NDArray:
    return 1 / (1 + np.exp(-x))


def plain_loss(values: NDArray, network, batch: Batch, background: tuple[float, ...]) -> NDArray:
    """The loss of a batch [...], of straight values [..., n, C] and a network's arrays [..., i, o], real or complex."""
    values, total, rays = np.asarray(values), 0.0, int(batch.used.sum())
    for ray in range(rays):
        light, seen = 1.0, 0.0
        for row in np.flatnonzero((batch.ray == ray) & (batch.valid > 0)):
            corners = values[..., batch.corners[row], :]
            weights, alpha = plain_weights(batch.fraction[row]), corners[..., -1]
            seen = seen + np.asarray(light)[..., None] * np.einsum("k,...k,...kc->...c", weights, alpha, corners[..., :-1])
            opacity = alpha @ weights
            light = light * (1 - np.where(opacity.real > 0.9999, 0.9999, opacity))
        light = np.asarray(light)[..., None]
        colour = seen[..., :3] + light * np.array(background)
        if network is not None:
            d = batch.view_directions[ray].astype(np.float64)
            known = np.concatenate([d, *[f(2.0**k * d) for f in (np.sin, np.cos) for k in range(4)]])
            shown = np.concatenate([seen[..., :3] + light, seen[..., 3:]], axis=-1)
            x = np.concatenate([np.broadcast_to(known, (*shown.shape[:-1], len(known))), shown], axis=-1)
            for weights, bias in (network[0:2], network[2:4], network[4:6]):
                x = (x[..., None, :] @ weights)[..., 0, :] + bias
                x = np.where(x.real > 0, x, 0) if weights.shape[-1] == 16 else sigmoid(x)
            colour = colour + x
        pixel = batch.pixels[ray] / 255
        total = total + ((colour - pixel[:3] * pixel[3] - (1 - pixel[3]) * np.array(background)) ** 2).sum(axis=-1)
    return total / (3 * rays)


def slopes(values: NDArray, network, batch: Batch, background: tuple[float, ...]) -> list[NDArray]:
    """The gradients of the loss by the values and by each of the network's arrays: by complex steps, a formula of none of them."""
    arrays = [values, *(() if network is None else network)]
    found = []
    for i, array in enumerate(arrays):
        steps = 1j * TINY * np.eye(array.size).reshape(-1, *array.shape)
        moved = [other + steps if j == i else other for j, other in enumerate(arrays)]
        found.append((plain_loss(moved[0], moved[1:] or None, batch, background).imag / TINY).reshape(array.shape))
    return found


class PlainAdam:
    """Adam (Kingma and Ba, 2015, with the order of computation of section 2) in float64; an entry whose gradient is 1e-9 or less rests."""

    def __init__(self, arrays: list[NDArray]) -> None:
        self.now = [np.array(array, np.float64) for array in arrays]
        self.first, self.second = ([np.zeros(array.shape) for array in arrays] for _ in range(2))
        self.clear = [np.ones(array.shape, bool) for array in arrays]  # entries whose gradients single precision knows

    def step(self, gradients: list[NDArray], number: int, rates: list[float]) -> None:
        for now, m, v, clear, g, rate in zip(self.now, self.first, self.second, self.clear, gradients, rates, strict=True):
            moves = np.abs(g) > 1e-9
            m[moves], v[moves] = (0.9 * m + 0.1 * g)[moves], (0.99 * v + 0.01 * g**2)[moves]
            length = rate * np.sqrt(1 - 0.99**number) / (1 - 0.9**number)
            now[moves] -= (length * m / (np.sqrt(v) + 1e-9))[moves]
            clear &= (np.abs(g) > 1e-5) | (g == 0)
        np.clip(self.now[0], 0, 1, out=self.now[0])


def start(lengths: list[int], network, seed: int = 5, size: int = 8) -> tuple[Voxels, Batch, NDArray]:
    """The voxels of rays, a batch, and values of these voxels that no bound of [0, 1] is near to."""
    channels, draw = (4 if network is None else 8), np.random.default_rng(seed)
    values = np.full((30, 30, 30, channels), 90, np.uint8)
    scene = snerg_from_volume(values, network, grid_to_world=np.eye(4), voxel_size=0.1)
    samples = given(lengths, draw.integers(2000, 30000, sum(lengths)), seed)
    voxels = Voxels.of(scene, samples)
    values = np.zeros((len(voxels.stored), channels), np.float32)
    values[: len(voxels.rows)] = draw.uniform(0.25, 0.75, (len(voxels.rows), channels))
    return voxels, next(batches(samples, np.arange(len(lengths)), size, voxels)), values


def run(values: NDArray, network, batch: Batch, rates: list[tuple[float, float]], background: tuple[float, ...]):
    """Steps of the real optimiser: what is fitted, and the moments."""
    rows, places = Neighbourhoods(len(values))(batch.corners)
    fitted = Fitted(jnp.asarray(values), None if network is None else type(network)(*map(jnp.asarray, network)))
    moments = jax.tree.map(jnp.zeros_like, (fitted, fitted))
    for number, rate in enumerate(rates, 1):
        fitted, moments = _step(fitted, moments, float(number), rate, rows, batch._replace(corners=places), background, False)
    return jax.tree.map(np.asarray, (fitted, *moments))


def compact(batch: Batch, voxels: Voxels) -> tuple[NDArray, Batch]:
    """The numbers of the voxels that a batch needs, and the batch with its corners numbered among them; the last stands for no voxel."""
    needed = np.append(np.setdiff1d(batch.corners, len(voxels.stored) - 1), len(voxels.stored) - 1)
    return needed, batch._replace(corners=np.searchsorted(needed, batch.corners))


def test_steps_of_voxels_and_network_are_adams_of_float64() -> None:
    """Three steps at rates that fall, of two groups: values, first and second moments."""
    network, rates = random_network(3), [(0.02, 0.003), (0.015, 0.002), (0.01, 0.0015)]
    voxels, batch, values = start([2, 1], network)
    needed, small = compact(batch, voxels)
    adam = PlainAdam([values[needed], *network])
    for number, (rate, network_rate) in enumerate(rates, 1):
        gradients = slopes(adam.now[0], adam.now[1:], small, GREY)
        gradients[0][-1] = 0
        adam.step(gradients, number, [rate, *[network_rate] * 6])
    fitted, first, second = run(values, network, batch, rates, GREY)
    for i, clear in enumerate(adam.clear):
        now, m, v = ((whole.voxels[needed], *whole.network)[i] for whole in (fitted, first, second))
        assert np.abs(now - adam.now[i])[clear].max() < 3e-5, f"array {i}"
        assert m[clear] == pytest.approx(adam.first[i][clear], rel=3e-3, abs=1e-8)
        assert v[clear] == pytest.approx(adam.second[i][clear], rel=3e-3, abs=1e-12)
    assert adam.clear[0].mean() > 0.7 and adam.clear[1].mean() > 0.3


def test_voxels_with_gradients_of_rounding_rest_and_small_ones_move_less() -> None:
    """Behind matter that passes 1e-6 and 1e-8 of the light: gradients on both sides of 1e-9."""
    voxels, batch, values = start([4], None)
    batch.fraction[:4] = (30, 100, 200)
    batch.pixels[0] = (255, 255, 255, 255)
    for row, opacity in enumerate((1.0, 0.99, 0.5, 0.5)):
        values[batch.corners[row], 3] = opacity
    values[batch.corners[3], :3] = 0.5
    values[batch.corners[2], 3] = 0.99  # behind the third sample 1e-8 is left
    needed, small = compact(batch, voxels)
    adam, slope = PlainAdam([values[needed]]), slopes(values[needed].astype(np.float64), None, small, BLACK)
    adam.step(slope, 1, [0.02])
    fitted, *_ = run(values, None, batch, [(0.02, 0.0)], BLACK)
    colours = np.abs(slope[0][:-1, :3])
    assert (colours < 8e-10).sum() > 20 and ((colours > 1.2e-9) & (colours < 4e-8)).sum() > 10
    far = (colours < 8e-10) | (colours > 1.2e-9)  # from the bound itself
    moved = np.abs(fitted.voxels[needed] - values[needed])[:-1, :3]
    expected = np.abs(adam.now[0] - values[needed])[:-1, :3]
    assert np.abs(moved - expected)[far].max() < 2e-5 and not moved[colours < 8e-10].any()


@pytest.mark.hard_case(59)
def test_values_end_at_both_bounds_and_the_empty_voxel_stays_empty() -> None:
    voxels, batch, values = start([2, 2], None)
    count = len(voxels.rows)
    for pixel, edge, bound in ((255, 0.99, 1.0), (0, 0.01, 0.0)):
        batch.pixels[:] = (pixel, pixel, pixel, 255)
        values[:count, :3] = edge
        fitted, first, _ = run(values, None, batch, [(0.1, 0.0)], BLACK)
        steep = np.abs(first.voxels[:count, :3]) > 1e-6
        assert steep.any() and (fitted.voxels[:count, :3][steep] == bound).all()
        assert not fitted.voxels[-1].any() and not first.voxels[-1].any()


def small_fit(settings: FitSettings, kind: type[_Fit] = _Fit, network=None) -> _Fit:
    """A fit of 20 rays of four samples: three batches a pass, where batches have eight rays."""
    channels, draw = (4 if network is None else 8), np.random.default_rng(8)
    scene: Scene = snerg_from_volume(np.full((30, 30, 30, channels), 90, np.uint8), network, grid_to_world=np.eye(4), voxel_size=0.1)
    training, validation = (given([4] * 20, draw.integers(2000, 30000, 80), seed) for seed in (1, 2))
    return kind(scene, training, validation, settings, lambda fraction, text: None)


SETTINGS = FitSettings(batch=8, rate=0.02, network_rate=0.002, passes=2, evaluations=3, background=GREY)


def plain_gradient(values: NDArray, batch: Batch, background: tuple[float, ...]) -> NDArray:
    """Of the loss by straight values [P, 4], by hand: colours behind a sample are dimmed by it."""
    gradient, rays = np.zeros(values.shape), int(batch.used.sum())
    for ray in range(rays):
        rows = np.flatnonzero((batch.ray == ray) & (batch.valid > 0))
        weights = [plain_weights(batch.fraction[row]) for row in rows]
        corners = [values[batch.corners[row]] for row in rows]
        opacity = np.array([w @ c[:, 3] for w, c in zip(weights, corners, strict=True)])
        seen = np.array([(w * c[:, 3]) @ c[:, :3] for w, c in zip(weights, corners, strict=True)])
        before = np.concatenate([[1], np.cumprod(1 - opacity)])
        parts = np.concatenate([before[:-1, None] * seen, before[-1] * np.array(background)[None]])
        pixel = batch.pixels[ray] / 255
        off = 2 * (parts.sum(axis=0) - pixel[:3] * pixel[3] - (1 - pixel[3]) * np.array(background)) / (3 * rays)
        for i, row in enumerate(rows):
            hidden = parts[i + 1 :].sum(axis=0) / (1 - opacity[i])
            colours = (weights[i] * corners[i][:, 3])[:, None] * before[i] * off
            alphas = weights[i] * ((before[i] * corners[i][:, :3] - hidden) @ off)
            np.add.at(gradient, batch.corners[row], np.concatenate([colours, alphas[:, None]], axis=1))
    gradient[-1] = 0
    return gradient


def test_a_whole_fit_is_that_of_float64() -> None:
    """Six steps in two passes: rates that fall to a tenth, and voxels that rest while no ray of a batch needs them."""
    fit = small_fit(SETTINGS)
    adam = PlainAdam([np.asarray(fit.fitted.voxels)])
    for number, batch in enumerate(fit.batches(), 1):
        adam.step([plain_gradient(adam.now[0], batch, GREY)], number, [0.02 * 0.1 ** (number / 6)])
    assert fit.run()["steps"] == 6
    moved = np.abs(adam.now[0] - np.asarray(small_fit(SETTINGS).fitted.voxels))
    clear = adam.clear[0] & (moved > 0)
    assert np.abs(np.asarray(fit.fitted.voxels) - adam.now[0])[clear].max() < 1e-4 and clear.sum() > 1000 and moved.max() > 0.02


def test_the_networks_rate_falls_as_that_of_voxels() -> None:
    """Where a pass has one step: the first moves each weight by the rate, and the rate is the last one."""
    network = random_network(3)
    settings = replace(SETTINGS, passes=1, rays=6)
    fit = small_fit(settings, network=network)
    assert fit.run()["steps"] == 1
    change = np.abs(np.asarray(fit.fitted.network.bias_2) - network.bias_2)
    assert change == pytest.approx(np.full(3, 0.1 * 0.002), rel=1e-3)


@pytest.mark.parametrize(("passes", "rays", "steps"), [(1, 10**9, 3), (2, 10**9, 6), (2, 20, 3), (2, 21, 4), (2, 1, 1)])
def test_a_fit_takes_no_more_than_its_passes_and_its_rays(passes: int, rays: int, steps: int) -> None:
    assert small_fit(replace(SETTINGS, passes=passes, rays=rays)).run()["steps"] == steps


def test_the_error_of_views_kept_out_is_that_of_float64() -> None:
    """Of stored bytes, a mean over rays and colours, whatever batches there are."""
    fit = small_fit(SETTINGS)
    draw = np.random.default_rng(3)
    stored = fit.voxels.stored.copy()
    stored[: len(fit.voxels.rows)] = draw.integers(1, 200, (len(fit.voxels.rows), 4))
    stored[:, :3] = np.minimum(stored[:, :3], stored[:, 3:])
    values = stored / 255.0
    straight = np.concatenate([values[:, :3] / np.maximum(values[:, 3:], 1e-9), values[:, 3:]], axis=-1)
    total = 0.0
    for batch in batches(fit.validation, np.arange(20), 8, fit.voxels):
        total += float(plain_loss(straight, None, batch, GREY)) * 3 * batch.used.sum()
    assert fit.error(stored, None) == pytest.approx(total / 60, rel=1e-5)


class Given(_Fit):
    """A fit whose errors on the views kept out are given; it notes at which steps they are asked for, and what was stored then."""

    errors: list[float] = []
    steps = 6

    def error(self, stored: NDArray, network: object) -> float:
        self.asked = [*getattr(self, "asked", []), (round(self.fraction * self.steps), stored)]
        return self.errors[len(self.asked) - 1]


@pytest.mark.hard_case(75)
@pytest.mark.parametrize(
    ("errors", "evaluations", "patience", "asked", "best"),
    [
        ([1.0, 0.9, 0.8, 0.7], 3, 1, [0, 2, 4, 6], 3),
        ([1.0, 0.9, 0.8], 2, 1, [0, 3, 6], 2),
        ([1.0, 0.9, 0.8, 0.7], 4, 1, [0, 2, 4, 6], 3),  # every 2 steps: 1.5 rounded up
        ([1.0, 1.1, 0.5], 6, 1, [0, 1], 0),
        ([1.0, 1.1, 1.2, 0.5], 6, 2, [0, 1, 2], 0),
        ([1.0, 1.1, 0.9, 1.2, 1.3, 0.5], 6, 2, [0, 1, 2, 3, 4], 2),  # a gain starts the count anew
        ([1.0, 0.9996, 0.9993, 0.5], 6, 2, [0, 1, 2], 2),  # less than a twentieth of a per cent each is no gain, but it is kept
        ([1.0, 0.9994, 0.9988, 0.9982, 0.9977, 0.99715, 0.9966], 6, 1, [0, 1, 2, 3, 4, 5, 6], 6),
    ],
)
def test_a_fit_ends_when_nothing_is_gained_and_keeps_the_best(
    errors: list[float], evaluations: int, patience: int, asked: list[int], best: int
) -> None:
    kind = type("Told", (Given,), {"errors": errors})
    fit = small_fit(replace(SETTINGS, evaluations=evaluations, patience=patience), kind)
    report = fit.run()
    assert [step for step, _ in fit.asked] == asked and report["steps"] == asked[-1]
    assert fit.least == errors[best] and fit.best[0] is fit.asked[best][1]
    assert report["psnr_before"] == pytest.approx(-10 * np.log10(errors[0]))
    assert report["psnr_after"] == pytest.approx(-10 * np.log10(errors[best]))


def test_an_error_that_is_no_number_ends_a_fit() -> None:
    with pytest.raises(SnergError, match="not finite"):
        small_fit(SETTINGS, type("Told", (Given,), {"errors": [1.0, float("nan")]})).run()


def test_the_last_step_is_measured_though_it_is_not_due() -> None:
    """Of five steps, of which every second is measured."""
    fit = small_fit(replace(SETTINGS, rays=33), type("Told", (Given,), {"errors": [1.0, 0.9, 0.8, 0.7], "steps": 5}))
    assert fit.run()["steps"] == 5 and [step for step, _ in fit.asked] == [0, 2, 4, 5] and fit.least == 0.7
