"""Non-finite diagnosis: which array of a step is the first that is not finite, and what to do. Needs JAX.

The order of the search is that of the computation: batch, parameters, colours, loss, gradient. Method of our own.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from .optimizer import Loss

IMAGE = ("target", "background")  # arrays of a batch that come from the images
LOWER_RATE = "lower the learning rate (settings rate and network_rate), or set clip_norm"


def cause(loss_of: Loss, params: Any, arrays: dict[str, Any]) -> str:
    """A clause 'what is not finite; what to do' for the first array of a step that is not finite.

    params: before the step, a tree of arrays. arrays: the step's batch.
    """
    for name in sorted(arrays, key=lambda name: name not in IMAGE):
        if not finite(arrays[name]):
            if name in IMAGE:
                return f"an image ({name}) has values that are not finite; look for a broken image in the dataset"
            return f"the rays ({name}) are not finite; look for a broken pose or lens in the dataset"
    if broken := not_finite(params):
        return f"{broken} has values that are not finite; go on from an earlier state, and {LOWER_RATE}"
    (loss, aux), gradient = _compiled(loss_of)(params, arrays)
    if not finite(aux["error"]):
        return f"the colours that the network gives are not finite, of finite parameters; {LOWER_RATE}"
    if not finite(loss):
        return f"the sparsity or alpha loss is not finite although the colours are; lower the densities, or {LOWER_RATE}"
    if broken := not_finite(gradient):
        return f"the gradient of {broken} is not finite; {LOWER_RATE}"
    return f"nothing of the loss is, but the step made of it is not finite; {LOWER_RATE}"


@lru_cache(2)
def _compiled(loss_of: Loss) -> Any:
    """The loss and its gradient, compiled as in the step."""
    return jax.jit(jax.value_and_grad(loss_of, has_aux=True))


def not_finite(tree: Any) -> str | None:
    """The name of the first array of a tree with a value that is not finite, the hash table last; None where all are finite."""
    named = [(_name(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]
    return next((name for name, leaf in sorted(named, key=lambda n: "table" in n[0]) if not finite(leaf)), None)


def finite(tree: Any) -> bool:
    """Whether all values of a tree of arrays are finite; integers always are."""
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    return all(bool(jnp.isfinite(leaf).all()) for leaf in floats)


def _name(path: Any) -> str:
    """An array's name in messages, from its path in the parameters."""
    text = jax.tree_util.keystr(path)
    where = "the coarse " if "coarse" in text else "the "
    what = "hash table" if "table" in text else "view-dependence network" if "'view'" in text else "field's network"
    return f"{where}{what} ({text})"
