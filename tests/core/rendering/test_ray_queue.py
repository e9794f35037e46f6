"""The ray queue: each ray is marched once, whichever thread takes it, and no thread ends while another still sets up rays."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from snerg.core.rendering.ray_queue import STATE_ROWS, RayBatch, RayQueue


def rays(first: int, count: int) -> RayBatch:
    return RayBatch.unmarched(np.arange(first, first + count), np.zeros((STATE_ROWS, count), np.float32), 4)


def test_every_ray_is_given_once_in_parts_that_fit():
    queue = RayQueue(lambda some: rays(some.start, some.stop - some.start), [slice(0, 10), slice(10, 13)], 1)
    taken = []
    while (some := queue.take(4, idle=True)) is not None:
        assert len(some.index) <= 4
        taken += some.index.tolist()
    assert sorted(taken) == list(range(13))


def test_finished_rays_and_samples_are_counted():
    queue = RayQueue(lambda some: rays(some.start, 3), [slice(0, 10)], 1)
    assert queue.take(8, idle=True) is not None
    assert queue.finished == 7, "rays that hit nothing are finished at once"
    queue.record(3, 40)
    assert (queue.finished, queue.samples) == (10, 40)


def test_rays_are_donated_only_to_a_thread_that_still_marches():
    queue = RayQueue(lambda some: rays(some.start, some.stop - some.start), [slice(0, 3)], 2)
    assert not queue.donate(rays(0, 3)), "there are more rays to take"
    assert queue.take(8, idle=True) is not None
    assert queue.donate(rays(0, 3))
    assert (given := queue.take(8, idle=True)) is not None
    assert given.index.tolist() == [0, 1, 2]
    assert not queue.donate(given), "no other thread is left"
    assert queue.take(8, idle=True) is None


def test_an_idle_thread_waits_for_rays_that_another_sets_up():
    made, asked = threading.Event(), threading.Event()

    def make(some: slice) -> RayBatch:
        asked.set()
        assert made.wait(10)
        return rays(some.start, some.stop - some.start)

    queue, found = RayQueue(make, [slice(0, 6)], 2), list[int]()

    def march() -> None:
        while (some := queue.take(2, idle=True)) is not None:
            found.extend(some.index.tolist())

    threads = [threading.Thread(target=march) for _ in range(2)]
    for one in threads:
        one.start()
    assert asked.wait(10)
    assert not queue.donate(rays(6, 1)), "there will be more rays to take"
    assert queue.take(2, idle=False) is None, "a thread with rays of its own goes on with them"
    assert queue.workers == 2, "the other has not ended"
    made.set()
    for one in threads:
        one.join(10)
    assert sorted(found) == list(range(6))
    assert queue.workers == 0


def test_an_error_in_setup_ends_that_thread_and_not_the_others():
    def make(_some: slice) -> RayBatch:
        raise ValueError("no")

    queue = RayQueue(make, [slice(0, 6)], 2)
    with pytest.raises(ValueError, match="no"):
        queue.take(2, idle=True)
    assert queue.take(2, idle=True) is None
