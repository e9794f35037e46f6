"""Early ray termination: the transmittance at which a ray may stop so that every pixel stays within a given tolerance."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..nerf.model import ViewNetwork
from ..scene.scene import Scene

CORRECTION_SLOPE = 1.5  # largest derivative of the corrected opacity min(1, 1.5 alpha) by alpha (eq. 9)
VOXELS_PER_CHUNK = 2**20  # voxels checked at once: bounds the temporary arrays
# Bound on the error of a ray's composited values by single precision: interpolation, up to some hundred samples, and their sums. The worst
# of a thousand random scenes is a third of it.
ROUNDING = 2.0**-20
LEAST_SHARE = 0.1  # of the tolerance, that ending a ray early may always use up, however strongly a network amplifies rounding
MAX_STOP = 0.5  # a ray never stops with more transmittance left than this, however large the tolerance


def stop_transmittance_for(tolerance: float, scene: Scene, per_sample_network: bool) -> float:
    """The transmittance below which a ray may stop with an error of at most `tolerance` in every displayed value (0 to 1).

    What single precision may be off by, `error_slope` times ROUNDING, comes out of the tolerance first. Where little or nothing is left of
    it, because a network multiplies its inputs by hundreds, ending early may use LEAST_SHARE of it; see `error_bound`.
    """
    slope = error_slope(scene, per_sample_network)
    return min(max(tolerance / slope - ROUNDING, LEAST_SHARE * tolerance / slope), MAX_STOP)


def error_bound(tolerance: float, scene: Scene, per_sample_network: bool = False) -> float:
    """What no displayed value (0 to 1) of a march is off by: the tolerance, or what rounding alone takes where that is more.

    It leaves out pixels whose transmittance is within ROUNDING of NETWORK_TRANSMITTANCE, at which the network sets in.
    """
    slope = error_slope(scene, per_sample_network)
    if scene.network is not None and not per_sample_network:  # rounding goes up and down in all seven inputs
        slope += residual_bound(scene.network, -np.ones(7), np.ones(7)) * (CORRECTION_SLOPE if scene.opacity_correction else 1)
    return max(tolerance, LEAST_SHARE * tolerance + ROUNDING * slope)


def error_slope(scene: Scene, per_sample_network: bool) -> float:
    """The largest ratio of the error of a displayed value to what a ray misses: the transmittance at which it stops, or rounding.

    Derivation. A ray that stops with transmittance tau left misses opacity dA <= tau, and colour and features dC <= g tau, where g is
    `premultiplied_excess` (1 where every colour is at most its opacity). Over a background b in [0, 1] the pixel is
    C + (1 - A) b + R(w, F) with w = C + 1 - A, so its error is at most |dC - b dA| + |dR| <= g tau + |dR|.

    The view-dependent residual R (eq. 7) gets w with an error of -tau to (g - 1) tau and features with an error of 0 to g tau;
    `residual_bound` bounds |dR| by tau times a constant of the weights. With the network at every sample, R adds at most a sample's
    opacity to its colour instead: the bound is (g + 1) tau.

    The opacity correction (eq. 9) multiplies by f = min(1, 1.5 A) / A. Its slope is 1.5 or 1 / A <= 1.5, so A changes by at most 1.5 tau,
    and a value C by f dC - C dA / A^2, which lies between -1.5 g tau and 1.5 g tau.
    """
    excess = premultiplied_excess(scene)
    if scene.network is not None and per_sample_network:
        excess += 1
    low, high = np.array([-1.0] * 3 + [0.0] * 4), np.array([excess - 1] * 3 + [excess] * 4)
    slope = excess
    if scene.opacity_correction:
        high = np.full(7, CORRECTION_SLOPE * excess)
        low = -high - np.array([CORRECTION_SLOPE] * 3 + [0.0] * 4)
        slope = CORRECTION_SLOPE * (excess + 1)
    if scene.network is not None and not per_sample_network:
        slope += residual_bound(scene.network, low, high)
    return float(slope)


def residual_bound(network: ViewNetwork, low: NDArray[Any], high: NDArray[Any]) -> float:
    """An upper bound on the change of the residual (eq. 7), in display-referred colour: the absolute change of any of its 3 channels.

    The change of the network's 7 inputs colour and features lies between `low` [7] and `high` [7]; the view direction stays the same.
    The bound is interval arithmetic on the change, layer by layer, and holds for every colour, feature and direction. The
    output of a ReLU changes by something between 0 and the change of its input, that of a sigmoid by at most a quarter of it.
    """
    for layer, weights in enumerate((network.weights_0, network.weights_1, network.weights_2)):
        kernel = np.asarray(weights, np.float64)[-len(low) :]
        up, down = np.maximum(kernel, 0), np.minimum(kernel, 0)
        low, high = low @ up + high @ down, high @ up + low @ down
        if layer < 2:
            low, high = np.minimum(low, 0), np.maximum(high, 0)
    return float(np.maximum(-low, high).max()) / 4


_excess_cache: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()


def premultiplied_excess(scene: Scene) -> float:
    """g >= 1: colour and features composited behind any point of a ray are at most g times the transmittance there.

    A stored value c may exceed its opacity a, by rounding each channel or in scenes that other programs baked. If c <= r a in all voxels,
    or c <= a + e, the same holds after interpolation. Summed over a ray of n samples this gives g = r, or g = 1 + e n; the smaller counts.
    In both cases the sum of c - a is at most g - 1 times the transmittance. Computed once a scene.
    """
    excess = _excess_cache.get(scene)
    if excess is None:
        ratio, difference = _largest_excess(scene.cells.reshape(-1, scene.cells.shape[-1]), scene.square_roots)
        samples = float(np.linalg.norm(scene.shape)) + 1
        excess = _excess_cache[scene] = min(ratio, 1 + difference / scene.unit * samples)
    return excess


def _largest_excess(voxels: NDArray[Any], square_roots: bool) -> tuple[float, float]:
    """The largest ratio (at least 1) and difference (at least 0, in Scene.unit) of a value and its opacity in voxels [N, C]."""
    ratio, difference = 1.0, 0.0
    for start in range(0, len(voxels), VOXELS_PER_CHUNK):
        part = voxels[start : start + VOXELS_PER_CHUNK]
        part = part[(part[:, :-1] > part[:, -1:]).any(axis=-1)].astype(np.float64)
        if square_roots:
            part = part**2
        if len(part):
            largest, alpha = part[:, :-1].max(axis=-1), part[:, -1]
            difference = max(difference, float((largest - alpha).max()))
            ratio = max(ratio, float(np.max(largest / alpha)) if alpha.all() else np.inf)
    return ratio, difference
