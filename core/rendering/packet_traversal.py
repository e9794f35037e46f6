"""From rays of the world to where they first may meet something in the grid, in voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.ndc import space_rays
from ..scene.scene import Scene
from .acceleration import BRICK_VOXELS, Acceleration
from .ray_marcher import STEP_EPSILON
from .ray_queue import RayBatch

PACKET_RAYS = 64  # neighbouring rays that go through empty space together


def intersect_grid(
    scene: Scene, origins: NDArray[Any], directions: NDArray[Any], near: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Rays of the world in voxel coordinates, re-based to where they enter the grid.

    Returns point of entry and direction [3, N] (both float32), and the distances in voxels [N] at which the
    ray starts and stops, from where it begins (the eye, or NDC's near plane); stop is -1 where it misses. Everything up to here is
    float64, so a scene far from the origin is as steady as one at it (hard case 6); a direction of 0 along an axis is a miss or all
    of it (31, 32).
    """
    rotation = scene.grid_to_world[:3, :3]
    origins, directions, begins, _ = space_rays(scene.ndc, origins, directions, near)
    local = rotation.T @ (origins - scene.grid_to_world[:3, 3]).T
    local /= scene.voxel_size
    towards = rotation.T @ directions.T
    start, stop = begins / scene.voxel_size, np.full(len(origins), np.inf)
    first = np.full(len(origins), -np.inf)
    for place, along, size in zip(local, towards, scene.shape, strict=True):
        flat = np.abs(along) < 1e-12
        inverse = 1 / np.where(flat, 1, along)
        low, high = -place * inverse, (size - place) * inverse
        inside = (place >= 0) & (place <= size)
        np.maximum(first, np.where(flat, np.where(inside, -np.inf, np.inf), np.minimum(low, high)), out=first)
        np.minimum(stop, np.where(flat, np.where(inside, np.inf, -np.inf), np.maximum(low, high)), out=stop)
    start = np.maximum(first, start)
    met = (start < stop) & (first < stop) & np.isfinite(start)
    start = np.where(met, start, 0)
    local += towards * start
    return local.astype(np.float32), towards.astype(np.float32), start, np.where(met, stop, -1)


def start_batch(
    tables: Acceleration, entry: NDArray[Any], direction: NDArray[Any], start: NDArray[Any], stop: NDArray[Any], skip: bool, first: int = 0
) -> RayBatch:
    """What `enter` found as rays ready to march: those that may meet something, at the first sample that can matter. first: the number
    of the first of them."""
    ends = np.ceil(stop - start - 0.5).astype(np.float32)
    ready = ends > 0
    t = np.full(len(ends), np.float32(0.5))
    if skip and ready.any():
        t += skip_by_packets(tables, entry, direction, start, ends, ready)
        ready &= t < ends
    index = np.flatnonzero(ready)
    moving = np.concatenate([entry[:, index], direction[:, index], t[None, index], ends[None, index]])
    return RayBatch.new(index + first, moving, tables.channels)


def skip_by_packets(
    tables: Acceleration, entry: NDArray[Any], direction: NDArray[Any], start: NDArray[Any], ends: NDArray[Any], ready: NDArray[Any]
) -> NDArray[Any]:
    """How many samples of each ray [N] come before anything that its bundle could meet: float32, whole numbers.

    At a distance s a bundle is a cube around a ray of its own, which grows in proportion to s; the bundle goes on as long as that
    cube is among empty bricks. s is counted for all from the place of the first of its rays to enter the grid.
    """
    count = len(ends)
    groups = -(-count // PACKET_RAYS)

    def grouped(values: NDArray[Any]) -> NDArray[Any]:
        missing = groups * PACKET_RAYS - count
        padded = np.concatenate([values, values[..., -1:].repeat(missing, axis=-1)], axis=-1) if missing else values
        return padded.reshape(*values.shape[:-1], groups, PACKET_RAYS)

    there = grouped(ready)
    some = there.any(axis=-1)
    begins = np.where(there, grouped(start), np.inf).min(axis=-1)
    begins = np.where(some, begins, 0)
    lag = np.where(ready, start - begins.repeat(PACKET_RAYS)[:count], 0).astype(np.float32)
    place = grouped(entry - direction * lag)
    low, high = np.where(there, place, np.inf).min(axis=-1), np.where(there, place, -np.inf).max(axis=-1)
    low, high = np.where(some, low, 0), np.where(some, high, 0)
    toward = grouped(direction)
    slow, fast = toward.min(axis=-1), toward.max(axis=-1)
    last = np.where(there, grouped(ends + lag), -np.inf).max(axis=-1)
    reached = empty_distance(tables, (low + high) / 2, (slow + fast) / 2, (high - low) / 2, (fast - slow) / 2, last)
    return np.maximum(np.ceil(reached.repeat(PACKET_RAYS)[:count] - lag - (STEP_EPSILON + np.float32(0.5))), 0)


def empty_distance(
    tables: Acceleration, centre: NDArray[Any], along: NDArray[Any], radius: NDArray[Any], growth: NDArray[Any], last: NDArray[Any]
) -> NDArray[Any]:
    """Distance [G] up to which a cube around centre + s * along, of half a side radius + s * growth (all [3, G]), meets nothing
    that is not empty; at least `last` where that is nowhere."""
    bricks = np.array(tables.bricks)[:, None]
    strides = np.array([tables.bricks[1] * tables.bricks[2], tables.bricks[2], 1])
    reached = np.zeros(len(last), np.float32)
    rows = np.flatnonzero(last > 0)
    while len(rows):
        s = reached[rows]
        point = centre[:, rows] + along[:, rows] * s
        brick = np.clip((point * np.float32(1 / BRICK_VOXELS)).astype(np.int64), 0, bricks - 1)
        empty = tables.brick_distance.take(strides @ brick).astype(np.int64)
        # The cube of empty bricks; past the grid's own faces there is nothing.
        lowest = np.where(brick - empty < 0, -np.inf, BRICK_VOXELS * (brick - empty + 1))
        highest = np.where(brick + empty >= bricks, np.inf, BRICK_VOXELS * (brick + empty))
        half = radius[:, rows] + growth[:, rows] * s
        behind, ahead = point - half - lowest, highest - point - half
        steps = np.minimum(ahead / np.maximum(along[:, rows] + growth[:, rows], 1e-9), 1e9)
        steps = np.where(along[:, rows] + growth[:, rows] > 0, steps, 1e9)
        back = growth[:, rows] - along[:, rows]
        steps = np.minimum(steps, np.where(back > 0, behind / np.maximum(back, 1e-9), 1e9)).min(axis=0)
        inside = (np.minimum(behind, ahead).min(axis=0) >= 0) & (empty > 0)
        steps = np.where(inside, steps, 0)
        reached[rows] += steps
        rows = rows[(steps >= 1) & (reached[rows] < last[rows])]
    return reached
