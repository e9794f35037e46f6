"""Marches batches of rays through a baked scene, in NumPy (section 5.2).

One batch fits the processor's caches. All its rays take a step together; when many have ended, new rays take their places. Each quantity
of a ray lies in a row of its own (RayBatch.state): NumPy is fast on long rows and slow on rows of three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .acceleration import BRICK_VOXELS, STRIDES, Acceleration
from .interpolator import MAX_INTERPOLATED, Interpolator
from .ray_queue import DIRECTION, DONATE_BELOW, ENTRY, T_END, RayBatch, RayQueue, T

# Samples of a ray that are composited together from an occupied stencil on: the next stencils are mostly occupied too, and the samples
# share the overhead of each NumPy call.
SAMPLES_PER_PASS = 4
STEP_EPSILON = np.float32(1e-2)  # voxels by which a jump stays short of the computed exit; the spacing of float32 at 4096 voxels is 5e-4
PARALLEL_EPSILON = np.float32(1e-7)  # smallest magnitude of a direction's component that is divided by
COMPACT_BELOW = 0.85  # share of a batch's rays still marching below which the ended ones are replaced; replacing copies the batch


@dataclass(frozen=True, eq=False)
class MarchOutput:
    """Results of all rays of a march, filled in as rays end: values [N, C] and transmittance [N] (see RayBatch)."""

    values: NDArray[Any]
    transmittance: NDArray[Any]


RecordSamples = Callable[[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], None]
"""Called with the samples of a pass: ray numbers [n], distances t from the entry point [n], and stencils as `find_stencils` returns them,
base [n] and fraction [3, n]. Threads call it in any order, so that whoever needs the samples of a ray in order sorts them by t."""
ViewResidual = Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], NDArray[Any]]
"""(straight colour [n, 3], straight features [n, 4], ray numbers [n]) to the view-dependent residual [n, 3] of eq. 7."""


class RayMarcher:
    """Marches one batch of rays, refilled from a queue; each thread has its own.

    queue: source of the rays, to which few remaining ones may be donated. output: where finished rays are written.
    batch_size: rays marched together. stop_transmittance: a ray ends when its transmittance is not above this.
    skip: jump over empty bricks and voxels; without, every sample is visited, with the same result.
    visited: bool [M * 32^3] or None; set to True at the voxel nearest to each sample whose stencil is occupied.
    view_residual: evaluates view dependence at every sample (the ablation of table 1); None evaluates none.
    record: is given every sample whose stencil is occupied, and a few that lie behind the sample with which a ray ends.
    cancelled: asked once a step; True ends the march.
    """

    def __init__(
        self,
        acceleration: Acceleration,
        queue: RayQueue,
        output: MarchOutput,
        batch_size: int,
        stop_transmittance: float,
        skip: bool = True,
        visited: NDArray[Any] | None = None,
        view_residual: ViewResidual | None = None,
        cancelled: Callable[[], bool] = lambda: False,
        record: RecordSamples | None = None,
    ) -> None:
        self.acceleration, self.queue, self.output, self.batch_size = acceleration, queue, output, batch_size
        self.stop_transmittance, self.skip, self.cancelled = np.float32(stop_transmittance), skip, cancelled
        self.visited, self.view_residual, self.record = visited, view_residual, record
        self.interpolate = Interpolator(acceleration)
        # Brick numbers are computed in floats, which are exact up to 2^24 (single precision).
        self.number_type = np.float32 if math.prod(acceleration.bricks) < 2**24 else np.float64
        self.samples = 0
        self.set_batch(RayBatch.empty(acceleration.channels))

    def set_batch(self, rays: RayBatch) -> None:
        """March these rays next."""
        self.rays = rays
        self.index, self.transmittance, self.values = rays.index, rays.transmittance, rays.values
        self.entry, self.direction = rays.state[ENTRY], rays.state[DIRECTION]  # views: one name a row
        self.t, self.t_end = rays.state[T], rays.state[T_END]
        self.alive = np.ones(len(rays.index), bool)

    def run(self) -> None:
        """March until the queue is empty; returns early when `cancelled` says so."""
        self.compact()
        while len(self.index) and not self.cancelled():
            self.step()
            np.less(self.t, self.t_end, out=self.alive)
            self.alive &= self.transmittance > self.stop_transmittance
            if np.count_nonzero(self.alive) < COMPACT_BELOW * len(self.alive):
                self.compact()

    def compact(self) -> None:
        """Write out the rays that have ended and refill the batch from the queue."""
        ended = np.flatnonzero(~self.alive)
        self.output.values[self.index[ended]] = self.values[ended]
        self.output.transmittance[self.index[ended]] = self.transmittance[ended]
        self.queue.record(len(ended), self.samples)
        self.samples = 0
        rays = self.rays.take(np.flatnonzero(self.alive))
        rays = RayBatch.concatenate([rays, *self.take_rays(self.batch_size - len(rays.index), not len(rays.index))])
        if 0 < len(rays.index) <= DONATE_BELOW and self.queue.donate(rays):
            rays = rays.part(slice(0))
        self.set_batch(rays)
        self.allocate()

    def take_rays(self, limit: int, idle: bool) -> list[RayBatch]:
        """At most `limit` rays from the queue, in parts. idle: the batch is empty."""
        parts: list[RayBatch] = []
        while limit > 0 and not self.cancelled() and (part := self.queue.take(limit, idle)) is not None:
            parts.append(part)
            limit -= len(part.index)
            idle &= not len(part.index)
        return parts

    def allocate(self) -> None:
        """Compute what depends on the directions alone, and allocate the buffers of `step`."""
        count = len(self.index)
        inverse = 1 / np.where(np.abs(self.direction) < PARALLEL_EPSILON, PARALLEL_EPSILON, self.direction)
        self.brick_t = np.float32(BRICK_VOXELS) * inverse  # [3, N] signed t to cross a brick along each axis
        self.voxel_t = np.abs(inverse)  # [3, N] t to cross a voxel along each axis
        self.fastest_voxel_t = np.minimum(np.minimum(self.voxel_t[0], self.voxel_t[1]), self.voxel_t[2])  # [N] least of the three
        self.point = np.empty((3, count), self.rays.state.dtype)
        self.brick, self.brick_offset, self.exit_t = (np.empty((3, count), np.float32) for _ in range(3))
        self.half_width, self.advance = np.empty(count, np.float32), np.empty(count, np.float32)
        self.distance = np.empty(count, np.uint8)

    def step(self) -> None:
        """Composite the current sample of each ray where its stencil is occupied, and move the ray to its next relevant sample."""
        np.multiply(self.direction, self.t, out=self.point)
        self.point += self.entry
        self.locate_bricks()
        in_occupied_brick = np.flatnonzero((self.distance == 0) & self.alive)
        if self.skip:
            self.skip_empty_bricks()
        else:
            self.advance.fill(1)
        if len(in_occupied_brick):
            self.march_occupied_bricks(in_occupied_brick)
        self.t += self.advance

    def locate_bricks(self) -> None:
        """Find the brick of each ray's point, the offset from the brick's centre (-0.5 to 0.5 bricks) and `brick_distance`."""
        np.multiply(self.point, np.float32(1 / BRICK_VOXELS), out=self.brick_offset)
        np.trunc(self.brick_offset, out=self.brick)
        self.brick_offset -= self.brick
        self.brick_offset -= np.float32(0.5)
        self.brick_number = self.flat_brick_number(self.brick)
        self.acceleration.brick_distance.take(self.brick_number, out=self.distance, mode="clip")

    def brick_number_at(self, point: NDArray[Any]) -> NDArray[Any]:
        """Numbers [n] of the bricks that contain points [3, n], in voxels."""
        brick = point * np.float32(1 / BRICK_VOXELS)
        return self.flat_brick_number(np.trunc(brick, out=brick))

    def flat_brick_number(self, brick: NDArray[Any]) -> NDArray[Any]:
        """Numbers [n] int64 of bricks at coordinates [3, n], x slowest; float32 whole numbers."""
        _, y, z = self.acceleration.bricks
        number: NDArray[Any] = np.multiply(brick[0], self.number_type(y), dtype=self.number_type)
        number += brick[1]
        number *= self.number_type(z)
        number += brick[2]
        return number.astype(np.int64)

    def skip_empty_bricks(self) -> None:
        """Set `advance` to the whole t that leaves the cube of empty bricks around each ray's brick: STEP_EPSILON early, never late.

        A brick at distance d of the nearest occupied one is the centre of an empty cube of 2 d - 1 bricks.
        """
        np.multiply(self.distance, np.float32(BRICK_VOXELS), out=self.half_width)
        self.half_width -= np.float32(BRICK_VOXELS / 2)
        np.multiply(self.voxel_t, self.half_width, out=self.exit_t)
        self.brick_offset *= self.brick_t
        self.exit_t -= self.brick_offset
        advance = self.advance
        np.minimum(self.exit_t[0], self.exit_t[1], out=advance)
        np.minimum(advance, self.exit_t[2], out=advance)
        advance -= STEP_EPSILON
        np.maximum(advance, 0, out=advance)
        np.trunc(advance, out=advance)
        advance += 1

    def march_occupied_bricks(self, rows: NDArray[Any]) -> None:
        """For rays [n] in occupied bricks: skip empty voxels inside the brick, or composite samples."""
        base, _ = self.find_stencils(self.point.take(rows, axis=1), self.brick_number.take(rows))
        distance = self.acceleration.voxel_skip.take(base)
        if self.skip:
            advance = np.maximum(distance, 1).astype(np.float32)
            advance -= 1
            advance *= self.fastest_voxel_t.take(rows)
            self.advance[rows] = np.trunc(advance) + 1
        occupied = rows[distance == 0]
        limit = MAX_INTERPOLATED // SAMPLES_PER_PASS
        for start in range(0, len(occupied), limit):
            self.composite(occupied[start : start + limit])

    def find_stencils(self, point: NDArray[Any], brick_number: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """The trilinear stencils (cubes of 8 voxels) that contain points [3, n] in bricks [n].

        Returns the index [n] of each stencil's lowest corner in Acceleration.voxels, and the point's fraction in it [3, n] float32, in
        [0, 1]; `point` is overwritten.
        """
        point += np.float32(0.5)
        corner = np.trunc(point)
        point -= corner
        corner[0] *= np.float32(STRIDES[0])
        corner[1] *= np.float32(STRIDES[1])
        corner[0] += corner[1]
        corner[0] += corner[2]
        base = self.acceleration.brick_base.take(brick_number, mode="clip")
        base += corner[0].astype(np.int64)
        return base, point.astype(np.float32, copy=False)

    def composite(self, rows: NDArray[Any]) -> None:
        """Composite the next SAMPLES_PER_PASS samples of rays [n] front to back (eqs. 5, 6)."""
        count = len(rows)
        self.samples += SAMPLES_PER_PASS * count
        state = self.rays.state.take(rows, axis=1)
        t = (state[T] + np.arange(SAMPLES_PER_PASS, dtype=np.float32)[:, None]).reshape(-1)
        point = (state[DIRECTION, None] * t.reshape(SAMPLES_PER_PASS, count) + state[ENTRY, None]).reshape(3, -1)
        brick_number = self.brick_number_at(point)
        used = self.acceleration.brick_distance.take(brick_number, mode="clip") == 0
        used &= t < np.tile(state[T_END], SAMPLES_PER_PASS)
        base, fraction = self.find_stencils(point, brick_number)
        if self.record is not None:
            self.record_occupied(rows, t, base, fraction, used)
        values = self.interpolate(base, fraction)
        if self.view_residual is not None:
            self.add_view_dependence(values, np.tile(self.index.take(rows), SAMPLES_PER_PASS))
        transmittance = self.transmittance.take(rows)
        weight = (used * np.float32(1 / self.acceleration.unit)).reshape(SAMPLES_PER_PASS, count)
        alpha = values[:, -1].reshape(SAMPLES_PER_PASS, count) * weight
        for sample in range(SAMPLES_PER_PASS):
            weight[sample] *= transmittance
            if self.visited is not None:
                self.mark_visited(base, fraction, used, sample, transmittance)
            transmittance -= transmittance * alpha[sample]
        self.transmittance[rows] = np.maximum(transmittance, 0)
        values[:, -1] *= t
        self.add_values(rows, np.einsum("kn,knc->nc", weight, values.reshape(SAMPLES_PER_PASS, count, -1)))
        self.advance[rows] = SAMPLES_PER_PASS

    def record_occupied(self, rows: NDArray[Any], t: NDArray[Any], base: NDArray[Any], fraction: NDArray[Any], used: NDArray[Any]) -> None:
        """Give `record` the used samples of a pass, [SAMPLES_PER_PASS * n] of rays [n], whose stencil is occupied."""
        assert self.record is not None
        some = np.flatnonzero(used)
        some = some[self.acceleration.voxel_skip[base[some]] == 0]
        self.record(np.tile(self.index.take(rows), SAMPLES_PER_PASS)[some], t[some], base[some], fraction[:, some])

    def add_values(self, rows: NDArray[Any], values: NDArray[Any]) -> None:
        """Add values [n, C] to those of rays [n]; each row is written as one item of void type, which NumPy scatters fastest."""
        total = self.values.take(rows, axis=0)
        total += values
        row_type = np.dtype((np.void, total.itemsize * total.shape[1]))
        self.values.view(row_type)[rows] = total.view(row_type)

    def mark_visited(
        self, base: NDArray[Any], fraction: NDArray[Any], used: NDArray[Any], sample: int, transmittance: NDArray[Any]
    ) -> None:
        """Set `visited` for one sample of each of n rays, where its stencil is occupied and the ray has not ended before it.

        base, fraction, used: of all samples, [SAMPLES_PER_PASS * n] (fraction [3, ...]); transmittance: [n], in front of the sample.
        """
        assert self.visited is not None
        part = slice(sample * len(transmittance), (sample + 1) * len(transmittance))
        rows = part.start + np.flatnonzero(used[part] & (transmittance > self.stop_transmittance))
        rows = rows[self.acceleration.voxel_skip[base[rows]] == 0]
        self.visited[base[rows] + np.array(STRIDES) @ (fraction[:, rows] >= 0.5)] = True

    def add_view_dependence(self, values: NDArray[Any], index: NDArray[Any]) -> None:
        """Add alpha times the view-dependent residual to the colour of samples [n, C] of rays [n], in place."""
        assert self.view_residual is not None
        rows = np.flatnonzero(values[:, -1] > 0)
        premultiplied = values[rows]
        straight = premultiplied[:, :-1] / premultiplied[:, -1:]
        values[rows, :3] += premultiplied[:, -1:] * self.view_residual(straight[:, :3], straight[:, 3:], index[rows])
