"""Pictures: what rays gathered, and colours with view dependence (eq. 7) once a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .model import ViewNetwork, view_residual

NETWORK_TRANSMITTANCE = 254 / 255  # the network runs where less light than this passes (hard case 43)
STACK = 128


@dataclass(frozen=True, eq=False)
class Frame:
    """colour [H, W, 3] float32 premultiplied, display-referred, over nothing; alpha [H, W]; depth [H, W], the
    expected distance along the ray in world units, infinite where alpha is 0."""

    colour: NDArray[Any]
    alpha: NDArray[Any]
    depth: NDArray[Any]

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> NDArray[Any]:
        """[H, W, 3] in [0, 1] over a colour."""
        return np.asarray(np.clip(self.colour + (1 - self.alpha[..., None]) * np.array(background, np.float32), 0, 1))

    def straight(self) -> NDArray[Any]:
        """[H, W, 4] in [0, 1] with straight alpha, as pictures hold it."""
        alpha = self.alpha[..., None]
        colour = np.clip(self.colour / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([np.where(alpha > 0, colour, 0), alpha], axis=-1)


@dataclass(frozen=True, eq=False)
class Composited:
    """What a ray gathers: colour [N, 3], features [N, 4] (none in a diffuse scene: [N, 0]), transmittance [N], and
    depth [N], distance times opacity in units of the space (see `space_rays`). float32. samples: how many all rays took together, where
    that is known."""

    colour: NDArray[Any]
    features: NDArray[Any]
    transmittance: NDArray[Any]
    depth: NDArray[Any]
    samples: int | None = None

    def part(self, some: slice | NDArray[Any]) -> Composited:
        """The rays [N] of a slice, of indices [K] or of a mask [N]."""
        return Composited(self.colour[some], self.features[some], self.transmittance[some], self.depth[some])


def shade(network: ViewNetwork | None, rays: Composited, directions: NDArray[Any]) -> NDArray[Any]:
    """Composited colour plus the view-dependent residual (eq. 7), [N, 3], once a ray and only where something is.

    directions: [N, 3] unit, in the axes in which the network was trained.
    """
    if network is None:
        return rays.colour
    colour = rays.colour.copy()
    seen = np.flatnonzero(rays.transmittance <= np.float32(NETWORK_TRANSMITTANCE))
    over_white = colour[seen] + rays.transmittance[seen, None]
    colour[seen] += residual(network, over_white, rays.features[seen], directions[seen].astype(np.float32))
    return colour


def residual(network: ViewNetwork, colour: NDArray[Any], features: NDArray[Any], directions: NDArray[Any]) -> NDArray[Any]:
    """`view_residual` [N, 3] of many rays, STACK after STACK."""
    count = len(colour)

    def stacked(values: NDArray[Any]) -> NDArray[Any]:
        whole = np.empty((-(-count // STACK) * STACK, values.shape[-1]), np.float32)
        whole[:count], whole[count:] = values, 0
        return whole.reshape(-1, STACK, values.shape[-1])

    return np.asarray(view_residual(np, network, stacked(colour), stacked(features), stacked(directions)).reshape(-1, 3)[:count])
