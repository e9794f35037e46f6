"""The mean of parameters over the last steps of a training, which is better than any of them (Polyak and Juditsky 1992; JAX)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..io.schema import numbers

EVERY = 8  # steps: those between differ too little to be worth reading and writing all parameters


class Average:
    """A running mean of parameters. A step at the rate that training ends with still throws them about what they should be;
    their mean comes nearer."""

    def __init__(self) -> None:
        self.mean: Any = None
        self.count = 0

    def add(self, params: Any) -> None:
        """Take the parameters [any tree of arrays] of a step in."""
        self.count += 1
        share = np.float32(1 / self.count)
        self.mean = jax.tree.map(jnp.array, params) if self.mean is None else _toward(self.mean, params, share)

    def state(self) -> dict[str, NDArray[Any]]:
        """All that `restore` needs."""
        leaves = [] if self.mean is None else jax.tree.leaves(self.mean)
        return {"averaged": np.array(self.count)} | {f"mean_{i:03d}": np.array(leaf) for i, leaf in enumerate(leaves)}

    def restore(self, state: dict[str, NDArray[Any]], like: Any) -> None:
        """Undo `state`, of parameters that are shaped `like` these. Raises ValueError or KeyError where it is another's."""
        self.count = int(state.get("averaged", 0))  # trainings begun before there were means have none
        if self.count:
            leaves, tree = jax.tree.flatten(like)
            kept = [numbers(state[f"mean_{i:03d}"], "the mean", leaf.shape) for i, leaf in enumerate(leaves)]
            self.mean = jax.tree.unflatten(tree, [jnp.array(array, leaf.dtype) for array, leaf in zip(kept, leaves, strict=True)])


@partial(jax.jit, donate_argnums=0)
def _toward(mean: Any, params: Any, share: Any) -> Any:
    """A share of the way from a mean to parameters."""
    return jax.tree.map(lambda m, p: m + share * (p - m), mean, params)
