"""A rendered picture, the composited values of its rays, and the deferred view-dependent residual (eq. 7), once a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .model import ViewNetwork, view_residual

NETWORK_TRANSMITTANCE = 254 / 255  # the network runs where the transmittance is at most this: alpha of one 8-bit level (hard case 43)
# Amplification (see there) by a network from which it is evaluated in double precision. Trained networks stay below 100; at 1000 single
# precision is off by about 1e-5.
MAX_SINGLE_AMPLIFICATION = 1000.0
STACK = 128  # rays in one matrix product of the network


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered picture, float32. colour: [H, W, 3] premultiplied, display-referred, without a background; alpha: [H, W].

    depth: [H, W], the mean distance along the ray in world units, infinite where alpha is 0.
    """

    colour: NDArray[Any]
    alpha: NDArray[Any]
    depth: NDArray[Any]

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> NDArray[Any]:
        """The picture over a background colour, display-referred: [H, W, 3] in [0, 1]."""
        return np.asarray(np.clip(self.colour + (1 - self.alpha[..., None]) * np.array(background, np.float32), 0, 1))

    def straight(self) -> NDArray[Any]:
        """The picture with straight alpha, as image files store it: [H, W, 4] in [0, 1]."""
        alpha = self.alpha[..., None]
        colour = np.clip(self.colour / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([np.where(alpha > 0, colour, 0), alpha], axis=-1)


@dataclass(frozen=True, eq=False)
class Composited:
    """The composited values of N rays, float32: colour [N, 3], features [N, 4] (a diffuse scene has none: [N, 0]), transmittance [N].

    depth: [N], the sum of distance times compositing weight, that is mean distance times alpha, in units of the space (see `space_rays`).
    samples: the number of samples of all rays together, None where it is not known.
    """

    colour: NDArray[Any]
    features: NDArray[Any]
    transmittance: NDArray[Any]
    depth: NDArray[Any]
    samples: int | None = None

    def part(self, some: slice | NDArray[Any]) -> Composited:
        """The values of some of the rays: those of a slice, of indices [K] or of a bool mask [N]. `samples` is None."""
        return Composited(self.colour[some], self.features[some], self.transmittance[some], self.depth[some])


def shade(network: ViewNetwork | None, rays: Composited, directions: NDArray[Any]) -> NDArray[Any]:
    """The colour [N, 3] of rays: composited colour plus the view-dependent residual (eq. 7), premultiplied, without a background.

    The network runs once a ray, on the colour over white, and only where the ray's transmittance is at most NETWORK_TRANSMITTANCE;
    elsewhere, and where `network` is None (a diffuse field), the residual is 0.
    directions: [N, 3] unit view directions, in the axes in which the network was trained.
    """
    if network is None:
        return rays.colour
    colour = rays.colour.copy()
    seen = np.flatnonzero(rays.transmittance <= np.float32(NETWORK_TRANSMITTANCE))
    over_white = colour[seen] + rays.transmittance[seen, None]
    colour[seen] += residual(network, over_white, rays.features[seen], directions[seen].astype(np.float32))
    return colour


def residual(network: ViewNetwork, colour: NDArray[Any], features: NDArray[Any], directions: NDArray[Any]) -> NDArray[Any]:
    """`view_residual` [N, 3] of any number of rays, evaluated on batches of STACK rays.

    colour: [N, 3] over white; features: [N, 4]; directions: [N, 3] unit.
    """
    count = len(colour)
    kind = np.float32 if amplification(network) <= MAX_SINGLE_AMPLIFICATION else np.float64
    network = ViewNetwork(*(np.asarray(array, kind) for array in network))

    def stacked(values: NDArray[Any]) -> NDArray[Any]:
        whole = np.empty((-(-count // STACK) * STACK, values.shape[-1]), kind)
        whole[:count], whole[count:] = values, 0
        return whole.reshape(-1, STACK, values.shape[-1])

    found = view_residual(np, network, stacked(colour), stacked(features), stacked(directions)).reshape(-1, 3)[:count]
    return np.asarray(found, np.float32)


def amplification(network: ViewNetwork) -> float:
    """An upper bound on the ratio of a change of the residual to the largest change of an input: the product of the layers' norms."""
    kernels = (np.asarray(a, np.float64) for a in (network.weights_0, network.weights_1, network.weights_2))
    return float(np.prod([np.abs(kernel).sum(axis=0).max() for kernel in kernels])) / 4
