"""A trained or imported NeRF, and its evaluation at points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera
from ..geometry.ndc import Ndc
from .model import ModelConfig, ViewNetwork, field_inputs, field_outputs
from .sampling import Domain, cell_index
from .shading import sample_values

CHUNK = 16384  # points evaluated together: one compiled shape, and temporaries that fit in the processor's caches


@dataclass(frozen=True, eq=False)
class Field:
    """The deferred NeRF (section 4.2).

    family: what the network is; params: its arrays, NumPy; network: the view-dependence network, None when diffuse.
    view: how it depends on the direction that it is seen from: 'deferred' (the network once a ray, section 4.2), 'diffuse' (not at
    all), 'sample' or 'tiny' (in each sample; see shading.py).
    ndc: what its space is: the world where None, else the world in these device coordinates.
    domain: the field's coordinates in that space. occupancy: bool [128^3] (see Occupancy), or None where
    anything may be anywhere. spacing: distance between samples, field coordinates. cameras: those it was trained from.
    dataset: the folder it was trained from, '' when imported. about: history and settings, JSON values.
    """

    family: ModelConfig
    params: Any
    network: ViewNetwork | None
    domain: Domain
    occupancy: NDArray[Any] | None
    spacing: float
    cameras: tuple[Camera, ...] = ()
    dataset: str = ""
    about: dict[str, Any] = field(default_factory=dict)
    ndc: Ndc | None = None
    view: str = "deferred"

    @cached_property
    def _compiled(self) -> Callable[[NDArray[Any]], tuple[Any, Any]]:
        import jax

        inputs, outputs = _compiled_family(self.family)
        params = jax.device_put(self.params)
        return lambda x: outputs(params, inputs(x))

    def evaluate(self, x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """(density [N] per unit of field coordinates, values [N, C]) at field coordinates [N, 3] float32; see `field_outputs`. Needs JAX.

        The values are RGB and features [N, 7], RGB alone [N, 3] where a diffuse field has no features. The occupancy is not applied.
        Raises SnergError when a result is not finite.
        """
        density, values = in_chunks(self._compiled, x)
        return self._finite(density, values)

    def _finite(self, density: NDArray[Any], values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        for what, array in (("densities", density), ("colours", values)):
            if not np.isfinite(array).all():
                raise SnergError(f"The field gives {what} that are not finite; train it again, or import an undamaged checkpoint.")
        return density, values

    @cached_property
    def _compiled_seen(self) -> Callable[[NDArray[Any]], tuple[Any, Any]]:
        import jax

        def seen(params: Any, inputs: Any, directions: Any) -> tuple[Any, Any]:
            density, values = field_outputs(jax.numpy, self.family, params["field"], inputs)
            return density, sample_values(jax.numpy, self.view, self.family, params, values, directions)

        inputs = jax.jit(lambda x: field_inputs(jax.numpy, self.family, x))
        compiled = jax.jit(seen)
        params = jax.device_put({"field": self.params, "view": self.network})
        return lambda x: compiled(params, inputs(x[:, :3]), x[:, 3:])

    def seen(self, x: NDArray[Any], directions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """`evaluate` with the values that are composited along unit view directions [N, 3] in world axes (see `sample_values`): RGB [N, 3]
        where view dependence is per sample ('sample', 'tiny')."""
        if self.view not in ("sample", "tiny"):
            return self.evaluate(x)
        density, values = in_chunks(self._compiled_seen, np.concatenate([x, directions], axis=-1, dtype=np.float32))
        return self._finite(density, values)

    def query(self, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """(density [N], RGB [N, 3], features [N, 4] or [N, 0]) at points [N, 3] of the field's space. Needs JAX.

        Density is per unit of that space. It is 0 outside the domain and in empty cells of the occupancy, where nothing trained the
        field. Raises SnergError when a result is not finite.
        """
        x = self.domain.from_world(points)
        kept = np.flatnonzero(self.holds(x))
        found, known = self.evaluate(x[kept])
        density = np.zeros(len(points), np.float32)
        values = np.zeros((len(points), known.shape[-1]), np.float32)
        density[kept], values[kept] = found, known
        return density * np.float32(self.domain.scale), values[:, :3], values[:, 3:]

    def holds(self, x: NDArray[Any]) -> NDArray[Any]:
        """Whether points [N, 3] in field coordinates lie in the domain and in an occupied cell, bool [N]."""
        within = (x >= (self.domain.low - 1e-6).astype(np.float32)) & (x <= (self.domain.high + 1e-6).astype(np.float32))
        inside = within[:, 0] & within[:, 1] & within[:, 2]  # three times as fast as all(axis=-1)
        if self.occupancy is not None:
            inside &= self.occupancy[cell_index(x)]
        return np.asarray(inside)


@cache
def _compiled_family(family: ModelConfig) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`field_inputs` and `field_outputs` of a family, compiled once for all of its fields: a training bakes many of them."""
    import jax

    inputs = jax.jit(lambda x: field_inputs(jax.numpy, family, x))
    return inputs, jax.jit(lambda params, given: field_outputs(jax.numpy, family, params, given))


def in_chunks(function: Callable[[NDArray[Any]], Sequence[Any]], x: NDArray[Any], size: int = CHUNK) -> tuple[NDArray[Any], ...]:
    """Evaluate `function` on points x [N, D], in chunks of `size` points, so that JAX compiles it for one shape.

    function: maps float32 [size, D] to arrays [size, ...]. The last chunk is padded with zeros. Returns its results as NumPy arrays
    [N, ...].
    """
    parts = []
    for start in range(0, max(len(x), 1), size):  # once for no points too, so that there are shapes
        part = x[start : start + size]
        padded = np.zeros((size, x.shape[-1]), np.float32)
        padded[: len(part)] = part
        parts.append([np.asarray(got)[: len(part)] for got in function(padded)])
    return tuple(column[0] if len(column) == 1 else np.concatenate(column) for column in zip(*parts, strict=True))
