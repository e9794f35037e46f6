"""Volume rendering (Max 1995; NeRF, eq. 3) of packed samples: sorted by ray, then by distance. NumPy and JAX."""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_DENSITY = 1e30  # a unit of length; times any length it is opaque, and times 0 it is 0, where infinity would give NaN
PARTIAL_SUM = 16  # samples of a ray that are added in turn (JAX): rounding grows with the longest chain of additions
MAX_OPTICAL_DEPTH = 80.0  # exp(-80) is past float32's smallest normal number (hard case 20)


def optical_depth(xnp: Any, density: Any, length: Any) -> Any:
    """The optical depth of intervals, density * length, elementwise, clipped to [0, MAX_OPTICAL_DEPTH].

    density is per unit of length, in the same units as `length`; it may be infinite. The bounds, before and after the product, keep values
    and gradients finite (hard case 20). NaN stays NaN, so that it is found.
    """
    return xnp.clip(xnp.clip(density, -MAX_DENSITY, MAX_DENSITY) * length, 0, MAX_OPTICAL_DEPTH)


def opacity(xnp: Any, depth: Any) -> Any:
    """alpha = 1 - exp(-depth), elementwise, of optical depths; accurate for small depths too (hard case 18)."""
    return -xnp.expm1(-depth)


def depth_before(xnp: Any, depth: Any, ray: Any) -> Any:
    """The optical depth [N] between a ray's origin and each of its samples: the sum of the depths of the samples before it.

    depth: [N] of the samples; ray: [N] their rays, ascending.
    In JAX a segmented scan (no ray's sum is a difference of large sums); in NumPy a float64 running sum.
    """
    if xnp is np:
        total = np.cumsum(depth, dtype=np.float64)
        before = np.concatenate([[0.0], total[:-1]]) if len(total) else total
        first = np.searchsorted(ray, ray, side="left")
        return (before - before[first]).astype(depth.dtype) if len(total) else depth
    import jax

    first = xnp.concatenate([xnp.ones(1, bool), ray[1:] != ray[:-1]])

    def combine(a: Any, b: Any) -> Any:
        return a[0] | b[0], xnp.where(b[0], b[1], a[1] + b[1])

    return jax.lax.associative_scan(combine, (first, depth))[1] - depth


def composite(xnp: Any, depth: Any, values: Any, ray: Any, rays: int) -> tuple[Any, Any, Any]:
    """Front-to-back compositing (eqs. 5, 6).

    depth: [N] optical depth of samples; values: [N, C]; ray: [N] sorted, < rays.
    Returns (composited values [rays, C], transmittance [rays], weights [N]).
    """
    weights = xnp.exp(-depth_before(xnp, depth, ray)) * opacity(xnp, depth)
    sums = sum_rays(xnp, xnp.concatenate([weights[:, None] * values, depth[:, None]], axis=-1), ray, rays)
    return sums[:, :-1], xnp.exp(-sums[:, -1]), weights


def sum_rays(xnp: Any, values: Any, ray: Any, rays: int) -> Any:
    """The sums [rays, C] float32 of values [N, C] over the samples of each ray; ray: [N] sorted, < rays.

    In NumPy the sums are float64. In JAX short runs of a ray's samples are summed first, then runs of these sums, then those: ten thousand
    equal samples that are added one by one in float32 are off by 5e-5.
    """
    if xnp is np:
        sums = np.zeros((rays, values.shape[-1]), np.float32)
        if len(ray):
            starts = np.flatnonzero(np.concatenate([[True], ray[1:] != ray[:-1]]))
            sums[ray[starts]] = np.add.reduceat(values, starts, dtype=np.float64)
        return sums
    while len(ray) > PARTIAL_SUM * (rays + 1):
        index = xnp.arange(1, len(ray))
        begins = (ray[1:] != ray[:-1]) | (index % PARTIAL_SUM == 0)
        run = xnp.concatenate([xnp.zeros(1, ray.dtype), xnp.cumsum(begins).astype(ray.dtype)])
        runs = -(-len(ray) // PARTIAL_SUM) + rays
        values = xnp.zeros((runs, values.shape[-1])).at[run].add(values, indices_are_sorted=True)
        ray = xnp.full(runs, rays - 1, ray.dtype).at[run].set(ray, indices_are_sorted=True)
    return xnp.zeros((rays, values.shape[-1])).at[ray].add(values, indices_are_sorted=True)


def composite_rows(xnp: Any, depth: Any, values: Any) -> tuple[Any, Any, Any]:
    """`composite` for rays that all have K samples. depth: [R, K]; values: [R, K, C].

    Returns (composited values [R, C], transmittance [R], weights [R, K]).
    """
    behind = xnp.cumsum(depth, axis=-1)
    before = xnp.concatenate([xnp.zeros_like(depth[:, :1]), behind[:, :-1]], axis=-1)
    weights = xnp.exp(-before) * opacity(xnp, depth)
    return (weights[..., None] * values).sum(axis=1), xnp.exp(-behind[:, -1]), weights


def mean_distance(xnp: Any, gathered: Any, alpha: Any, nothing: float = np.inf) -> Any:
    """The mean distance [N] along rays: the composited distance `gathered` [N] divided by alpha [N]; `nothing` where alpha is at most 1e-6.

    In the units of `gathered`. Both branches of the `where` are finite, so that the gradient is finite too (hard case 21).
    """
    seen = alpha > 1e-6
    return xnp.where(seen, gathered / xnp.where(seen, alpha, 1), nothing)
