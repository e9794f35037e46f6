"""The work queue of the marching threads: chunks of rays still to be set up, and batches that a thread put back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Rows of RayBatch.state.
ENTRY, DIRECTION = slice(0, 3), slice(3, 6)
T, T_END = 6, 7
STATE_ROWS = 8

# A thread with at most this many rays left donates them to another thread and ends: two threads with few rays each slow one another
# down through Python's lock. With it and larger chunks Lego at 512 voxels took 0.82 of the time (400 pixels, two cores).
DONATE_BELOW = 2048


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays inside the grid, in voxel units, with what they have accumulated so far.

    index: [N] int64, the ray's number among all rays of the march.
    state: [8, N] float32, or float64 in long grids (see packet_traversal.ray_type), one row a quantity (long rows are what NumPy is fast
        on). Rows ENTRY: the point where the ray enters the grid, voxels. DIRECTION: unit vector. T: distance from the entry point to
        the next sample, voxels; always k + 0.5 with k whole. T_END: samples with t >= t_end are outside the grid.
    transmittance: [N] of the same type, in [0, 1], of the part of the ray that is already marched.
    values: [N, C] of the same type, C = channels of the atlas: composited colour and features, and in place of alpha the sum of t times the
        contribution (transmittance times alpha) of each sample.
    """

    index: NDArray[Any]
    state: NDArray[Any]
    transmittance: NDArray[Any]
    values: NDArray[Any]

    @classmethod
    def unmarched(cls, index: NDArray[Any], state: NDArray[Any], channels: int) -> RayBatch:
        """Rays with numbers [N] and state [8, N] of which no sample is taken yet: transmittance 1, values 0."""
        return cls(index, state, np.ones(len(index), state.dtype), np.zeros((len(index), channels), state.dtype))

    @classmethod
    def empty(cls, channels: int) -> RayBatch:
        """A batch of no rays."""
        return cls.unmarched(np.zeros(0, np.int64), np.zeros((STATE_ROWS, 0), np.float32), channels)

    @classmethod
    def concatenate(cls, parts: Sequence[RayBatch]) -> RayBatch:
        """The rays of all parts, in order."""
        if len(parts) == 1:
            return parts[0]
        index, transmittance, values = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("index", "transmittance", "values")
        )
        return cls(index, np.concatenate([part.state for part in parts], axis=1), transmittance, values)

    def part(self, rows: slice) -> RayBatch:
        """A range of the rays, as views of the same memory."""
        return RayBatch(self.index[rows], self.state[:, rows], self.transmittance[rows], self.values[rows])

    def take(self, rows: NDArray[Any]) -> RayBatch:
        """Copies of the rays with these row numbers [n]."""
        return RayBatch(self.index.take(rows), self.state.take(rows, axis=1), self.transmittance.take(rows), self.values.take(rows, axis=0))


class RayQueue:
    """Gives rays to several marching threads. All methods may be called from any thread.

    chunks: all rays of the march as ranges, in order. make_batch: sets up the rays of one chunk and returns those that may hit an
    occupied voxel; it runs in the thread that takes the chunk. workers: how many threads are marching.

    finished: rays that are done, including those that hit nothing. samples: samples taken so far.
    """

    def __init__(self, make_batch: Callable[[slice], RayBatch], chunks: Sequence[slice], workers: int) -> None:
        self.make_batch, self.chunks, self.workers = make_batch, chunks, workers
        self.next_chunk = self.in_setup = self.finished = self.samples = 0
        self.ready: list[RayBatch] = []
        self.changed = threading.Condition()

    def take(self, limit: int, idle: bool) -> RayBatch | None:
        """At most `limit` rays, or None when none are available.

        idle: the calling thread has no rays of its own. It then waits while other threads set up chunks, and None tells it to end.
        """
        with self.changed:
            while not self.ready and self.next_chunk == len(self.chunks):
                if not idle:
                    return None
                if not self.in_setup:
                    self.workers -= 1
                    return None
                self.changed.wait()
            if self.ready:
                return self._split(self.ready.pop(), limit)
            chunk = self.chunks[self.next_chunk]
            self.next_chunk, self.in_setup = self.next_chunk + 1, self.in_setup + 1
        return self._set_up(chunk, limit)

    def _set_up(self, chunk: slice, limit: int) -> RayBatch | None:
        """The first `limit` rays of a chunk; the others become ready for any thread."""
        batch = None
        try:
            batch = self.make_batch(chunk)
        finally:
            with self.changed:
                self.in_setup -= 1
                self.changed.notify_all()
                if batch is not None:
                    self.finished += chunk.stop - chunk.start - len(batch.index)
                    batch = self._split(batch, limit)
        return batch

    def _split(self, rays: RayBatch, limit: int) -> RayBatch:
        """The first `limit` rays; the others become ready for any thread. The lock must be held."""
        if len(rays.index) > limit:
            self.ready.append(rays.part(slice(limit, None)))
        return rays.part(slice(limit))

    def donate(self, rays: RayBatch) -> bool:
        """Put rays back for another thread; returns whether they were accepted, and then the calling thread must end.

        They are refused when no other thread is marching, or when the calling thread can still get more rays.
        """
        with self.changed:
            if self.workers == 1 or self.ready or self.in_setup or self.next_chunk < len(self.chunks):
                return False
            self.workers -= 1
            self.ready.append(rays)
            self.changed.notify_all()
            return True

    def record(self, finished: int, samples: int) -> None:
        """Add to the numbers of finished rays and of samples taken."""
        with self.changed:
            self.finished += finished
            self.samples += samples
