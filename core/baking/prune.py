"""Drops the voxels of a baked scene that no training picture needs (as VQRF, Li et al., CVPR 2023). NumPy alone."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..progress import Progress, silent
from ..scene.blocks import fill_aprons, number_blocks, pack_mask, touched_blocks
from ..scene.scene import Scene
from .ray_samples import NO_VOXEL, RaySamples, corners_of, own_voxels, sampled_views, stencil_weights

PRUNING_PIXELS = 4_000_000  # of all training views, at most: bounds the time


def prune(scene: Scene, dataset: Dataset, threshold: float, seed: int = 0, progress: Progress = silent) -> tuple[Scene, dict[str, Any]]:
    """Drop the voxels whose largest share of any training pixel is below `threshold`, and the blocks that are left without voxels.

    A voxel's share of a pixel is the transmittance in front of a sample, times the voxel's opacity, times its weight in the sample's
    stencil. Returns the scene, and a report: "threshold", "voxels_before", "voxels_after" and "seconds". Raises SnergError when an image
    cannot be read, Cancelled when `progress` does.
    """
    began = time.perf_counter()
    own = own_voxels(scene)
    alpha = scene.cells.reshape(-1, scene.cells.shape[-1])[:, -1]
    needed = np.zeros(len(own), bool)
    for samples in sampled_views(scene, dataset, np.arange(len(dataset.views)), PRUNING_PIXELS, seed, progress):
        corners = own[corners_of(samples.base)][shares(samples, scene.linear(alpha) / np.float32(scene.unit)) >= threshold]
        needed[corners[corners != NO_VOXEL]] = True
    held = alpha[own[own == np.arange(len(own))]] > 0
    kept = without(scene, ~needed)
    report = {
        "threshold": threshold,
        "voxels_before": int(held.sum()),
        "voxels_after": int((needed & (alpha > 0)).sum()),
        "seconds": {"march": round(time.perf_counter() - began, 3)},
    }
    return replace(kept, about={**scene.about, "prune": report}), report


def shares(samples: RaySamples, alpha: NDArray[Any]) -> NDArray[Any]:
    """Shares [S, 8] float32 of the pixels that the corners of samples have. alpha: of the atlas's voxels, [M * 32^3] in [0, 1]."""
    opacity = alpha[corners_of(samples.base)] * stencil_weights(np, samples.fraction)
    depth = -np.log1p(-np.minimum(opacity.sum(axis=-1, dtype=np.float64), 1 - 1e-6))
    before = np.cumsum(depth) - depth
    lengths = np.diff(samples.first)
    before -= np.repeat(before[samples.first[:-1]], lengths)
    return np.asarray(np.exp(-before)[:, None] * opacity, np.float32)


def without(scene: Scene, dropped: NDArray[Any]) -> Scene:
    """The scene without the voxels `dropped`, bool [M * 32^3], of which those in aprons do not count; blocks of zeros lose their cells."""
    cells = scene.cells.copy()
    cells.reshape(-1, cells.shape[-1])[dropped] = 0
    for _ in fill_aprons(cells, scene.indirection):
        pass
    mask = pack_mask(cells[:, 1:-1, 1:-1, 1:-1].any(axis=-1))
    kept = number_blocks(touched_blocks(mask, scene.indirection) & (scene.indirection >= 0))
    return replace(scene, cells=cells[scene.indirection[kept >= 0]], indirection=kept)
