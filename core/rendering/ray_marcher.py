"""Rays on their way through the grid, a batch at a time, in NumPy.

A batch is what fits the caches. Its rays move on together, and as some end new ones take their places. What rays carry lies in one row
a quantity: NumPy is fast on long plain arrays, and slow on rows of three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .acceleration import BRICK_VOXELS, STRIDES, Acceleration
from .ray_queue import DONATE_BELOW, RayBatch, RayQueue

CORNER_OFFSETS = np.array([x * STRIDES[0] + y * STRIDES[1] + z for x in (0, 1) for y in (0, 1) for z in (0, 1)])
SAMPLES_PER_PASS = 4  # samples of a ray that are taken together
MAX_INTERPOLATED = 32768  # samples interpolated together, so many that threads rarely wait for Python
STEP_EPSILON = np.float32(1e-2)  # voxels by which a jump falls short of where it could end, far more than rounding
PARALLEL_EPSILON = np.float32(1e-7)  # a direction with less than this along an axis takes forever to leave a brick there


@dataclass(frozen=True, eq=False)
class MarchOutput:
    """Of all rays, written as they end: values [N, C] and transmittance [N], float32 (see `Rays`)."""

    values: NDArray[Any]
    through: NDArray[Any]


ViewResidual = Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], NDArray[Any]]
"""(colour [n, 3] over white, features [n, 4], number of the ray [n]) to what view dependence adds to the colour [n, 3]."""


class RayMarcher:
    """One batch.

    supply: where rays are from, which may be handed on there again. into: what comes of them. stop: a ray ends when less light than this
    passes. skip: whether it jumps over what is empty. visited: bool [M * 32^3] or None, set at voxels nearest to a sample that
    something is near to. residual: view dependence at every sample, None where there is none or it follows a pixel.
    """

    def __init__(
        self,
        tables: Acceleration,
        supply: RayQueue,
        into: MarchOutput,
        batch: int,
        stop: float,
        skip: bool = True,
        visited: NDArray[Any] | None = None,
        residual: ViewResidual | None = None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        self.tables, self.supply, self.into, self.batch = tables, supply, into, batch
        self.stop, self.skip, self.visited, self.residual, self.cancelled = np.float32(stop), skip, visited, residual, cancelled
        self.interpolate = Interpolator(tables)
        self.exact = np.float32 if math.prod(tables.bricks) < 2**24 else np.float64
        self.samples = 0
        self.hold(RayBatch.new(np.zeros(0, np.int64), np.zeros((8, 0), np.float32), tables.channels))

    def hold(self, rays: RayBatch) -> None:
        """Make these the batch."""
        self.index, self.moving, self.light, self.values = rays.index, rays.moving, rays.light, rays.values
        self.alive = np.ones(len(self.index), bool)

    def run(self) -> None:
        """March all that there is; returns early when `cancelled` says so."""
        self.pack()
        while len(self.index) and not self.cancelled():
            self.advance()
            np.less(self.moving[6], self.moving[7], out=self.alive)
            self.alive &= self.light > self.stop
            if np.count_nonzero(self.alive) < 0.85 * len(self.alive):
                self.pack()

    def pack(self) -> None:
        """Write down the rays that have ended, keep the others, and begin as many new ones as the batch has room for."""
        ended = np.flatnonzero(~self.alive)
        self.into.values[self.index[ended]] = self.values[ended]
        self.into.through[self.index[ended]] = self.light[ended]
        self.supply.count(len(ended), self.samples)
        self.samples = 0
        rays = RayBatch(self.index, self.moving, self.light, self.values).only(np.flatnonzero(self.alive))
        rays = RayBatch.joined([rays, *self.begin(self.batch - len(rays.index), not len(rays.index))])
        if 0 < len(rays.index) <= DONATE_BELOW and self.supply.hand(rays):
            rays = rays.some(slice(0))
        self.hold(rays)
        self.prepare()

    def begin(self, room: int, idle: bool) -> list[RayBatch]:
        """Up to `room` more rays. idle: there are none at present."""
        new: list[RayBatch] = []
        while room > 0 and not self.cancelled() and (more := self.supply.take(room, idle)) is not None:
            new.append(more)
            room -= len(more.index)
            idle &= not len(more.index)
        return new

    def prepare(self) -> None:
        """What follows from the directions, and room for what `advance` computes."""
        direction, count = self.moving[3:6], len(self.index)
        inverse = 1 / np.where(np.abs(direction) < PARALLEL_EPSILON, PARALLEL_EPSILON, direction)
        self.turns = np.float32(BRICK_VOXELS) * inverse  # t to cross a brick
        self.span = np.abs(inverse)
        self.pace = np.minimum(np.minimum(self.span[0], self.span[1]), self.span[2])  # t to move a voxel along the fastest axis
        self.point, self.brick, self.within, self.exit = (np.empty((3, count), np.float32) for _ in range(4))
        self.reach, self.ahead = np.empty(count, np.float32), np.empty(count, np.float32)
        self.distance = np.empty(count, np.uint8)

    def advance(self) -> None:
        """Take the sample that each ray stands at, and move it to the next that can matter."""
        entry, direction, t = self.moving[:3], self.moving[3:6], self.moving[6]
        np.multiply(direction, t, out=self.point)
        self.point += entry
        self.locate()
        near = np.flatnonzero((self.distance == 0) & self.alive)
        if self.skip:
            self.leave()
        else:
            self.ahead.fill(1)
        if len(near):
            self.look(near)
        t += self.ahead

    def locate(self) -> None:
        """In which brick each ray stands, where within it (-0.5 to 0.5), and how far the nearest is that holds something."""
        np.multiply(self.point, np.float32(1 / BRICK_VOXELS), out=self.within)
        np.trunc(self.within, out=self.brick)
        self.within -= self.brick
        self.within -= np.float32(0.5)
        self.number = self.numbered(self.brick)
        self.tables.brick_distance.take(self.number, out=self.distance, mode="clip")

    def numbers(self, point: NDArray[Any]) -> NDArray[Any]:
        """The bricks [n] that points [3, n] are in."""
        brick = point * np.float32(1 / BRICK_VOXELS)
        return self.numbered(np.trunc(brick, out=brick))

    def numbered(self, brick: NDArray[Any]) -> NDArray[Any]:
        """Numbers of bricks [n] from where they are [3, n]; computed in floats, of which the larger ones are for grids of 2^24 bricks."""
        _, y, z = self.tables.bricks
        place = np.multiply(brick[0], self.exact(y), dtype=self.exact)
        place += brick[1]
        place *= self.exact(z)
        place += brick[2]
        return place.astype(np.int64)

    def leave(self) -> None:
        """t to the first sample outside the cube of empty bricks around each ray's (a hair early, never late)."""
        np.multiply(self.distance, np.float32(BRICK_VOXELS), out=self.reach)
        self.reach -= np.float32(BRICK_VOXELS / 2)
        np.multiply(self.span, self.reach, out=self.exit)
        self.within *= self.turns
        self.exit -= self.within
        ahead = self.ahead
        np.minimum(self.exit[0], self.exit[1], out=ahead)
        np.minimum(ahead, self.exit[2], out=ahead)
        ahead -= STEP_EPSILON
        np.maximum(ahead, 0, out=ahead)
        np.trunc(ahead, out=ahead)
        ahead += 1

    def look(self, near: NDArray[Any]) -> None:
        """Rays [n] in bricks that hold something: jump within the brick, or take samples."""
        first, _ = self.tents(self.point.take(near, axis=1), self.number.take(near))
        distance = self.tables.voxel_skip.take(first)
        if self.skip:
            jump = np.maximum(distance, 1).astype(np.float32)
            jump -= 1
            jump *= self.pace.take(near)
            self.ahead[near] = np.trunc(jump) + 1
        hit = near[distance == 0]
        for start in range(0, len(hit), MAX_INTERPOLATED // SAMPLES_PER_PASS):
            self.sample(hit[start : start + MAX_INTERPOLATED // SAMPLES_PER_PASS])

    def tents(self, point: NDArray[Any], number: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """First voxel [n] of the tents that points [3, n] in bricks [n] are in, and where in them [3, n], which overwrites the points."""
        point += np.float32(0.5)
        tent = np.trunc(point)
        point -= tent
        tent[0] *= np.float32(STRIDES[0])
        tent[1] *= np.float32(STRIDES[1])
        tent[0] += tent[1]
        tent[0] += tent[2]
        first = self.tables.brick_base.take(number, mode="clip")
        first += tent[0].astype(np.int64)
        return first, point

    def sample(self, rows: NDArray[Any]) -> None:
        """Composite the next AHEAD samples of rays [n] that stand where something is, front to back.

        Rays that meet something mostly go on doing so; taking several samples at once shares what is spent on each.
        """
        count = len(rows)
        self.samples += SAMPLES_PER_PASS * count
        moving = self.moving.take(rows, axis=1)
        t = (moving[6] + np.arange(SAMPLES_PER_PASS, dtype=np.float32)[:, None]).reshape(-1)
        point = (moving[3:6, None] * t.reshape(SAMPLES_PER_PASS, count) + moving[:3, None]).reshape(3, -1)
        number = self.numbers(point)
        used = self.tables.brick_distance.take(number, mode="clip") == 0
        used &= t < np.tile(moving[7], SAMPLES_PER_PASS)
        first, fraction = self.tents(point, number)
        values = self.interpolate(first, fraction)
        if self.residual is not None:
            self.shade(values, np.tile(self.index.take(rows), SAMPLES_PER_PASS))
        light = self.light.take(rows)
        weight = (used * np.float32(1 / self.tables.unit)).reshape(SAMPLES_PER_PASS, count)
        alpha = values[:, -1].reshape(SAMPLES_PER_PASS, count) * weight
        for step in range(SAMPLES_PER_PASS):
            weight[step] *= light
            if self.visited is not None:
                self.visit(first, fraction, used, step, light)
            light -= light * alpha[step]
        self.light[rows] = np.maximum(light, 0)
        values[:, -1] *= t
        gathered = self.values.take(rows, axis=0)
        gathered += np.einsum("kn,knc->nc", weight, values.reshape(SAMPLES_PER_PASS, count, -1))
        whole = np.dtype((np.void, gathered.itemsize * gathered.shape[1]))  # rows are set quickest where one is one value
        self.values.view(whole)[rows] = gathered.view(whole)
        self.ahead[rows] = SAMPLES_PER_PASS

    def visit(self, first: NDArray[Any], fraction: NDArray[Any], used: NDArray[Any], step: int, light: NDArray[Any]) -> None:
        """Mark the voxels nearest to the samples [n] of one step that light still reached, where something is near."""
        assert self.visited is not None
        part = slice(step * len(light), (step + 1) * len(light))
        some = part.start + np.flatnonzero(used[part] & (light > self.stop))
        some = some[self.tables.voxel_skip[first[some]] == 0]
        self.visited[first[some] + np.array(STRIDES) @ (fraction[:, some] >= 0.5)] = True

    def shade(self, values: NDArray[Any], index: NDArray[Any]) -> None:
        """Add view dependence to samples [n, C] of rays [n]."""
        assert self.residual is not None
        opaque = np.flatnonzero(values[:, -1] > 0)
        seen = values[opaque]
        straight = seen[:, :-1] / seen[:, -1:]
        values[opaque, :3] += seen[:, -1:] * self.residual(straight[:, :3], straight[:, 3:], index[opaque])


class Interpolator:
    """Trilinear interpolation of voxels; its buffers are its own, so that a thread needs one of its own."""

    def __init__(self, tables: Acceleration) -> None:
        self.tables, self.whole = tables, tables.voxels.ndim == 1
        channels = tables.channels
        self.corners = [tables.voxels[corner:] for corner in CORNER_OFFSETS]
        self.words = np.empty(8 * MAX_INTERPOLATED, tables.voxels.dtype)
        self.values = np.empty(8 * MAX_INTERPOLATED * channels, np.float32)
        self.spare = np.empty(4 * MAX_INTERPOLATED * channels, np.float32)
        self.fractions = np.empty(MAX_INTERPOLATED * channels // 2, np.uint64)

    def __call__(self, first: NDArray[Any], fraction: NDArray[Any]) -> NDArray[Any]:
        """[n, C] float32, in units of the table; a view that the next call overwrites. At most SLICE samples."""
        count, channels = len(first), self.tables.channels
        values = self.values[: 8 * count * channels].reshape(8, -1)
        if self.whole:
            words = self.words[: 8 * count].reshape(8, -1)
            for corner, word in zip(self.corners, words, strict=True):
                corner.take(first, out=word, mode="clip")
            np.copyto(values, words.view(np.uint8))
        else:
            for corner, value in zip(self.corners, values.reshape(8, count, channels), strict=True):
                corner.take(first, axis=0, out=value, mode="clip")
        for axis, half in enumerate((4, 2, 1)):
            self.blend(values[:half], values[half : 2 * half], self.spread(fraction[axis]))
        return values[0].reshape(count, channels)

    def blend(self, low: NDArray[Any], high: NDArray[Any], part: NDArray[Any]) -> None:
        """low becomes low + part * (high - low)."""
        between = self.spare[: low.size].reshape(low.shape)
        np.subtract(high, low, out=between)
        between *= part
        low += between

    def spread(self, value: NDArray[Any]) -> NDArray[Any]:
        """[n] float32 to [n * C], each C times, which is quickest two at a time."""
        both = value.view(np.uint32).astype(np.uint64)
        both |= both << np.uint64(32)
        pairs = self.fractions[: len(value) * self.tables.channels // 2].reshape(len(value), -1)
        for i in range(pairs.shape[1]):
            pairs[:, i] = both
        return pairs.view(np.float32).reshape(-1)
