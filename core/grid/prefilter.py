"""Filling the atlas (section 5.3): in each voxel the average of what the field gives at a few points of it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from ..field.field import Field
from ..field.volume import opacity, optical_depth
from .blocks import counts, fill_aprons, number, pack, places_of, reach, renumbered, unpack
from .box import CELL_VOXELS, DATA_VOXELS
from .jitter import voxel_normal, voxel_uniform
from .kept import Arrays, Kept, each
from .lattice import Lattice
from .quantize import quantize

VOXELS = 2**16  # of a slab, about
MOST_SAMPLES = 16
MEASURED = 2**13  # voxels on which the number of samples is chosen
CHANGE = 0.02  # root mean square, in [0, 1], that doubling the samples must change for it to be worth its time


def fill(
    field: Field,
    lattice: Lattice,
    bits: np.ndarray,
    indirection: np.ndarray,
    channels: int,
    samples: int,
    seed: int,
    quantised: bool,
    kept: Kept,
    tell: Callable[[float], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Bake the voxels of a mask [M, 30, 30] into cells [R, 32, 32, 32, C] and their own indirection grid.

    channels: C. quantised: uint8, else float32. A cell is kept when anything in its 32^3 is not 0; one with nothing is dropped.
    """
    wanted = number(reach(bits, indirection))
    bits = renumbered(bits, indirection, wanted)
    places = places_of(wanted)
    slabs = cut(counts(bits))

    def work(slab: int) -> Arrays:
        row, *local = np.nonzero(unpack(bits[slabs[slab]]))
        voxels = places[slabs[slab]][row] * DATA_VOXELS + np.stack(local, axis=-1)
        colour, alpha = average(field, lattice, voxels, samples, seed)
        values = np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1)
        return {"values": quantize(values, voxel_uniform(voxels, channels, seed + 1)) if quantised else values}

    cells = np.zeros((len(places), *(CELL_VOXELS,) * 3, channels), np.uint8 if quantised else np.float32)
    for slab, arrays in each("prefilter", len(slabs), work, kept, lambda f: tell(0.95 * f)):
        rows = slabs[slab]
        mask = unpack(bits[rows])
        cells[rows, 1:-1, 1:-1, 1:-1][mask] = arrays["values"]
        mask[mask] = arrays["values"].any(axis=-1)
        bits[rows] = pack(mask)
    kept_blocks = number(reach(bits, wanted))
    cells = gathered(cells, wanted[kept_blocks >= 0])
    for done in fill_aprons(cells, kept_blocks):
        tell(0.95 + 0.05 * done / len(cells))
    return cells, kept_blocks


def cut(sizes: np.ndarray) -> list[slice]:
    """Runs of blocks of about VOXELS voxels each, from how many each block has [M]."""
    group = (np.cumsum(sizes) - 1) // VOXELS
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(sizes)]
    return [slice(first, end) for first, end in pairwise(edges) if end > first]


def gathered(cells: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Cells of rising numbers `rows`, moved to the front in place: an atlas is too large to copy."""
    for to, row in enumerate(rows.tolist()):
        if to != row:
            cells[to] = cells[row]
    return cells[: len(rows)]


def average(field: Field, lattice: Lattice, voxels: np.ndarray, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied RGB and features [N, C], and opacity [N], averaged over each voxel's own jitter, at voxel indices [N, 3].

    Offsets come in pairs of opposite signs, so that no voxel's content moves (hard case 48); an odd one is the centre.
    Opacity is averaged and colour premultiplied by it, as the reference does where the paper says density: half
    a voxel of solid matter then stops half the light, where the mean density would stop all of it (hard case 49).
    """
    offsets = voxel_normal(voxels, samples // 2, seed) / np.sqrt(12)
    signed: list[Any] = [sign * offsets[:, pair] for pair in range(samples // 2) for sign in (1, -1)]
    if samples % 2:
        signed.append(0.0)
    colour: Any = 0.0
    total = np.zeros(len(voxels), np.float32)
    for offset in signed:
        density, rgb, features = field.query(lattice.points(voxels + offset))
        alpha = opacity(np, optical_depth(np, density, np.float32(lattice.voxel_size)))
        colour = colour + np.concatenate([rgb, features], axis=-1) * alpha[:, None]
        total += alpha
    return colour / np.float32(samples), total / np.float32(samples)


def choose_samples(
    field: Field, lattice: Lattice, bits: np.ndarray, indirection: np.ndarray, seed: int
) -> tuple[int, list[dict[str, Any]]]:
    """How many samples a voxel are worth their time: the least of 1, 2, 4, 8 and 16 that doubling changes by less than CHANGE.

    Measured on some voxels of the mask; returns the number, and what doubling changed, [{"samples", "change"}], change the root mean
    square over premultiplied colour and opacity.
    """
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(bits), min(len(bits), 64), replace=False))
    row, *local = np.nonzero(unpack(bits[rows]))
    some = np.sort(rng.choice(len(row), min(len(row), MEASURED), replace=False))
    voxels = places_of(indirection)[rows[row[some]]] * DATA_VOXELS + np.stack(local, axis=-1)[some]
    evidence: list[dict[str, Any]] = []
    samples = 1
    now = _values(field, lattice, voxels, samples, seed)
    while samples < MOST_SAMPLES:
        more = _values(field, lattice, voxels, 2 * samples, seed)
        change = float(np.sqrt(np.mean((more - now) ** 2))) if len(voxels) else 0.0
        evidence.append({"samples": samples, "change": round(change, 5)})
        if change < CHANGE:
            break
        samples, now = 2 * samples, more
    return samples, evidence


def _values(field: Field, lattice: Lattice, voxels: np.ndarray, samples: int, seed: int) -> np.ndarray:
    colour, alpha = average(field, lattice, voxels, samples, seed)
    return np.concatenate([colour[:, :3], alpha[:, None]], axis=-1)
