"""Adam (Kingma and Ba 2015) with JAXNeRF's learning rate schedule and gradient clipping (SNeRG, section 6). Needs JAX.

Two additions: entries of the hash table without a gradient are not updated (as in Instant NGP, Mueller et al. 2022, section 4), and a
step that is not finite changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..nerf.model import with_frequencies
from .config import TrainSettings

Loss = Callable[[Any, dict[str, Any]], tuple[Any, dict[str, Any]]]
"""(parameters, batch) to (loss, aux); see `sampler.Sampler.loss`."""
NOTHING = 1e-9  # Adam's epsilon, and the gradient up to which a table entry counts as untouched; useful ones are 1e-7 and more
BETA_1 = 0.9
LARGEST = 1e15  # bound on a gradient's values before its norm: the sum of a billion such squares fits in float32


def learning_rate(settings: TrainSettings, step: int, fraction: float) -> float:
    """The learning rate of step `step` (from 0), with `fraction` in [0, 1] of the training done.

    It decays log-linearly from settings.rate to settings.final_rate, and rises from a tenth in the first settings.warm_up steps, as
    JAXNeRF's `learning_rate_decay` (section 6).
    """
    warm = 0.1 + 0.9 * math.sin(math.pi / 2 * min(step / max(settings.warm_up, 1), 1.0))
    return warm * math.exp(math.log(settings.rate) + fraction * (math.log(settings.final_rate) - math.log(settings.rate)))


def clipped(settings: TrainSettings, gradient: Any) -> Any:
    """A gradient clipped by value and then by its norm over all parameters, where the settings say so (section 6).

    Values are bounded by LARGEST before the norm is taken, so that no square overflows (hard case 26).
    """
    if settings.clip_value is None and settings.clip_norm is None:
        return gradient
    most = LARGEST if settings.clip_value is None else settings.clip_value
    gradient = jax.tree.map(lambda g: jnp.clip(g, -most, most), gradient)
    if settings.clip_norm is None:
        return gradient
    norm = jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(gradient)))
    factor = settings.clip_norm / jnp.maximum(norm, settings.clip_norm)
    return jax.tree.map(lambda g: g * factor, gradient)


def zero_moments(params: Any) -> tuple[Any, Any]:
    """Adam's first and second moment before the first step: zeros, in trees shaped as the parameters."""
    return jax.tree.map(jnp.zeros_like, params), jax.tree.map(jnp.zeros_like, params)


def train_step(
    settings: TrainSettings, loss_of: Loss, params: Any, moments: Any, batch: dict[str, Any], rate: Any, step: Any
) -> tuple[Any, Any, Any]:
    """One step of Adam (Kingma and Ba 2015, algorithm 1). Returns (params, moments, (loss, aux, whether finite)).

    step: counted from 1, for the bias correction. A step whose loss or gradient is not finite leaves parameters and moments as they
    are (hard case 26). The hash table's gradient is not checked: a NaN in it comes from the other arrays' gradients, which are.
    """
    (loss, aux), gradient = jax.value_and_grad(loss_of, has_aux=True)(params, batch)
    checked = [g for path, g in jax.tree_util.tree_leaves_with_path(gradient) if not _is_table(path)]
    finite = jnp.isfinite(loss) & jnp.array([jnp.isfinite(g).all() for g in checked]).all()
    gradient = clipped(settings, with_frequencies(gradient, settings.view_degrees))
    b1, b2 = BETA_1, settings.beta_2
    unbias = jnp.sqrt(1 - b2 ** jnp.float32(step)) / (1 - b1 ** jnp.float32(step))

    def update(path: Any, p: Any, g: Any, m: Any, v: Any) -> tuple[Any, Any, Any]:
        table = _is_table(path)
        # A table entry that no sample of this step touched keeps its value and moments. If its moments decayed, an entry
        # that is touched once in ten steps would move ten times as far as it should. An entry behind opaque samples counts as
        # untouched, because Adam's step does not depend on the gradient's size: 1e-14 would move it by the full rate.
        changes = finite & (jnp.abs(g) > NOTHING) if table else finite
        m2, v2 = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g * g
        factor = settings.view_rate if _is_view(path) else 1.0 if table else settings.network_rate
        p2 = p - rate * factor * unbias * m2 / (jnp.sqrt(v2) + NOTHING)
        return jnp.where(changes, p2, p), jnp.where(changes, m2, m), jnp.where(changes, v2, v)

    changed = jax.tree_util.tree_map_with_path(update, params, gradient, *moments)
    p, m, v = jax.tree.transpose(jax.tree.structure(params), jax.tree.structure((0, 0, 0)), changed)
    return p, (m, v), (loss, aux, finite)


def _is_table(path: Any) -> bool:
    """Whether an array of the parameters is a hash grid's table."""
    return "table" in jax.tree_util.keystr(path)


def _is_view(path: Any) -> bool:
    """Whether an array of the parameters is a view-dependence network's."""
    return "'view'" in jax.tree_util.keystr(path)
