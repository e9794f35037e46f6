"""The pool of training pixels: their rays are the cameras' rays, whatever the camera, and masks are kept to."""

from __future__ import annotations

import numpy as np
import pytest

from scenes import looking, make_cameras
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion
from snerg.core.geometry.ndc import Ndc, space_rays
from snerg.core.nerf.sampling import Domain
from snerg.core.training.ray_dataset import RayDataset

DOMAIN = Domain(np.array([0.2, -0.1, 0.3]), 0.7, np.full(3, -1.0), np.full(3, 1.0))


def blank(cameras, channels=3):
    return [np.zeros((c.height, c.width, channels), np.uint8) for c in cameras]


def mixed_cameras() -> tuple[Camera, ...]:
    """Sizes, projections and lenses of all kinds, two of them alike."""
    pose = looking((1, -3, 2), (0, 0, 0))
    lens, fisheye = Distortion("opencv", (-0.2, 0.05, 0.002, -0.001)), Distortion("fisheye", (0.02, -0.01))
    return (
        *make_cameras(width=12, height=9),
        Camera(11, 8, (9.0, 9.5), (5, 4.2), pose, distortion=lens),
        Camera(7, 13, (5.0, 5.0), (3, 6), pose, distortion=fisheye),
        Camera(9, 9, (9.0, 9.0), (4, 4), pose, distortion=Distortion("opencv", lens.coefficients)),
    )


def wide_cameras() -> tuple[Camera, ...]:
    """Panoramas and fisheyes that are computed in angles, among others."""
    pose = looking((1, -3, 2), (0, 0, 0))
    lens = Distortion("fisheye", (0.02, -0.01))
    return (
        Camera(16, 8, panorama_focal(16, 8), (8, 4), pose, "equirectangular"),
        *mixed_cameras()[:3],
        Camera(9, 9, (2.5, 2.5), (4.4, 4.6), pose, "fisheye", distortion=lens),
        Camera(9, 7, (2.5, 2.0), (4.4, 4.6), looking((0, 2, 2), (0, 0, 0)), "fisheye"),
        Camera(7, 13, (5.0, 5.0), (3, 6), pose, distortion=lens),
    )


def test_rays_of_wide_cameras_are_the_cameras_rays():
    cameras = wide_cameras()
    pool = RayDataset(blank(cameras), cameras, DOMAIN)
    origins, directions, _, _, world = pool.rays(np.arange(len(pool.pixels)))
    expected = [np.concatenate(part) for part in zip(*(c.rays() for c in cameras), strict=True)]
    assert np.allclose(origins, (expected[0] - DOMAIN.centre) * DOMAIN.scale)
    assert np.allclose(directions, expected[1], atol=1e-9) and np.array_equal(directions, world)


@pytest.mark.hard_case(2, 3)
def test_training_rays_are_the_cameras_rays():
    cameras = mixed_cameras()
    pool = RayDataset(blank(cameras), cameras, DOMAIN)
    assert len(pool.lenses.fisheye) == 3 and not pool.alpha
    origins, directions, near, far, world = pool.rays(np.arange(len(pool.pixels)))
    expected = [np.concatenate(part) for part in zip(*(c.rays() for c in cameras), strict=True)]
    assert np.allclose(origins, (expected[0] - DOMAIN.centre) * DOMAIN.scale)
    assert np.allclose(directions, expected[1], atol=1e-9) and np.array_equal(directions, world)
    begin, end = (np.concatenate(part) for part in zip(*(c.clip_distances(c.rays()[1]) for c in cameras), strict=True))
    assert np.allclose(near, begin * DOMAIN.scale) and np.allclose(far, end * DOMAIN.scale) and near.max() > 0


@pytest.mark.hard_case(6)
def test_rays_lose_nothing_far_from_the_origin():
    far = np.array([1e6, -2e6, 3e6])
    here = make_cameras(width=6, height=5)
    there = make_cameras(tuple(far), width=6, height=5)
    index = np.arange(len(RayDataset(blank(here), here, DOMAIN).pixels))
    moved = Domain(DOMAIN.centre + far, DOMAIN.scale, DOMAIN.low, DOMAIN.high)
    one, other = (RayDataset(blank(c), c, d).rays(index) for c, d in ((here, DOMAIN), (there, moved)))
    assert np.abs(one[0] - other[0]).max() < 1e-8 and np.abs(one[1] - other[1]).max() < 1e-8


