"""A trained or imported deferred NeRF, and how to ask it for values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..errors import SnergError
from .networks import Family, ViewNetwork, field_inputs, field_outputs
from .sampling import Domain, cell_index

CHUNK = 65536  # points a call: one compiled shape, and temporaries that stay in reach of the caches


@dataclass(frozen=True, eq=False)
class Field:
    """The deferred NeRF (section 4.2).

    family: what the network is; params: its arrays, NumPy; network: the view-dependence network, None when diffuse.
    domain: the field's coordinates in the world. occupancy: bool [128^3] (see Occupancy), or None where
    anything may be anywhere. spacing: distance between samples, field coordinates. cameras: those it was trained from.
    dataset: the folder it was trained from, '' when imported. about: history and settings, JSON values.
    """

    family: Family
    params: Any
    network: ViewNetwork | None
    domain: Domain
    occupancy: np.ndarray | None
    spacing: float
    cameras: tuple[Camera, ...] = ()
    dataset: str = ""
    about: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def _compiled(self) -> Callable[[np.ndarray], tuple[Any, Any]]:
        import jax

        inputs = jax.jit(lambda x: field_inputs(jax.numpy, self.family, x))
        outputs = jax.jit(lambda params, given: field_outputs(jax.numpy, self.family, params, given))
        params = jax.device_put(self.params)
        return lambda x: outputs(params, inputs(x))

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Field coordinates [N, 3] float32 to (density [N] per unit of them, RGB and features [N, 7]); no mask (JAX)."""
        density = np.empty(len(x), np.float32)
        values = np.empty((len(x), 7), np.float32)
        for start in range(0, len(x), CHUNK):
            part = x[start : start + CHUNK]
            padded = np.zeros((CHUNK, 3), np.float32)
            padded[: len(part)] = part
            got = self._compiled(padded)
            density[start : start + len(part)] = np.asarray(got[0])[: len(part)]
            values[start : start + len(part)] = np.asarray(got[1])[: len(part)]
        if not np.isfinite(density).all():
            raise SnergError("The field gives densities that are not finite; train it again, or import an undamaged checkpoint.")
        return density, values

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World points [N, 3] to density [N] per world unit, RGB [N, 3], features [N, 4] (JAX).

        Outside what training saw the field is garbage, so there density is 0.
        """
        x = self.domain.from_world(points)
        kept = np.flatnonzero(self.holds(x))
        density = np.zeros(len(points), np.float32)
        values = np.zeros((len(points), 7), np.float32)
        density[kept], values[kept] = self.evaluate(x[kept])
        return density * np.float32(self.domain.scale), values[:, :3], values[:, 3:]

    def holds(self, x: np.ndarray) -> np.ndarray:
        """[N] bool: field coordinates at which there may be something."""
        inside = ((x >= self.domain.low - 1e-6) & (x <= self.domain.high + 1e-6)).all(axis=-1)
        if self.occupancy is not None:
            inside &= self.occupancy[cell_index(x)]
        return inside
