"""Data-parallel training: each device computes a part of the batch, with a copy of all parameters. Needs JAX."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import NDArray

from ..errors import SnergError
from .config import TrainSettings
from .optimizer import Loss, train_step
from .sampler import of_any_length

PACKED = ("inputs", "ray", "valid", "noise")  # have an axis of samples


class Devices:
    """All devices that JAX finds, in all processes. With one device, arrays and steps are the same as without this class."""

    def __init__(self) -> None:
        self.count = len(jax.devices())
        self.processes = jax.process_count()
        self.writes = jax.process_index() == 0
        self._mesh = Mesh(np.array(jax.devices()), ("part",)) if self.count > 1 else None

    def place(self, tree: Any) -> Any:
        """Copy a tree of arrays to every device. All processes must pass the same values."""
        return jax.tree.map(jax.numpy.array if self._mesh is None else partial(self._put, PartitionSpec()), tree)

    def local(self, tree: Any) -> Any:
        """The copies on this process's first device of arrays that `place` or a step returned."""
        return tree if self._mesh is None else jax.tree.map(lambda a: a.addressable_data(0), tree)

    def step(self, settings: TrainSettings, loss_of: Loss) -> Any:
        """`train_step`, compiled, for what `place` and `feed` return."""
        if self._mesh is None:
            return _compiled(of_any_length(settings), loss_of)
        everywhere = NamedSharding(self._mesh, PartitionSpec())
        return jax.jit(partial(train_step, settings, self._added(loss_of)), donate_argnums=(0, 1), out_shardings=everywhere)

    def _added(self, loss_of: Loss) -> Loss:
        """The loss of a whole batch from the loss of a part. Losses are sums over rays and samples, so those of the parts are added."""

        def part_of(params: Any, parts: Any, whole: Any) -> Any:
            mine = jax.tree.map(lambda a: a[0], parts)
            return jax.lax.psum(loss_of(params, {**mine, **whole}), "part")  # the aux values are sums too

        nothing, cut = PartitionSpec(), PartitionSpec("part")
        everywhere = jax.shard_map(part_of, mesh=self._mesh, in_specs=(nothing, cut, nothing), out_specs=nothing)
        return lambda params, batch: everywhere(params, batch["parts"], batch["whole"])

    def feed(self, settings: TrainSettings, arrays: dict[str, Any]) -> Any:
        """Split a batch among the devices, as the argument of `step`. Every process draws the same whole batch."""
        if self._mesh is None:
            return arrays
        parts, whole = split_batch(arrays, self.count, longest_ray(settings))
        put = partial(self._put, PartitionSpec("part"))
        return {"parts": jax.tree.map(put, parts), "whole": self.place(whole)}

    def shared(self, value: float) -> float:
        """The value of process 0, in all processes. Values that depend on the clock must be the same in all of them."""
        return value if self.processes == 1 else float(multihost_utils.broadcast_one_to_all(np.float32(value)))

    def agreed(self, elapsed: float, stop: bool) -> tuple[float, bool]:
        """(seconds of process 0, whether any process is to stop), the same in all processes.

        All must stop after the same step: if one stopped alone, the others would wait for it for ever.
        """
        if self.processes == 1:
            return elapsed, stop
        gathered = multihost_utils.process_allgather(np.array([elapsed, stop], np.float32))
        return float(gathered[0, 0]), bool(gathered[:, 1].any())

    def leave(self) -> None:
        """Leave the distributed training. All processes must call this: JAX in the others reports a process that just ends as an error."""
        if self.processes > 1:
            jax.distributed.shutdown()

    def _put(self, spec: PartitionSpec, array: Any) -> Any:
        array = np.asarray(array)
        return jax.make_array_from_callback(array.shape, NamedSharding(self._mesh, spec), lambda index: array[index])


def longest_ray(settings: TrainSettings) -> int:
    """The largest number of samples of one ray in the cube [-1, 1]^3 at the final spacing."""
    return math.ceil(2 * math.sqrt(3) / settings.spacing) + 2


@lru_cache(8)
def _compiled(settings: TrainSettings, loss_of: Loss) -> Any:
    """`train_step` on one device, compiled: once in a process for trainings whose settings and losses are equal."""
    return jax.jit(partial(train_step, settings, loss_of), donate_argnums=(0, 1))


def split_batch(arrays: dict[str, Any], parts: int, longest: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a step's batch on the host: (arrays [parts, ...], one part for each device; arrays that every device gets whole).

    A batch of packed samples is split between rays, so that each ray is composited on one device. Rays keep their numbers; `used` of a
    part marks its own rays. A part has room for its share of the samples plus `longest`, the largest number of samples of a ray.
    Any other batch has arrays [rays, ...]; raises SnergError when the number of rays is not a multiple of `parts`.
    """
    if "ray" not in arrays:
        return _split_rays(arrays, parts)
    ray, valid = np.asarray(arrays["ray"]), np.asarray(arrays["valid"])
    size, count, none = len(ray), int(valid.sum()), len(arrays["used"]) - 1
    room = -(-size // parts) + longest
    cuts = [int(np.searchsorted(ray[:count], ray[p * count // parts])) if count else 0 for p in range(parts)] + [count]

    def cut(array: Any, fill: int = 0) -> NDArray[Any]:
        """[..., size, ...] to [parts, ..., room, ...]."""
        array = np.asarray(array)
        axis = array.shape.index(size)
        result = np.full((parts, *array.shape[:axis], room, *array.shape[axis + 1 :]), fill, array.dtype)
        source, target = np.moveaxis(array, axis, 0), np.moveaxis(result, axis + 1, 1)
        for p in range(parts):
            target[p, : cuts[p + 1] - cuts[p]] = source[cuts[p] : cuts[p + 1]]
        return result

    split = {name: jax.tree.map(cut, arrays[name]) for name in PACKED if name in arrays and name != "ray"}
    split["ray"] = cut(ray, none)
    split["used"] = np.zeros((parts, none + 1), bool)
    for p in range(parts):
        split["used"][p, ray[cuts[p] : cuts[p + 1]]] = True
    return split, {name: value for name, value in arrays.items() if name not in split}


def _split_rays(arrays: dict[str, Any], parts: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays [rays, ...] to [parts, rays / parts, ...]; scalars go to all."""
    whole = {name: value for name, value in arrays.items() if np.ndim(value) == 0}
    if (rays := len(arrays["near"])) % parts:
        raise SnergError(f"{rays} rays a step cannot be divided among {parts} devices; set rays to a multiple of {parts}.")
    split = {name: jax.tree.map(np.asarray, value) for name, value in arrays.items() if name not in whole}
    return jax.tree.map(lambda a: a.reshape(parts, -1, *a.shape[1:]), split), whole
