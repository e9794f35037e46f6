"""Rays that several walks march together: made when their turn comes, and handed on by a walk that has few left."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

DONATE_BELOW = 2048  # rays that one walk hands on to another: so few are as quick with those, and two walks in each other's way are not


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays within the grid, in voxels.

    index: [N] which they are among all. moving: [8, N] float32: the point of entry, the direction (of unit length), t at which
    the next sample is taken (k + 0.5, k whole), and t before which the last is. light: [N] what still passes. values: [N, C] what
    has been gathered, of which the last is the sum of t times the opacity that was seen there; float32.
    """

    index: NDArray[Any]
    moving: NDArray[Any]
    light: NDArray[Any]
    values: NDArray[Any]

    @classmethod
    def new(cls, index: NDArray[Any], moving: NDArray[Any], channels: int) -> RayBatch:
        """Rays that have met nothing yet."""
        return cls(index, moving, np.ones(len(index), np.float32), np.zeros((len(index), channels), np.float32))

    @classmethod
    def joined(cls, parts: Sequence[RayBatch]) -> RayBatch:
        """One after the other."""
        if len(parts) == 1:
            return parts[0]
        index, light, values = (np.concatenate([getattr(part, name) for part in parts]) for name in ("index", "light", "values"))
        return cls(index, np.concatenate([part.moving for part in parts], axis=1), light, values)

    def some(self, rows: slice) -> RayBatch:
        """Those of a stretch; nothing is copied."""
        return RayBatch(self.index[rows], self.moving[:, rows], self.light[rows], self.values[rows])

    def only(self, rows: NDArray[Any]) -> RayBatch:
        """Those of some rows."""
        return RayBatch(self.index.take(rows), self.moving.take(rows, axis=1), self.light.take(rows), self.values.take(rows, axis=0))


class RayQueue:
    """What `walks` walks, each in a thread of its own, take their rays from.

    shares: of all rays, in order; make: the rays of one that may meet something, called in the thread that comes for them. finished: how
    many rays are, those that meet nothing included; samples: how many were taken.
    """

    def __init__(self, make: Callable[[slice], RayBatch], shares: Sequence[slice], walks: int) -> None:
        self.make, self.shares, self.walks = make, shares, walks
        self.taken = self.making = self.finished = self.samples = 0
        self.ready: list[RayBatch] = []
        self.changed = threading.Condition()

    def take(self, room: int, idle: bool) -> RayBatch | None:
        """Up to `room` rays; None when there are none at present. idle: the walk has none of its own either; it waits for those that are
        being made, and None is its end."""
        with self.changed:
            while not self.ready and self.taken == len(self.shares):
                if not idle:
                    return None
                if not self.making:
                    self.walks -= 1
                    return None
                self.changed.wait()
            if self.ready:
                return self._cut(self.ready.pop(), room)
            share = self.shares[self.taken]
            self.taken, self.making = self.taken + 1, self.making + 1
        made = None
        try:
            made = self.make(share)
        finally:
            with self.changed:
                self.making -= 1
                self.changed.notify_all()
                if made is not None:
                    self.finished += share.stop - share.start - len(made.index)
                    made = self._cut(made, room)
        return made

    def _cut(self, rays: RayBatch, room: int) -> RayBatch:
        """Up to `room` of these; the rest is ready for the next who comes."""
        if len(rays.index) > room:
            self.ready.append(rays.some(slice(room, None)))
        return rays.some(slice(room))

    def hand(self, rays: RayBatch) -> bool:
        """Give rays to another walk, which will take them; then this one ends. False where no other is left, or there are
        more to take, or soon will be."""
        with self.changed:
            if self.walks == 1 or self.ready or self.making or self.taken < len(self.shares):
                return False
            self.walks -= 1
            self.ready.append(rays)
            self.changed.notify_all()
            return True

    def count(self, finished: int, samples: int) -> None:
        """So many more rays are finished, and samples taken."""
        with self.changed:
            self.finished += finished
            self.samples += samples
