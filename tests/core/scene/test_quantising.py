"""Quantising, its dither and the random numbers of voxels: no bias at any level, and golden values computed with whole numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.jitter import voxel_normal, voxel_uniform
from snerg.core.geometry.box import Box
from snerg.core.nerf.sampling import Domain
from snerg.core.scene.quantize import DITHER_BELOW, quantize


@pytest.mark.hard_case(51)
def test_no_level_has_a_bias() -> None:
    """Values spread evenly from a level to the next are in their mean as they were: at each of the 255, of alpha and of colour."""
    draw = np.random.default_rng(0)
    for level in range(255):
        spread = (level + np.linspace(0, 1, 2000, endpoint=False) + 0.00025) / 255
        values = np.stack([0.6 * spread, spread], axis=-1).astype(np.float32)
        stored = quantize(values, draw.random(values.shape, np.float32)).astype(np.float64)
        bias = stored.mean(axis=0) - 255 * values.mean(axis=0, dtype=np.float64)
        limit = 0.05 if level < DITHER_BELOW else 0.002  # 4 sigma of dither
        assert np.abs(bias[1]) < limit and np.abs(bias[0]) < (0.07 if level < DITHER_BELOW else 0.21), f"level {level}: {bias}"


@pytest.mark.hard_case(51)
def test_colours_have_no_bias_on_average() -> None:
    """Of a colour of thick matter, whose values meet every fraction of a level: floor would lose half a level, ceil gain it."""
    draw = np.random.default_rng(1)
    alpha = draw.uniform(0.06, 1, 200_000)
    values = np.stack([alpha * draw.random(len(alpha)), alpha], axis=-1).astype(np.float32)
    error = quantize(values, draw.random(values.shape, np.float32)) - 255 * values.astype(np.float64)
    assert np.abs(error).max() < 0.501 and np.abs(error.mean(axis=0)).max() < 0.004
    assert error.std(axis=0) == pytest.approx(np.sqrt(1 / 12), rel=0.02)


@pytest.mark.hard_case(51)
def test_thin_values_are_dithered_and_thick_ones_rounded() -> None:
    """The threshold's own edge: just below it a fraction of a level is kept by chance, from it on all voxels are alike."""
    noise = np.random.default_rng(2).random((4000, 2), np.float32)
    below, above = (np.tile(np.float32([0, level / 255]), (4000, 1)) for level in (DITHER_BELOW - 0.25, DITHER_BELOW + 0.25))
    assert set(quantize(below, noise)[:, 1]) == {DITHER_BELOW - 1, DITHER_BELOW} and set(quantize(above, noise)[:, 1]) == {DITHER_BELOW}
    assert quantize(below, noise)[:, 1].mean() == pytest.approx(DITHER_BELOW - 0.25, abs=0.03)
    assert DITHER_BELOW == 12


@pytest.mark.hard_case(51)
def test_golden_levels() -> None:
    """Whole levels stay what they are, whatever the dither; halves go up; nothing passes 255 or wraps to 0."""
    levels = np.arange(12, 256)
    values = np.stack([levels, levels], axis=-1).astype(np.float32) / np.float32(255)
    for noise in (0.0, 0.5, 0.999):
        assert np.array_equal(quantize(values, np.full(values.shape, noise, np.float32))[:, 1], levels)
    halves = np.float32([[20.5, 20.5], [20.4, 20.4], [254.6, 254.6], [255, 255]]) / np.float32(255)
    assert quantize(halves, np.zeros((4, 2), np.float32)).tolist() == [[21, 21], [20, 20], [255, 255], [255, 255]]
    assert quantize(np.float32([[1.0001, 1.0001]]), np.zeros((1, 2), np.float32)).tolist() == [[255, 255]]
    assert quantize(np.float32([[300 / 255, 1.0]]), np.zeros((1, 2), np.float32)).tolist() == [[255, 255]]
    thin = np.float32([[0.5 * 3.5, 3.5]]) / np.float32(255)  # alpha 3 or 4: its colour follows, half of that and the dither
    assert quantize(thin, np.float32([[0.4, 0.4]])).tolist() == [[1, 3]]
    assert quantize(thin, np.float32([[0.6, 0.4]])).tolist() == [[2, 3]]
    assert quantize(thin, np.float32([[0.1, 0.6]])).tolist() == [[2, 4]]
    assert quantize(np.float32([[0.4, 0.4]]) / np.float32(255), np.float32([[0.99, 0.5]])).tolist() == [[0, 0]]


