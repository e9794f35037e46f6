"""Objects before a plain backdrop."""

import numpy as np

from snerg.core.training.decisions import backdrop
from snerg.core.training.losses import plain_colour
from snerg.core.training.silhouette import border_share, silhouette, spread

WHITE = np.full(3, 255, np.uint8)


def ring(size: int = 60) -> np.ndarray:
    """A grey ring, white inside and out."""
    y, x = np.mgrid[:size, :size] - size / 2 + 0.5
    radius = np.hypot(x, y)
    image = np.full((size, size, 3), 255, np.uint8)
    image[(radius > 10) & (radius < 20)] = 90
    return image


def test_white_inside_the_object_belongs_to_it_and_the_backdrop_does_not():
    shape = silhouette(ring(), WHITE)
    y, x = np.mgrid[:60, :60] - 29.5
    radius = np.hypot(x, y)
    assert shape[radius < 20].all() and not shape[radius > 24].any()


def test_a_narrow_gap_lets_nothing_in():
    image = ring()
    image[30, 30:] = 255
    assert silhouette(image, WHITE)[28:32, 28:32].all()


def test_spreading_goes_round_corners():
    allowed = np.ones((40, 40), bool)
    for k in range(2, 40, 4):  # walls with a gap at alternate ends
        allowed[k] = False
        allowed[k, 0 if k % 8 == 2 else -1] = True
    seed = np.zeros_like(allowed)
    seed[0, 0] = True
    assert (spread(seed, allowed) == allowed).all()
    allowed[20] = False
    assert not spread(seed, allowed)[21:].any() and spread(seed, allowed)[:20].sum() == allowed[:20].sum()


def test_a_photograph_has_no_backdrop():
    image = np.random.default_rng(0).integers(0, 256, (50, 40, 3), np.uint8)
    assert border_share(image, WHITE) < 0.01 and border_share(ring(), WHITE) == 1
    assert not backdrop("auto", [border_share(image, WHITE)], False, "white").chosen
    assert backdrop("auto", [1.0, 0.9], False, "white").chosen and not backdrop("off", [1.0, 0.9], False, "white").chosen
    assert not backdrop("auto", [1.0], True, "white").chosen


def test_a_background_that_changes_is_no_backdrop():
    assert plain_colour("random") is None and plain_colour("#102030").tolist() == [16, 32, 48]
    assert not backdrop("auto", [], False, "random").chosen


def test_what_shares_one_channel_with_the_backdrop_is_no_backdrop():
    image = ring()
    image[image[..., 0] == 90] = [255, 20, 30]
    assert np.array_equal(silhouette(image, WHITE), silhouette(ring(), WHITE))
