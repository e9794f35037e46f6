"""Fits the voxels of a baked scene, with its network, to the training images through the march (as Plenoxels, CVPR 2022). Uses JAX.

Colour, features and opacity of the voxels that the training rays sample are moved by Adam. The correction of a voxel is held near 0 and
near that of its neighbours: most of what single pixels ask for is noise, which other views do not show. A share of the training views is
kept out; the voxels that are best on those, as they would be stored, are returned.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import ViewNetwork, as_numpy, view_residual
from ..progress import Progress, silent, within
from ..scene.blocks import CELL_VOXELS, block_coordinates, fill_aprons
from ..scene.quantize import quantize
from ..scene.scene import Scene
from .jitter import voxel_uniform
from .ray_samples import CORNERS, FRACTION_STEPS, MAX_RAY_SAMPLES, RaySamples, record_samples


@dataclass(frozen=True)
class FitSettings:
    rays: int = 1_000_000
    validation_rays: int = 60_000
    passes: float = 1.0
    batch: int = 16384
    rate: float = 3e-3
    alpha_rate: float = 1.0
    feature_rate: float = 1.0
    network_rate: float = 1e-3
    final: float = 0.1
    smooth: float = 0.0
    anchor: float = 0.0
    evaluations: int = 8
    random_background: bool = False
    beta2: float = 0.99
    grow: bool = False
    seed: int = 0
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


RAY_SAMPLES = 12


class Batch(NamedTuple):
    base: Any
    fraction: Any
    ray: Any
    slot: Any
    valid: Any
    view_directions: Any
    pixels: Any
    used: Any
    background: Any


def number_voxels(scene: Scene, samples: RaySamples, grow: bool = False) -> tuple[NDArray[Any], NDArray[Any]]:
    """numbers int32 [M*32^3], own [P] flat index in own-voxels."""
    M = len(scene.cells)
    touched = np.zeros(M * CELL_VOXELS**3, bool)
    for corner in CORNERS:
        touched[samples.base + corner] = True
    numbers = np.arange(M * CELL_VOXELS**3, dtype=np.int32).reshape(M, *(CELL_VOXELS,) * 3)
    own = numbers.copy()
    edge = np.ones((CELL_VOXELS,) * 3, bool)
    edge[1:-1, 1:-1, 1:-1] = False
    own[:, edge] = -1
    for _ in fill_aprons(own, scene.indirection):
        pass
    own = own.reshape(-1)
    flat = scene.cells.reshape(-1, scene.cells.shape[-1])
    ok = touched & (own >= 0)
    if not grow:
        ok &= flat.any(axis=-1)
    ids = np.unique(own[ok])
    rows = np.full(len(own) + 1, len(ids), np.int32)
    rows[ids] = np.arange(len(ids), dtype=np.int32)
    return rows[own], ids


def batches(samples: RaySamples, order: NDArray[Any], settings: FitSettings, rng: np.random.Generator) -> Iterator[Batch]:
    RB, SB = settings.batch, settings.batch * RAY_SAMPLES
    lengths = np.cumsum(samples.first[order + 1] - samples.first[order])
    at, before = 0, 0
    while at < len(order):
        end = min(int(np.searchsorted(lengths, before + SB, side="right")), at + RB - 1)
        rays = order[at:end]
        rows, ray, slot = samples.take(rays)
        k, n = len(rows), len(rays)

        def pad(values: NDArray[Any], size: int, fill: Any = 0) -> NDArray[Any]:
            out = np.full((size, *values.shape[1:]), fill, values.dtype)
            out[: len(values)] = values
            return out

        d = pad(samples.view_directions[rays], RB)
        d[n:, 2] = 1
        bg = rng.random((RB, 3), np.float32) if settings.random_background else np.broadcast_to(np.array(settings.background, np.float32), (RB, 3))
        yield Batch(pad(samples.base[rows], SB), pad(samples.fraction[rows], SB), pad(ray, SB, RB - 1), pad(slot, SB, MAX_RAY_SAMPLES - 1),
                    pad(np.ones(k, np.float32), SB), d, pad(samples.pixels[rays], RB), pad(np.ones(n, np.float32), RB), bg)
        at, before = end, int(lengths[end - 1])


def composite(full: Any, network: Any, batch: Batch, correction: bool) -> Any:
    """pred - want [R,3]; full: [S,8,C] premultiplied corner values."""
    R = len(batch.pixels)
    f = (batch.fraction.astype(jnp.float32) + 0.5) / FRACTION_STEPS
    w = jnp.stack([(f[:, 0] if c & 4 else 1 - f[:, 0]) * (f[:, 1] if c & 2 else 1 - f[:, 1]) * (f[:, 2] if c & 1 else 1 - f[:, 2]) for c in range(8)], -1)
    smp = jnp.einsum("sk,skc->sc", w, full)
    a = jnp.clip(smp[:, -1], 0, 0.9999) * batch.valid
    logs = jnp.zeros((R, MAX_RAY_SAMPLES)).at[batch.ray, batch.slot].add(jnp.log1p(-a))
    before = jnp.exp(jnp.cumsum(logs, 1) - logs)[batch.ray, batch.slot]
    through = jnp.exp(logs.sum(1))[:, None]
    acc = jax.ops.segment_sum((before * batch.valid)[:, None] * smp[:, :-1], batch.ray, R, indices_are_sorted=True)
    if correction:
        A = 1 - through
        factor = jnp.where(A < 2 / 3, 1.5, 1 / jnp.maximum(A, 2 / 3))
        acc, through = acc * factor, jnp.maximum(1 - factor * A, 0)
    colour = acc[:, :3] + through * batch.background
    if network is not None:
        res = view_residual(jnp, network, acc[:, :3] + through, acc[:, 3:], batch.view_directions)
        colour = colour + jnp.where(through <= NETWORK_TRANSMITTANCE, res, 0)
    pix = batch.pixels.astype(jnp.float32) / 255
    want = pix[:, :3] * pix[:, 3:] + (1 - pix[:, 3:]) * batch.background
    return (colour - want) * batch.used[:, None]


def premultiplied(straight: Any) -> Any:
    return jnp.concatenate([straight[..., :-1] * straight[..., -1:], straight[..., -1:]], -1)


def loss_of(p: Any, start: Any, numbers: Any, batch: Batch, settings: FitSettings, correction: bool) -> Any:
    corner = numbers[batch.base[:, None] + CORNERS]
    d = p["d"][corner]
    error = composite(premultiplied(start[corner] + d), p["n"], batch, correction)
    data = (error**2).sum() / (3 * batch.used.sum())
    prior = 0.0
    if settings.smooth:
        prior += settings.smooth * (((d - d.mean(1, keepdims=True)) ** 2).sum((1, 2)) * batch.valid).sum() / batch.used.sum()
    if settings.anchor:
        prior += settings.anchor * ((d**2).sum((1, 2)) * batch.valid).sum() / batch.used.sum()
    return data + prior, data


@partial(jax.jit, static_argnames=("settings", "correction"), donate_argnums=(0, 1))
def step(p: Any, m: Any, i: Any, decay: Any, start: Any, numbers: Any, batch: Batch, settings: FitSettings, correction: bool) -> Any:
    (_, data), g = jax.value_and_grad(loss_of, has_aux=True)(p, start, numbers, batch, settings, correction)
    b1, b2 = 0.9, settings.beta2

    def upd(rate: Any, p: Any, g: Any, m1: Any, m2: Any) -> Any:
        m1 = b1 * m1 + (1 - b1) * g
        m2 = b2 * m2 + (1 - b2) * g * g
        u = (m1 / (1 - b1 ** (i + 1))) / (jnp.sqrt(m2 / (1 - b2 ** (i + 1))) + 1e-9)
        return p - rate * decay * u, m1, m2

    C = p["d"].shape[-1]
    rate = jnp.array([settings.rate] * 3 + [settings.rate * settings.feature_rate] * (C - 4) + [settings.rate * settings.alpha_rate])
    d, m1, m2 = upd(rate, p["d"], g["d"], *m["d"])
    d = (jnp.clip(start + d, 0, 1) - start).at[-1].set(0)
    n, mn = p["n"], m["n"]
    if n is not None:
        g0 = g["n"]._replace(weights_0=g["n"].weights_0 * (n.weights_0 != 0).any(axis=1, keepdims=True))
        new = [upd(settings.network_rate, a, b, x, y) for a, b, x, y in zip(n, g0, *mn)]
        n, mn = ViewNetwork(*(q[0] for q in new)), (tuple(q[1] for q in new), tuple(q[2] for q in new))
    return {"d": d, "n": n}, {"d": (m1, m2), "n": mn}, data


@partial(jax.jit, static_argnames=("unit", "correction"))
def error_sum(stored: Any, network: Any, numbers: Any, batch: Batch, unit: float, correction: bool) -> Any:
    corner = numbers[batch.base[:, None] + CORNERS]
    return (composite(stored[corner].astype(jnp.float32) / unit, network, batch, correction) ** 2).sum()


def fit_voxels(scene: Scene, dataset: Dataset, settings: FitSettings = FitSettings(), progress: Progress = silent) -> tuple[Scene, dict[str, Any]]:
    t0 = time.perf_counter()
    views = np.arange(len(dataset.views))
    out = views % 10 == 5
    val = record_samples(scene, dataset, views[out], 4 * settings.validation_rays, 1, within(progress, 0, 0.05))
    train = record_samples(scene, dataset, views[~out], 4 * settings.rays, 2, within(progress, 0.05, 0.3))
    t1 = time.perf_counter()
    rng = np.random.default_rng(settings.seed)
    pick = rng.permutation(len(train))[: settings.rays]
    vpick = np.sort(rng.permutation(len(val))[: settings.validation_rays])
    numbers, ids = number_voxels(scene, train, settings.grow)
    flat = scene.cells.reshape(-1, scene.cells.shape[-1])
    C = flat.shape[-1]
    stored = np.zeros((len(ids) + 1, C), flat.dtype)
    stored[:-1] = flat[ids]
    value = stored / np.float32(scene.unit)
    alpha = value[:, -1:]
    straight = np.concatenate([np.where(alpha > 0, value[:, :-1] / np.maximum(alpha, 1e-3), 0.5).clip(0, 1), alpha], 1).astype(np.float32)
    voxels = ids_to_voxels(scene, ids)
    start, numbers_ = jnp.asarray(straight), jnp.asarray(numbers)
    n = None if scene.network is None else ViewNetwork(*(jnp.asarray(a) for a in scene.network))
    p = {"d": jnp.zeros_like(start), "n": n}
    zeros = lambda: None if n is None else tuple(jnp.zeros_like(a) for a in n)
    m = {"d": (jnp.zeros_like(start), jnp.zeros_like(start)), "n": (zeros(), zeros())}
    vb = list(batches(val, vpick, replace(settings, random_background=False), rng))
    correction = scene.opacity_correction

    def measure(stored: NDArray[Any], network: Any) -> float:
        s = jnp.asarray(stored)
        return sum(float(error_sum(s, network, numbers_, b, scene.unit, correction)) for b in vb) / (3 * len(vpick))

    first = best = measure(stored, n)
    best_state = (stored, n)
    mean_len = float((train.first[1:] - train.first[:-1]).mean())
    per = min(settings.batch - 1, settings.batch * RAY_SAMPLES / mean_len)
    total = max(1, int(len(pick) * settings.passes / per))
    print(f"march {t1 - t0:.1f}s rays {len(train)} used {len(pick)} mean {mean_len:.1f} voxels {len(ids)} steps {total} val {len(vpick)} first {psnr(first):.3f}", flush=True)
    every = max(1, total // settings.evaluations)
    i, t2, losses = 0, time.perf_counter(), []
    history = []

    def stream() -> Iterator[Batch]:
        while True:
            yield from batches(train, rng.permutation(pick), settings, rng)

    for batch in stream():
        decay = settings.final ** (i / total)
        p, m, l = step(p, m, jnp.float32(i), jnp.float32(decay), start, numbers_, batch, settings, correction)
        losses.append(float(l))
        i += 1
        progress(0.3 + 0.7 * i / total, "Fitting voxels")
        if i % every == 0 or i == total:
            full = np.asarray(premultiplied(start + p["d"]))
            q = quantize(full, voxel_uniform(voxels, C, settings.seed + 1)) if scene.quantised else full
            now = measure(q, p["n"])
            history.append((i, round(psnr(np.mean(losses[-every:])), 2), round(psnr(now), 3)))
            print(f"  {i} train {psnr(np.mean(losses[-every:])):.2f} val {psnr(now):.3f} ({psnr(now) - psnr(first):+.3f}) {time.perf_counter() - t2:.1f}s", flush=True)
            if now < best:
                best, best_state = now, (q, jax.tree.map(jnp.copy, p["n"]))
        if i >= total:
            break
    q, net = best_state
    cells = scene.cells.copy()
    cells.reshape(-1, C)[ids] = q[:-1]
    for _ in fill_aprons(cells, scene.indirection):
        pass
    report = {"psnr_before": psnr(first), "psnr_after": psnr(best), "seconds": {"march": t1 - t0, "fit": time.perf_counter() - t1}, "history": history}
    return replace(scene, cells=cells, network=None if net is None else as_numpy(net)), report


def ids_to_voxels(scene: Scene, ids: NDArray[Any]) -> NDArray[Any]:
    cell, local = np.divmod(np.append(ids, ids[:1]), CELL_VOXELS**3)
    xyz = np.stack(np.unravel_index(local, (CELL_VOXELS,) * 3), -1) - 1
    return block_coordinates(scene.indirection)[cell] * 30 + xyz


def psnr(error: float) -> float:
    return -10 * float(np.log10(max(error, 1e-10)))
