"""Adam with what keeps it stable: a schedule, vertices that rest, and steps that are skipped when they are not finite (JAX)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..nerf.model import with_frequencies
from .config import TrainSettings

Loss = Callable[[Any, dict[str, Any]], tuple[Any, dict[str, Any]]]
"""(loss, what else is told: the squared "error", and what the sampler learns from)."""
NOTHING = 1e-9  # a gradient this small is none; those that teach are 1e-7 and more
BETA_1 = 0.9
LARGEST = 1e15  # of a gradient whose norm is taken: the squares of a billion of them still fit


def learning_rate(settings: TrainSettings, step: int, fraction: float) -> float:
    """Log-linear decay over `fraction` of the training; in the first steps it rises from a tenth as JAXNeRF's does (section 6)."""
    warm = 0.1 + 0.9 * math.sin(math.pi / 2 * min(step / max(settings.warm_up, 1), 1.0))
    return warm * math.exp(math.log(settings.rate) + fraction * (math.log(settings.final_rate) - math.log(settings.rate)))


def clipped(settings: TrainSettings, gradient: Any) -> Any:
    """A gradient cut off by value and then scaled to a norm over all parameters, where the settings say so (section 6).

    Nothing above 1e15 goes into the norm, so that no square overflows (hard case 26).
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
    """Adam's two moments, to start with."""
    return jax.tree.map(jnp.zeros_like, params), jax.tree.map(jnp.zeros_like, params)


def train_step(
    settings: TrainSettings, loss_of: Loss, params: Any, moments: Any, batch: dict[str, Any], rate: Any, step: Any
) -> tuple[Any, Any, Any]:
    """One step of Adam (Kingma and Ba 2015). Returns (params, moments, (loss, what the loss tells beside, whether finite)).

    A step whose loss or gradient is not finite changes nothing (hard case 26): a NaN anywhere in the table's gradient
    comes through the other arrays, so only those are looked at.
    """
    (loss, told), gradient = jax.value_and_grad(loss_of, has_aux=True)(params, batch)
    looked = [g for path, g in jax.tree_util.tree_leaves_with_path(gradient) if not _is_table(path)]
    finite = jnp.isfinite(loss) & jnp.array([jnp.isfinite(g).all() for g in looked]).all()
    gradient = clipped(settings, with_frequencies(gradient, settings.view_degrees))
    b1, b2 = BETA_1, settings.beta_2
    unbias = jnp.sqrt(1 - b2 ** jnp.float32(step)) / (1 - b1 ** jnp.float32(step))

    def update(path: Any, p: Any, g: Any, m: Any, v: Any) -> tuple[Any, Any, Any]:
        table = _is_table(path)
        # A vertex that no sample of this step touched rests: were its moments to decay, one sample in ten steps would
        # move it ten times as far as a sample in each does. What hardly any light reaches counts as untouched, because
        # Adam makes full steps even of gradients of 1e-14.
        changes = finite & (jnp.abs(g) > NOTHING) if table else finite
        m2, v2 = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g * g
        factor = settings.view_rate if _is_view(path) else 1.0 if table else settings.network_rate
        p2 = p - rate * factor * unbias * m2 / (jnp.sqrt(v2) + NOTHING)
        return jnp.where(changes, p2, p), jnp.where(changes, m2, m), jnp.where(changes, v2, v)

    changed = jax.tree_util.tree_map_with_path(update, params, gradient, *moments)
    p, m, v = jax.tree.transpose(jax.tree.structure(params), jax.tree.structure((0, 0, 0)), changed)
    return p, (m, v), (loss, told, finite)


def _is_table(path: Any) -> bool:
    """Whether an array of the parameters is a hash grid's table."""
    return "table" in jax.tree_util.keystr(path)


def _is_view(path: Any) -> bool:
    """Whether an array of the parameters is a view-dependence network's."""
    return "'view'" in jax.tree_util.keystr(path)
