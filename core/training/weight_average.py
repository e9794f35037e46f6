"""The mean of the parameters over the last steps of a training: Polyak-Ruppert averaging (Polyak and Juditsky 1992). Needs JAX."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..io.schema import numbers

EVERY = 8  # steps between two parameters that are averaged: closer ones differ too little to be worth reading and writing all of them


@dataclass(frozen=True, eq=False)
class WeightAverage:
    """A running mean of parameters. At the final learning rate each step still moves the parameters around their optimum; their mean
    is closer to it.

    mean: a tree of arrays as the parameters, None before the first `add`. count: how many parameters it is the mean of.
    """

    mean: Any = None
    count: int = 0

    def add(self, params: Any) -> WeightAverage:
        """The mean with these parameters included. The arrays of this mean are reused for it: do not read them afterwards."""
        count = self.count + 1
        share = np.float32(1 / count)
        return WeightAverage(jax.tree.map(jnp.array, params) if self.mean is None else _interpolate(self.mean, params, share), count)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What `from_arrays` reads: named arrays of any shape, copied to the host."""
        leaves = [] if self.mean is None else jax.tree.leaves(self.mean)
        return {"averaged": np.array(self.count)} | {f"mean_{i:03d}": np.array(leaf) for i, leaf in enumerate(leaves)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]], like: Any) -> WeightAverage:
        """The average whose `arrays` (of any shape) these are, of parameters shaped as `like`.

        Raises ValueError or KeyError on another network's.
        """
        count = int(arrays.get("averaged", 0))  # trainings of versions without averaging have none
        if not count:
            return cls()
        leaves, tree = jax.tree.flatten(like)
        means = [numbers(arrays[f"mean_{i:03d}"], "the mean", leaf.shape) for i, leaf in enumerate(leaves)]
        return cls(jax.tree.unflatten(tree, [jnp.array(array, leaf.dtype) for array, leaf in zip(means, leaves, strict=True)]), count)


@partial(jax.jit, donate_argnums=0)
def _interpolate(mean: Any, params: Any, share: Any) -> Any:
    """mean + share * (params - mean), over trees of arrays."""
    return jax.tree.map(lambda m, p: m + share * (p - m), mean, params)
