"""Whether a bake fits in this machine's memory, before it begins."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..nerf.field import Field
from ..nerf.volume_rendering import optical_depth
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, blocks_in_ranges
from ..scene.voxel_grid import VoxelGrid

FIXED_BYTES = 600 * 2**20  # bytes that a bake takes whatever its size: slabs, the field, JAX
PEAK_FACTOR = 1.15  # of the atlas, with masks, and what is marched for visibility
PROBE_RESOLUTION = 128  # voxels along the longest side of the first look; half as many where no occupancy says where to look


def check_memory(field: Field, box: Box, voxel_grid: VoxelGrid, voxel_bytes: int, available: int | None = None) -> int:
    """The bytes that a bake will need, about. Raises SnergError, with the largest resolution that fits, when there are not as many.

    voxel_bytes: of a voxel of the atlas; available: see `available_bytes`, which is asked when None. A bake that would fit
    with every block full is not looked into.
    """
    available = available_bytes() if available is None else available
    dense = bytes_needed(int(np.prod(voxel_grid.blocks)), voxel_bytes)
    if available is None or dense <= available:
        return dense
    points = occupied_points(field, box)
    needed = bytes_needed(count_blocks(points, voxel_grid), voxel_bytes)
    if needed <= available:
        return needed
    low, high = 1, max(voxel_grid.shape)  # the largest that fits lies between
    while high - low > 1:
        middle = (low + high) // 2
        tried = VoxelGrid.inside(box, float(box.size.max()) / middle)
        low, high = (middle, high) if bytes_needed(count_blocks(points, tried), voxel_bytes) <= available else (low, middle)
    gigabytes = f"about {needed / 2**30:.1f} GB of memory, and {available / 2**30:.1f} GB are free"
    if low < 2:
        raise SnergError(f"Baking needs {gigabytes}; close other programs, or make the box smaller.")
    raise SnergError(f"A bake of {max(voxel_grid.shape) - 2} voxels along the longest side needs {gigabytes}; choose at most {low}.")


def bytes_needed(blocks: int, voxel_bytes: int) -> int:
    """What a bake of so many blocks takes at its peak, from the bytes of a voxel of the atlas."""
    return FIXED_BYTES + int(blocks * CELL_VOXELS**3 * voxel_bytes * PEAK_FACTOR)


def occupied_points(field: Field, box: Box) -> tuple[NDArray[Any], float]:
    """Centres [N, 3] of the voxels of a coarse lattice in the box where the field holds something, and their size."""
    voxel_grid = VoxelGrid.inside(box, float(box.size.max()) / (PROBE_RESOLUTION if field.occupancy is not None else PROBE_RESOLUTION // 2))
    found = []
    for x in range(voxel_grid.shape[0]):  # a slice at a time
        plane = np.stack(np.meshgrid(x, *(np.arange(n) for n in voxel_grid.shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
        points = voxel_grid.voxel_centres(plane)
        points = points[field.holds(field.domain.from_world(points))]
        if len(points):
            depth = optical_depth(np, field.query(points)[0], np.float32(voxel_grid.voxel_size))
            found.append(points[depth > 0.005])
    return np.concatenate(found) if found else np.zeros((0, 3)), voxel_grid.voxel_size


def count_blocks(full: tuple[NDArray[Any], float], voxel_grid: VoxelGrid) -> int:
    """How many blocks of a lattice the cubes round points [N, 3] meet, about: as if they stood along its axes."""
    points, size = full
    middle = (points - voxel_grid.grid_to_world[:3, 3]) @ voxel_grid.grid_to_world[:3, :3] / voxel_grid.voxel_size
    half = size / voxel_grid.voxel_size / 2
    first, last = (np.floor((middle + way * half) / DATA_VOXELS).astype(np.int64) for way in (-1, 1))
    return int(blocks_in_ranges(first, last, voxel_grid.blocks).sum())


def available_bytes() -> int | None:
    """Memory that a program may still take, as far as the system tells; None where it does not."""
    free = _windows_bytes() if sys.platform == "win32" else _linux_bytes() if sys.platform == "linux" else None
    if free is None and hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return free


def _linux_bytes() -> int | None:
    """What the kernel thinks can be taken without swapping, and no more than a container may."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return None
    try:
        group = Path("/sys/fs/cgroup")
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        cache = next(int(line.split()[1]) for line in (group / "memory.stat").read_text().splitlines() if line.startswith("file "))
        return min(free, int(limit) - int(used) + cache)
    except (OSError, StopIteration, ValueError):
        return free


def _windows_bytes() -> int | None:
    import ctypes

    status = (ctypes.c_ulonglong * 8)()  # MEMORYSTATUSEX: two 32-bit numbers, of which the first is its length, and seven of 64 bits
    ctypes.cast(status, ctypes.POINTER(ctypes.c_uint32))[0] = ctypes.sizeof(status)
    if not ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):  # type: ignore[attr-defined]
        return None
    return int(status[2])
