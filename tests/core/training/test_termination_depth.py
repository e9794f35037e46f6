"""Where training rays end: measured, never guessed."""

import numpy as np
import pytest

from scenes import make_cameras
from snerg.core.nerf.sampling import CELLS, Domain, pack_samples
from snerg.core.training.ray_dataset import RayDataset
from snerg.core.training.termination_depth import TerminationDepths

DOMAIN = Domain(np.zeros(3), 1.0, -np.ones(3), np.ones(3))


@pytest.fixture
def pool() -> RayDataset:
    cameras = make_cameras(width=10, height=7)[:3]
    return RayDataset([np.zeros((7, 10, 3), np.uint8) for _ in cameras], cameras, DOMAIN)


def test_every_pixel_has_a_tile_and_neighbours_share_one(pool, monkeypatch):
    monkeypatch.setattr("snerg.core.training.termination_depth.MOST_TILES", 60)
    ends = TerminationDepths(pool)
    assert ends.side == 2 and len(ends.depths) == 3 * 5 * 4
    tile = ends.tile(np.arange(len(pool.pixels))).reshape(3, 7, 10)
    assert np.unique(tile).tolist() == list(range(60))
    assert (tile[:, 0, 0] == tile[:, 1, 1]).all() and (tile[:, 0, 1] != tile[:, 0, 2]).all() and len(set(tile[:, 6, 9])) == 3


def test_a_tile_keeps_the_farthest_end_and_forgets_it_slowly(pool):
    ends = TerminationDepths(pool)
    ends.learn(np.array([4, 4, 5]), np.float32([2.0, 3.0, 1.0]))
    assert ends.depths[4:6].tolist() == [3.0, 1.0]
    ends.learn(np.array([4]), np.float32([2.0]))
    assert 2.0 < ends.depths[4] < 3.0
    ends.learn(np.array([5]), np.float32([4.0]))
    assert ends.depths[5] == 4.0


def test_light_that_is_left_makes_a_tile_look_all_the_way(pool):
    ends = TerminationDepths(pool)
    ends.learn(np.array([1]), np.float32([2.0]))
    ends.learn(np.array([1, 1]), np.float32([np.inf, 2.0]))
    assert np.isinf(ends.depths[1]) and np.isinf(ends.depths[2])


def test_packing_stops_where_it_is_told_to_and_says_so():
    occupied = np.ones(CELLS**3, bool)
    origins, directions = np.array([[-3.0, 0.1, 0.2]] * 3), np.array([[1.0, 0, 0]] * 3)
    got = pack_samples(
        DOMAIN, occupied, origins, directions, 0.05, np.full(3, 0.5), 0.0, np.array([np.inf, 3.0, np.inf]), np.array([np.inf, 3.5, 2.5])
    )
    farthest = [got.distance[got.ray == r].max() for r in range(3)]
    assert got.cut.tolist() == [False, False, True]
    assert 3.9 < farthest[0] < 4 and 2.9 < farthest[1] < 3 and 2.4 < farthest[2] < 2.5


def test_columns_that_fill_no_tile_have_their_own(monkeypatch):
    monkeypatch.setattr("snerg.core.training.termination_depth.MOST_TILES", 60)
    cameras = make_cameras(width=9, height=7)[:3]
    ends = TerminationDepths(RayDataset([np.zeros((7, 9, 3), np.uint8) for _ in cameras], cameras, DOMAIN))
    tile = ends.tile(np.arange(189)).reshape(3, 7, 9)
    assert ends.side == 2 and np.unique(tile).tolist() == list(range(60)) and np.bincount(tile.ravel()).max() == 4
    assert len(ends.depths) == 60 and tile[0, 0, 8] != tile[0, 2, 0]
