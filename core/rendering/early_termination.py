"""From the error that a pixel may have to the light at which its ray may stop."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..nerf.model import ViewNetwork
from ..scene.scene import Scene

CORRECTION_SLOPE = 1.5  # how much steeper equation 9 makes what depends on alpha
VOXELS_PER_CHUNK = 2**20  # voxels looked at together


def stop_transmittance_for(tolerance: float, scene: Scene, per_sample_network: bool) -> float:
    """The transmittance below which a ray may stop, so that no displayed value is further than `tolerance` from the endless march's.

    A ray that stops with light tau left has yet to gather opacity dA <= tau, and colour and features dC <= g tau, g being what
    `excess` gives (1 where every colour is premultiplied as it should be); all are sums of what is not negative. Over a background b
    in [0, 1] the pixel shows C + (1 - A) b + R(w, F), w = C + 1 - A, so that it is off by at most |dC - b dA| + |dR| <= g tau + |dR|.
    R, the view-dependent residual (eq. 7), is given a w that is off by -tau to (g - 1) tau (the ray's dC - dA; see `excess`) and features
    that are off by 0 to g tau: dR is bounded by `steepness`, tau times a constant of the weights. View dependence a sample adds at most
    its opacity to the colour instead: g + 1.

    Equation 9 multiplies by f = min(1, 1.5 A) / A: its slope is 1.5 or 1 / A <= 1.5, so that A moves by at most 1.5 tau, and a value C
    by f dC - C dA / A^2, between -1.5 g tau and 1.5 g tau.
    """
    grows = premultiplied_excess(scene)
    if scene.network is not None and per_sample_network:
        grows += 1
    low, high = np.array([-1.0] * 3 + [0.0] * 4), np.array([grows - 1] * 3 + [grows] * 4)
    slope = grows
    if scene.opacity_correction:
        high = np.full(7, CORRECTION_SLOPE * grows)
        low = -high - np.array([CORRECTION_SLOPE] * 3 + [0.0] * 4)
        slope = CORRECTION_SLOPE * (grows + 1)
    if scene.network is not None and not per_sample_network:
        slope += residual_bound(scene.network, low, high)
    return min(tolerance / slope, 0.5)


def residual_bound(network: ViewNetwork, low: NDArray[Any], high: NDArray[Any]) -> float:
    """At most how far the residual moves when what the network sees of the ray [7] (colour over white, features) moves by something
    between `low` and `high`, whatever it sees: interval arithmetic on the difference. A ReLU moves by something between 0 and what
    its input moves by, the sigmoid by at most a quarter of that."""
    for layer, weights in enumerate((network.weights_0, network.weights_1, network.weights_2)):
        kernel = np.asarray(weights, np.float64)[-len(low) :]
        up, down = np.maximum(kernel, 0), np.minimum(kernel, 0)
        low, high = low @ up + high @ down, high @ up + low @ down
        if layer < 2:
            low, high = np.minimum(low, 0), np.maximum(high, 0)
    return float(np.maximum(-low, high).max()) / 4


_excess: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()


def premultiplied_excess(scene: Scene) -> float:
    """g >= 1, so that colours and features that a ray gathers past some point are together at most g times the light there was.

    In a voxel a value c may be above opacity a (rounded one by one, or not baked by us). c <= r a everywhere, or c <= a + e,
    holds for what is interpolated as well, and summed over a ray of n samples gives g = r, or g = 1 + e n; the smaller one counts.
    Both leave the sum of c - a at most (g - 1) times the light.
    """
    found = _excess.get(scene)
    if found is None:
        flat = scene.cells.reshape(-1, scene.cells.shape[-1])
        ratio, above = 1.0, 0.0
        for start in range(0, len(flat), VOXELS_PER_CHUNK):
            part = flat[start : start + VOXELS_PER_CHUNK]
            part = part[(part[:, :-1] > part[:, -1:]).any(axis=-1)].astype(np.float64)
            if len(part):
                most, alpha = part[:, :-1].max(axis=-1), part[:, -1]
                above = max(above, float((most - alpha).max()))
                ratio = max(ratio, float(np.max(most / alpha)) if alpha.all() else np.inf)
        samples = float(np.linalg.norm(scene.shape)) + 1
        found = _excess[scene] = min(ratio, 1 + above / scene.unit * samples)
    return found