@pytest.mark.hard_case(9)
def test_rays_in_device_coordinates():
    cameras = mixed_cameras()
    ndc = Ndc(looking((0, -4, 0), (0, 0, 0)), (1.0, 1.2), 1.0)
    pool = RayDataset(blank(cameras), cameras, DOMAIN, ndc=ndc)
    origins, directions, near, far, world = pool.rays(np.arange(len(pool.pixels)))
    rays = [np.concatenate(part) for part in zip(*(c.rays() for c in cameras), strict=True)]
    planes = [np.concatenate(part) for part in zip(*(c.clip_distances(c.rays()[1]) for c in cameras), strict=True)]
    expected = space_rays(ndc, *rays, *planes)
    assert np.allclose(origins, (expected[0] - DOMAIN.centre) * DOMAIN.scale) and np.allclose(directions, expected[1], atol=1e-7)
    assert np.allclose(far, expected[3] * DOMAIN.scale) and np.allclose(near, expected[2] * DOMAIN.scale)
    assert np.allclose(world, rays[1], atol=1e-9)


def test_alpha_counts_only_where_it_varies():
    cameras = make_cameras(width=6, height=5)
    images = blank(cameras, 4)
    for image in images:
        image[..., 3] = 255
    assert not RayDataset(images, cameras, DOMAIN).alpha
    images[2][1, 1, 3] = 254
    pool = RayDataset(iter(images), cameras, DOMAIN)
    assert pool.alpha and pool.pixels[:, 3].min() == 254
    assert not RayDataset([images[0][..., :3], *images[1:]], cameras, DOMAIN).alpha


def test_masked_and_withheld_pixels_are_never_drawn():
    cameras = make_cameras(width=12, height=9)[:3]
    images = blank(cameras)
    masks = [None, np.zeros((9, 12), bool), None]
    masks[1][3, 4] = True
    for image, mask in zip(images, masks, strict=True):
        image[...] = 200 if mask is None else np.where(mask, 100, 0)[..., None]
    pool = RayDataset(images, cameras, DOMAIN, masks)
    drawn = pool.draw(20000, np.random.default_rng(0))
    assert drawn.dtype == np.int64 and set(pool.pixels[drawn, 0]) == {100, 200}
    pool.withheld[:] = [True, False, False]
    drawn = pool.draw(20000, np.random.default_rng(0))
    assert set(drawn // 108) == {1, 2} and pool.pixels[drawn, 0].min() == 100
    pool.withheld[:] = True
    with pytest.raises(SnergError, match="held out"):
        pool.draw(3, np.random.default_rng(0))
    with pytest.raises(SnergError, match="masks"):
        RayDataset(images, cameras, DOMAIN, [np.zeros((9, 12), bool)] * 3)


def test_empty_surroundings_are_passed_over():
    cameras = make_cameras(width=120, height=90)[:2]
    images = blank(cameras, 4)
    images[0][40:50, 60:70] = 255
    pool = RayDataset(images, cameras, DOMAIN)
    pool.keep_near([i[..., 3] > 0 for i in images], [None, None])
    drawn = pool.draw(5000, np.random.default_rng(0))
    row, column = np.divmod(drawn, 120)
    assert 30 < row.min() < 40 and row.max() < 60 and 50 < column.min() < 60


def test_the_pixels_past_32768_that_a_mask_leaves_are_drawn():
    """The numbers of pixels past 2^15 and 2^16 are no 16-bit numbers."""
    camera = Camera(400, 300, (400.0, 400.0), (200, 150), looking((1, -3, 2), (0, 0, 0)))
    mask = np.zeros((300, 400), bool)
    places = [(0, 7), (82, 5), (170, 399), (299, 399)]
    for place in places:
        mask[place] = True
    pool = RayDataset([np.zeros((300, 400, 3), np.uint8)] * 2, [camera] * 2, DOMAIN, [mask, np.zeros((300, 400), bool)])
    drawn = pool.draw(4000, np.random.default_rng(0))
    share = np.array([(drawn == row * 400 + column).mean() for row, column in places])
    assert share.sum() == 1 and np.abs(share - 0.25).max() < 0.05


def test_every_pixel_is_drawn_equally_often():
    cameras = make_cameras(width=6, height=5)[:2]
    pool = RayDataset(blank(cameras), cameras, DOMAIN)
    counts = np.bincount(pool.draw(60_000, np.random.default_rng(3)), minlength=60)
    assert len(counts) == 60 and np.abs(counts / 1000 - 1).max() < 0.15


def test_pixels_are_numbered_view_after_view():
    cameras = make_cameras(width=6, height=5)[:2]
    images = blank(cameras, 4)
    images[1][3, 2] = [9, 8, 7, 6]
    pool = RayDataset(images, cameras, DOMAIN)
    assert pool.pixels[30 + 3 * 6 + 2].tolist() == [9, 8, 7, 6] and pool.view(np.array([0, 29, 30, 59])).tolist() == [0, 0, 1, 1]
