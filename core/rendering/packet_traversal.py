"""Packet traversal: from rays in the world to the first sample of each that can hit something, found for 64 neighbouring rays at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.ndc import space_rays
from ..scene.scene import Scene
from .acceleration import BRICK_VOXELS, Acceleration
from .ray_marcher import STEP_EPSILON
from .ray_queue import RayBatch

PACKET_RAYS = 64  # consecutive rays that traverse empty space together: a tile of 8 x 8 pixels
# Voxels along the grid's longest side up to which rays are marched in single precision: at 1000 voxels a picture is off by 6e-5, and the
# error grows with the side. Beyond it positions and sums have double precision, which takes about a quarter longer.
MAX_SINGLE_VOXELS = 1024
UNBOUNDED = 1e9  # voxels: a distance along an axis that no ray in a grid reaches
PARALLEL_EPSILON = 1e-12  # magnitude of a direction's component (float64) below which the ray is parallel to the slab's faces


def ray_type(scene: Scene) -> type[np.floating[Any]]:
    """The type of the positions and sums of a scene's rays: float32, or float64 where the grid is longer than MAX_SINGLE_VOXELS."""
    return np.float32 if max(scene.shape) <= MAX_SINGLE_VOXELS else np.float64


def intersect_grid(
    scene: Scene, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any] | float, far: NDArray[Any] | None = None
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Clip rays of the world against the grid (slab test) and express them in voxels.

    origins, directions: [N, 3] float64, directions of unit length. near, far: world units along the ray, [N] or one for all, between
    which it sees; far is infinite where it is None.

    Returns the entry point and the unit direction, both [3, N] of `ray_type` in voxel coordinates, and the distances [N] float64, in voxels
    from the ray's origin (in NDC: from the near plane), at which the ray enters and leaves the grid; the latter is -1 for a miss.

    Float64 up to the entry point keeps scenes far from the origin exact (hard case 6). A ray parallel to a face is either inside that
    slab for its whole length or misses the grid (hard cases 31, 32).
    """
    rotation = scene.grid_to_world[:3, :3]
    origins, directions, begins, ends = space_rays(scene.ndc, origins, directions, near, far)
    local = rotation.T @ (origins - scene.grid_to_world[:3, 3]).T
    local /= scene.voxel_size
    local_directions = rotation.T @ directions.T
    start, stop = begins / scene.voxel_size, np.full(len(origins), np.inf) if far is None else ends / scene.voxel_size
    enters = np.full(len(origins), -np.inf)
    for origin, direction, size in zip(local, local_directions, scene.shape, strict=True):
        parallel = np.abs(direction) < PARALLEL_EPSILON
        inverse = 1 / np.where(parallel, 1, direction)
        low, high = -origin * inverse, (size - origin) * inverse
        inside = (origin >= 0) & (origin <= size)
        np.maximum(enters, np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(low, high)), out=enters)
        np.minimum(stop, np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(low, high)), out=stop)
    start = np.maximum(enters, start)
    hit = (start < stop) & (enters < stop) & np.isfinite(start)
    start = np.where(hit, start, 0)
    local += local_directions * start
    kind = ray_type(scene)
    return local.astype(kind), local_directions.astype(kind), start, np.where(hit, stop, -1)


def start_batch(
    acceleration: Acceleration,
    entry: NDArray[Any],
    direction: NDArray[Any],
    start: NDArray[Any],
    stop: NDArray[Any],
    skip: bool,
    first_index: int = 0,
) -> RayBatch:
    """The rays of `intersect_grid` that may hit an occupied voxel, each at its first relevant sample.

    entry, direction: [3, N]; start, stop: [N] (see `intersect_grid`). skip: traverse empty space first; otherwise every ray starts where it
    enters the grid. first_index: number of the first ray.
    """
    t_end = np.ceil(stop - start - 0.5).astype(np.float32)
    hits = t_end > 0
    t = np.full(len(t_end), np.float32(0.5))
    if skip and hits.any():
        t += skip_by_packets(acceleration, entry, direction, start, t_end, hits)
        hits &= t < t_end
    index = np.flatnonzero(hits)
    state = np.concatenate([entry[:, index], direction[:, index], t[None, index], t_end[None, index]])
    return RayBatch.unmarched(index + first_index, state, acceleration.channels)


def skip_by_packets(
    acceleration: Acceleration,
    entry: NDArray[Any],
    direction: NDArray[Any],
    start: NDArray[Any],
    t_end: NDArray[Any],
    hits: NDArray[Any],
) -> NDArray[Any]:
    """Samples [N] float32 (whole numbers) that each ray may skip because its packet is still in empty space.

    A packet is bounded by a cube around a central ray, whose half side grows linearly with the distance s. The packet goes on while this
    cube lies in empty bricks. s is measured from where the packet's first ray enters the grid. hits: bool [N], the rays in the grid.
    """
    count = len(t_end)
    packets = -(-count // PACKET_RAYS)

    def by_packet(values: NDArray[Any]) -> NDArray[Any]:
        """[..., N] to [..., packets, 64]; the last ray is repeated in the last packet."""
        missing = packets * PACKET_RAYS - count
        padded = np.concatenate([values, values[..., -1:].repeat(missing, axis=-1)], axis=-1) if missing else values
        return padded.reshape(*values.shape[:-1], packets, PACKET_RAYS)

    used = by_packet(hits)
    any_used = used.any(axis=-1)
    packet_start = np.where(used, by_packet(start), np.inf).min(axis=-1)
    packet_start = np.where(any_used, packet_start, 0)
    lag = np.where(hits, start - packet_start.repeat(PACKET_RAYS)[:count], 0).astype(np.float32)
    point = by_packet(entry - direction * lag)
    low, high = np.where(used, point, np.inf).min(axis=-1), np.where(used, point, -np.inf).max(axis=-1)
    low, high = np.where(any_used, low, 0), np.where(any_used, high, 0)
    directions = by_packet(direction)
    least, most = directions.min(axis=-1), directions.max(axis=-1)
    last = np.where(used, by_packet(t_end + lag), -np.inf).max(axis=-1)
    reached = empty_distance(acceleration, (low + high) / 2, (least + most) / 2, (high - low) / 2, (most - least) / 2, last)
    skipped: NDArray[Any] = np.ceil(reached.repeat(PACKET_RAYS)[:count] - lag - (STEP_EPSILON + np.float32(0.5)))
    return np.maximum(skipped, 0)


def empty_distance(
    acceleration: Acceleration,
    centre: NDArray[Any],
    direction: NDArray[Any],
    half_size: NDArray[Any],
    growth: NDArray[Any],
    last: NDArray[Any],
) -> NDArray[Any]:
    """Distance s [P] float32, voxels, up to which a growing box of each packet lies in empty bricks; at least `last` if it leaves the grid.

    The box has its centre at centre + s * direction and the half size half_size + s * growth, all [3, P]. last: [P].
    """
    bricks = np.array(acceleration.bricks)[:, None]
    strides = np.array([acceleration.bricks[1] * acceleration.bricks[2], acceleration.bricks[2], 1])
    reached = np.zeros(len(last), np.float32)
    rows = np.flatnonzero(last > 0)
    while len(rows):
        s = reached[rows]
        point = centre[:, rows] + direction[:, rows] * s
        brick = np.clip((point * np.float32(1 / BRICK_VOXELS)).astype(np.int64), 0, bricks - 1)
        empty = acceleration.brick_distance.take(strides @ brick).astype(np.int64)
        # The cube of empty bricks around the centre's brick; outside the grid everything is empty.
        lowest = np.where(brick - empty < 0, -np.inf, BRICK_VOXELS * (brick - empty + 1))
        highest = np.where(brick + empty >= bricks, np.inf, BRICK_VOXELS * (brick + empty))
        half = half_size[:, rows] + growth[:, rows] * s
        room_below, room_above = point - half - lowest, highest - point - half
        steps = _until_passed(room_above, growth[:, rows] + direction[:, rows])
        steps = np.minimum(steps, _until_passed(room_below, growth[:, rows] - direction[:, rows])).min(axis=0)
        inside = (np.minimum(room_below, room_above).min(axis=0) >= 0) & (empty > 0)
        steps = np.where(inside, steps, 0)
        reached[rows] += steps
        rows = rows[(steps >= 1) & (reached[rows] < last[rows])]
    return reached


def _until_passed(room: NDArray[Any], speed: NDArray[Any]) -> NDArray[Any]:
    """Distance [3, P] after which a face that moves at `speed` has used up its room; at most UNBOUNDED, also for one that moves away."""
    return np.where(speed > 0, np.minimum(room / np.maximum(speed, 1e-9), UNBOUNDED), UNBOUNDED)
