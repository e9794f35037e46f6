"""Estimates the memory that a bake needs, and refuses one that does not fit this machine before it begins."""

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
from ..units import file_size

FIXED_BYTES = 600 * 2**20  # memory that does not depend on the resolution: JAX, the field, the chunks being worked on
PEAK_FACTOR = 1.15  # peak memory of a bake by that of its atlas: masks, and the coarse scene that is marched for visibility
# Voxels along the longest side of the grid on which occupied blocks are counted; half as many in a field without an occupancy grid,
# which must be evaluated everywhere.
PROBE_RESOLUTION = 128
OCCUPIED_DEPTH = 0.005  # optical depth of a probe voxel above which it counts as occupied: the default alpha threshold of a bake


def check_memory(field: Field, box: Box, voxel_grid: VoxelGrid, voxel_bytes: int, available: int | None = None) -> int:
    """The memory that a bake will need, bytes (an estimate). Raises SnergError, with the largest resolution that fits, if there is less.

    voxel_bytes: bytes of a voxel of the atlas. available: free memory, bytes; None asks `available_bytes`. Occupied blocks are counted
    only when a bake with every block occupied would not fit.
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
    gigabytes = f"about {file_size(needed)} of memory, and {file_size(available)} are free"
    if low < 2:
        raise SnergError(f"Baking needs {gigabytes}; close other programs, or make the box smaller.")
    raise SnergError(f"A bake of {max(voxel_grid.shape) - 2} voxels along the longest side needs {gigabytes}; choose at most {low}.")


def bytes_needed(blocks: int, voxel_bytes: int) -> int:
    """Peak memory, bytes, of a bake of so many blocks; voxel_bytes: bytes of a voxel of the atlas."""
    return FIXED_BYTES + int(blocks * CELL_VOXELS**3 * voxel_bytes * PEAK_FACTOR)


def occupied_points(field: Field, box: Box) -> tuple[NDArray[Any], float]:
    """Centres [N, 3] of the voxels of a coarse grid in the box that the field occupies, and the size of these voxels."""
    voxel_grid = VoxelGrid.inside(box, float(box.size.max()) / (PROBE_RESOLUTION if field.occupancy is not None else PROBE_RESOLUTION // 2))
    found = []
    for x in range(voxel_grid.shape[0]):  # a slice at a time bounds the memory
        plane = np.stack(np.meshgrid(x, *(np.arange(n) for n in voxel_grid.shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
        points = voxel_grid.voxel_centres(plane)
        points = points[field.holds(field.domain.from_world(points))]
        if len(points):
            depth = optical_depth(np, field.query(points)[0], np.float32(voxel_grid.voxel_size))
            found.append(points[depth > OCCUPIED_DEPTH])
    return np.concatenate(found) if found else np.zeros((0, 3)), voxel_grid.voxel_size


def count_blocks(cubes: tuple[NDArray[Any], float], voxel_grid: VoxelGrid) -> int:
    """Number of blocks of a grid that intersect cubes, given as `occupied_points` does: centres [N, 3] and size. Cubes are taken as aligned
    with the grid, so the number is an estimate in a rotated box."""
    centres, size = cubes
    middle = (centres - voxel_grid.grid_to_world[:3, 3]) @ voxel_grid.grid_to_world[:3, :3] / voxel_grid.voxel_size
    half = size / voxel_grid.voxel_size / 2
    first, last = (np.floor((middle + sign * half) / DATA_VOXELS).astype(np.int64) for sign in (-1, 1))
    return int(blocks_in_ranges(first, last, voxel_grid.blocks).sum())


def available_bytes() -> int | None:
    """Free memory in bytes, as the operating system reports it; the installed memory where it reports only that; None where neither."""
    free = _windows_bytes() if sys.platform == "win32" else _linux_bytes() if sys.platform == "linux" else None
    if free is None and hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return free


def _linux_bytes() -> int | None:
    """MemAvailable of the kernel (what can be used without swapping), limited by the memory limit of the container, if any."""
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
