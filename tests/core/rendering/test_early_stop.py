"""When rays may end: the worst veils, networks and light of samples that stay within a tolerance, and the bound against its derivation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from oracle import dense_rays, residual
from scenes import random_network, snerg_from_volume
from snerg.core.nerf.frame import shade
from snerg.core.nerf.model import SHAPES, ViewNetwork
from snerg.core.rendering.early_termination import MAX_STOP, premultiplied_excess, residual_bound, stop_transmittance_for
from snerg.core.rendering.opacity import opacity_factor
from snerg.core.rendering.render import MarchSettings, march_rays
from snerg.core.scene.scene import Scene

ROUNDING = 2e-6
SEEN = (1 - 6 / 255) ** 100  # of what stands behind 100 voxels of a veil of 6 levels
AHEAD = np.array([[-1.0, 2.0, 2.0]]), np.array([[1.0, 0.0, 0.0]])
FALLS = (np.array([-1.0] * 3 + [0.0] * 4), np.array([0.0] * 3 + [1.0] * 4))


def veil(front: tuple[int, ...], back: tuple[int, ...], network: ViewNetwork | None = None, length: int = 400) -> Scene:
    """Fog of `front` along x that becomes `back` so far in that a tolerance has to see it; values of 255, alpha last."""
    values = np.zeros((length, 4, 4, len(front)), np.uint8)
    values[:] = front
    values[100:] = back
    pose = np.eye(4)
    return snerg_from_volume(values, network, grid_to_world=pose, voxel_size=1.0)


def switching_network(direction: float) -> ViewNetwork:
    """A network at its bound: one feature goes through single weights of 1, sigmoids are at their steepest; `direction` is +1 or -1."""
    arrays = [np.zeros(shape, np.float32) for shape in SHAPES]
    arrays[0][30, 0], arrays[1][0] = 1.0, 1.0  # the first feature, on the rising side of a ReLU
    arrays[2][0, 0] = 1.0
    arrays[4][0] = direction * 40.0
    arrays[5][:] = -direction * 40.0 * (1 + SEEN)  # the middle of the sigmoid
    return ViewNetwork(*arrays)


@pytest.mark.parametrize("tolerance", [1e-3, 0.02, 0.2])
@pytest.mark.parametrize("front", [0, 6])
def test_what_a_veil_hides_is_missed_by_no_more_than_the_tolerance(front: int, tolerance: float) -> None:
    """Black fog before white and white before black: all that is missed has the wrong colour, over either background."""
    scene = veil((front,) * 3 + (6,), (6 - front,) * 3 + (6,))
    got, truth = march_rays(scene, *AHEAD, MarchSettings(tolerance)), dense_rays(scene, *AHEAD, 0.0)
    for background in (0.0, 1.0):
        error = np.abs(got.colour + got.transmittance[:, None] * background - truth[0] - truth[1][:, None] * background).max()
        assert error < tolerance + ROUNDING
    if front == 0 and tolerance < 0.05:  # the white behind is what is missed
        assert np.abs(got.colour - truth[0]).max() > 0.85 * tolerance, "and a ray takes no more samples than that"


def glowing_network() -> ViewNetwork:
    """Light of 1 where the first feature is 1, of 0 where it is 0."""
    arrays = [np.zeros(shape, np.float32) for shape in SHAPES]
    arrays[0][30, 0], arrays[2][0, 0], arrays[4][0], arrays[5][:] = 1.0, 1.0, 40.0, -20.0
    return ViewNetwork(*arrays)


def test_light_of_samples_behind_a_veil_counts_twice() -> None:
    """With the network at every sample a white voxel may glow as well: two of colour for one of opacity."""
    scene = veil((0,) * 7 + (6,), (6,) * 7 + (6,), glowing_network())
    truth = dense_rays(scene, *AHEAD, 0.0, per_sample_network=True)
    for tolerance in (1e-3, 0.02):
        got = march_rays(scene, *AHEAD, MarchSettings(tolerance, per_sample_network=True))
        assert 0.8 * tolerance < np.abs(got.colour - truth[0][:, :3]).max() < tolerance + ROUNDING


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_network_at_its_bound_stays_within_the_tolerance(direction: float) -> None:
    """Features that rise behind black fog, through a network whose residual changes as much as its weights allow."""
    network = switching_network(direction)
    scene = veil((0,) * 7 + (6,), (0, 0, 0) + (6,) * 4 + (6,), network, 700)
    values, through, _ = dense_rays(scene, *AHEAD, 0.0)
    truth = values[:, :3] + residual(scene, values[:, :3] + through[:, None], values[:, 3:], AHEAD[1] @ scene.view_rotation.T)
    for tolerance in (1e-3, 0.02):
        got = march_rays(scene, *AHEAD, MarchSettings(tolerance))
        error = np.abs(shade(network, got, AHEAD[1] @ scene.view_rotation.T) - truth).max()
        assert 0.6 * tolerance < error < tolerance + ROUNDING


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_bound_of_a_residual_is_reached_and_not_passed(direction: float) -> None:
    network = switching_network(direction)
    low, high = 1e-3 * FALLS[0], 1e-3 * FALLS[1]
    towards = np.array([[0.0, 0, 1]])

    def shown(feature: float) -> np.ndarray:
        scene = veil((0,) * 8, (0,) * 8, network, 40)
        return residual(scene, np.zeros((1, 3)), np.array([[feature, 0, 0, 0]]), towards)

    change = np.abs(shown(SEEN + 0.0005) - shown(SEEN - 0.0005)).max()
    assert 0.99 * residual_bound(network, low, high) < change <= residual_bound(network, low, high) * (1 + 1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_of_a_residual_is_interval_arithmetic(seed: int) -> None:
    """Against the plain definition, weight by weight, with weights of both signs."""
    network = random_network(seed)
    low, high = (np.random.default_rng(seed).uniform(*ends, 7) for ends in ((-1, 0), (0, 1)))
    intervals = list(zip(low.tolist(), high.tolist(), strict=True))
    for layer, weights in enumerate((network.weights_0[-7:], network.weights_1, network.weights_2)):
        outputs = []
        for column in np.asarray(weights, np.float64).T:
            ends = [sorted((w * a, w * b)) for w, (a, b) in zip(column, intervals, strict=True)]
            least, most = sum(a for a, _ in ends), sum(b for _, b in ends)
            outputs.append((min(least, 0), max(most, 0)) if layer < 2 else (least, most))
        intervals = outputs
    expected = max(max(-a, b) for a, b in intervals) / 4
    assert residual_bound(network, low, high) == pytest.approx(expected, rel=1e-9)


@pytest.mark.hard_case(53)
@pytest.mark.parametrize(
    ("correction", "per_sample", "slope"), [(False, False, 1.0), (True, False, 3.0), (False, True, 2.0), (True, True, 4.5)]
)
def test_a_stop_is_the_tolerance_over_its_slope(correction: bool, per_sample: bool, slope: float) -> None:
    """The slope of the derivation: 1, 2 with light of samples, and with opacity correction 1.5 times that and 1.5."""
    network = glowing_network() if per_sample else None
    scene = replace(veil((6,) * (8 if per_sample else 4), (6,) * (8 if per_sample else 4), network, 40), opacity_correction=correction)
    assert stop_transmittance_for(0.01, scene, per_sample) == pytest.approx(0.01 / slope, rel=0.01)
    assert stop_transmittance_for(100.0, scene, per_sample) == MAX_STOP == 0.5


@pytest.mark.hard_case(53)
def test_opacity_correction_of_colour_that_falls() -> None:
    """White before black at the opacity from which eq. 9 makes a ray opaque: the correction divides what is missed."""
    scene = replace(veil((6,) * 3 + (6,), (0, 0, 0, 6)), opacity_correction=True)
    values, through, _ = dense_rays(replace(scene, opacity_correction=False), *AHEAD, 0.0)
    factor = float(opacity_factor(np, 1 - through)[0])
    for tolerance in (1e-3, 0.05, 0.5):
        got = march_rays(scene, *AHEAD, MarchSettings(tolerance))
        assert np.abs(got.colour - factor * values).max() < tolerance + ROUNDING


def test_an_excess_is_the_smaller_of_a_ratio_and_of_roundings() -> None:
    """By hand: a level above opacity in thick fog is a ratio, in a scene with light without opacity a sum over the longest ray."""
    thick = veil((100, 0, 0, 50), (11, 0, 0, 10), length=160)
    assert premultiplied_excess(thick) == pytest.approx(2.0)
    stray = veil((1, 0, 0, 0), (10, 9, 0, 9), length=60)
    diagonal = np.sqrt(60**2 + 4**2 + 4**2) + 1
    assert premultiplied_excess(stray) == pytest.approx(1 + diagonal / 255)
    faint = veil((3, 0, 0, 1), (10, 0, 0, 10), length=60)
    assert premultiplied_excess(faint) == pytest.approx(min(3.0, 1 + 2 * diagonal / 255))
    assert premultiplied_excess(veil((5, 5, 5, 5), (0, 1, 2, 3), length=60)) == 1
    floats = replace(stray, cells=(stray.cells / np.float32(255)).astype(np.float32))
    assert premultiplied_excess(floats) == pytest.approx(1 + diagonal / 255)


@pytest.mark.hard_case(35)
def test_a_ray_takes_no_samples_after_it_ended() -> None:
    """A solid takes a pass of samples, as long as it may be; fog takes all."""
    solid, fog = veil((9,) * 3 + (255,), (9,) * 3 + (255,)), veil((0, 0, 0, 1), (0, 0, 0, 1))
    assert march_rays(solid, *AHEAD).samples == 4 and march_rays(fog, *AHEAD, MarchSettings(stop_transmittance=0.0)).samples >= 400
