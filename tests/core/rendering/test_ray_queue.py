"""Rays shared among walks: each is marched once, whoever takes it, and nobody leaves while rays are still being made."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from snerg.core.rendering.ray_queue import RayBatch, RayQueue


def rays(first: int, count: int) -> RayBatch:
    return RayBatch.new(np.arange(first, first + count), np.zeros((8, count), np.float32), 4)


def test_every_ray_is_given_once_in_parts_that_fit():
    supply = RayQueue(lambda some: rays(some.start, some.stop - some.start), [slice(0, 10), slice(10, 13)], 1)
    taken = []
    while (some := supply.take(4, idle=True)) is not None:
        assert len(some.index) <= 4
        taken += some.index.tolist()
    assert sorted(taken) == list(range(13))


def test_what_is_finished_and_taken_is_counted():
    supply = RayQueue(lambda some: rays(some.start, 3), [slice(0, 10)], 1)
    assert supply.take(8, idle=True) is not None
    assert supply.finished == 7, "those that meet nothing are, at once"
    supply.count(3, 40)
    assert (supply.finished, supply.samples) == (10, 40)


def test_rays_are_handed_on_only_to_a_walk_that_is_still_there():
    supply = RayQueue(lambda some: rays(some.start, some.stop - some.start), [slice(0, 3)], 2)
    assert not supply.hand(rays(0, 3)), "there is more to take"
    assert supply.take(8, idle=True) is not None
    assert supply.hand(rays(0, 3))
    assert (given := supply.take(8, idle=True)) is not None
    assert given.index.tolist() == [0, 1, 2]
    assert not supply.hand(given), "no other walk is left"
    assert supply.take(8, idle=True) is None


def test_an_idle_walk_waits_for_rays_that_another_is_making():
    made, asked = threading.Event(), threading.Event()

    def make(some: slice) -> RayBatch:
        asked.set()
        assert made.wait(10)
        return rays(some.start, some.stop - some.start)

    supply, found = RayQueue(make, [slice(0, 6)], 2), list[int]()

    def walk() -> None:
        while (some := supply.take(2, idle=True)) is not None:
            found.extend(some.index.tolist())

    walks = [threading.Thread(target=walk) for _ in range(2)]
    for one in walks:
        one.start()
    assert asked.wait(10)
    assert not supply.hand(rays(6, 1)), "there will be more to take"
    assert supply.take(2, idle=False) is None, "who has rays of its own goes on with those"
    assert supply.walks == 2, "the other has not ended"
    made.set()
    for one in walks:
        one.join(10)
    assert sorted(found) == list(range(6))
    assert supply.walks == 0


def test_rays_that_cannot_be_made_end_the_walk_and_not_the_others():
    def make(_some: slice) -> RayBatch:
        raise ValueError("no")

    supply = RayQueue(make, [slice(0, 6)], 2)
    with pytest.raises(ValueError, match="no"):
        supply.take(2, idle=True)
    assert supply.take(2, idle=True) is None