@pytest.mark.hard_case(51, 59)
def test_no_colour_where_alpha_is_zero() -> None:
    """Empty voxels, and fog that is dithered to nothing, hold nothing, without a division by 0."""
    values = np.zeros((500, 4), np.float32)
    values[250:] = np.float32([0.9, 0.9, 0.9, 1]) * np.float32(0.4 / 255)
    with np.errstate(all="raise"):
        stored = quantize(values, np.random.default_rng(4).random((500, 4), np.float32))
    assert not stored[:250].any() and not stored[stored[:, -1] == 0].any() and 60 < (stored[250:, -1] > 0).sum() < 140


def splitmix(x: int) -> int:
    """The mixing function of splitmix64 (Steele, Lea and Flood 2014), with Python's whole numbers."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB % 2**64
    return x ^ (x >> 31)


def uniform_of(voxel: tuple[int, int, int], number: int, seed: int) -> float:
    """The `number`-th, from 1, of a voxel's numbers."""
    x, y, z = voxel
    key = splitmix((((x << 42) ^ (y << 21) ^ z) + (seed + 1) * 0x9E3779B97F4A7C15) % 2**64)
    return (splitmix((key + number * 0xD1B54A32D192ED03) % 2**64) >> 40) / 2**24


@pytest.mark.hard_case(48)
@pytest.mark.parametrize("seed", [0, 7, 2**31])
def test_golden_random_numbers(seed: int) -> None:
    voxels = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (4095, 4095, 4095), (2**21 - 1, 5, 2**21 - 1), (70000, 123456, 3)]
    got = voxel_uniform(np.array(voxels), 4, seed)
    assert got.dtype == np.float32 and got.tolist() == [[uniform_of(voxel, k, seed) for k in (1, 2, 3, 4)] for voxel in voxels]
    normal = voxel_normal(np.array(voxels), 1, seed)[:, 0]
    for voxel, row in zip(voxels, normal, strict=True):
        a, b, c, d = (uniform_of(voxel, k, seed) for k in (1, 2, 3, 4))
        r, s = math.sqrt(-2 * math.log(1 - a)), math.sqrt(-2 * math.log(1 - b))
        expected = r * math.cos(2 * math.pi * c), s * math.cos(2 * math.pi * d), r * math.sin(2 * math.pi * c)
        assert row == pytest.approx(expected, abs=2e-5)


@dataclass(frozen=True, eq=False)
class Ripples:
    """Thin fog whose opacity rises with the square of the distance from the middle of each voxel, along an axis."""

    axis: int
    voxel: float
    level: float = 0.5
    occupancy: None = None
    ndc: None = None
    network: None = None
    view: str = "diffuse"
    params: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        place = points[:, self.axis] / self.voxel + 0.5
        off = place - np.round(place)
        alpha = (1.25 + 12 * self.level * off**2) / 255
        density = (-np.log1p(-alpha) / self.voxel).astype(np.float32)
        return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 0), np.float32)

    def holds(self, x: np.ndarray) -> np.ndarray:
        return np.ones(len(x), bool)


@pytest.mark.hard_case(48, 51)
@pytest.mark.parametrize("axis", range(3))
def test_dither_and_jitter_are_independent(axis: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the numbers that move a voxel's samples also dithered it, fog would be off by a tenth of a level on average."""
    monkeypatch.setattr("snerg.core.baking.bake.MAX_GRAIN", np.inf)  # even levels, whatever they do to this fog
    box, settings = Box.axis_aligned([-1, -1, -1], [1, 1, 1]), {"resolution": 40, "supersampling": 2, "alpha_threshold": 1e-4}
    fog = Ripples(axis, 2 / 40)
    exact, stored = (bake(fog, box, (), BakeSettings(**settings, quantise=quantise)) for quantise in (False, True))
    values, got = (scene.cells[:, 1:-1, 1:-1, 1:-1].reshape(-1, 4).astype(np.float64) for scene in (exact, stored))
    held = values[:, -1] > 0
    level, got = 255 * values[held, -1], got[held]
    error = np.stack([*(got[:, :3] - 0.5 * got[:, 3:]).T, got[:, 3] - level], axis=-1)
    error[got[:, 3] == 0] = np.nan  # such a voxel has no colour
    assert level.std() > 0.1 and level.min() > 1, "the jitter tells in the values"
    for part in np.array_split(np.argsort(level), 8):  # what is known of the jitter of a voxel tells nothing of its dither
        assert np.abs(np.nanmean(error[part], axis=0)).max() < 4.5 * 0.5 / np.sqrt(len(part))
