"""Rays that a direct implementation loses: in faces, along edges, through corners, through few bricks of many, past what floats count."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from oracle import dense_rays, trilinear
from scenes import looking, make_snerg, snerg_from_volume
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.acceleration import Acceleration, acceleration_of, chebyshev_distance
from snerg.core.rendering.packet_traversal import empty_distance
from snerg.core.rendering.ray_marcher import MarchOutput, RayMarcher
from snerg.core.rendering.ray_queue import RayQueue
from snerg.core.rendering.render import MarchSettings, march_rays, render_scene, tiled_pixels
from snerg.core.scene.scene import Scene

VOXEL = 1 / 16  # a power of two: every position below is exact in floats
SHAPE = (60, 30, 36)  # two axes end at a block's own end, one within a block


def filled(shape: tuple[int, int, int], seed: int = 0, low: int = 1, high: int = 40) -> Scene:
    """A diffuse scene with something in each voxel, its corner at the origin."""
    draw = np.random.default_rng(seed)
    alpha = draw.integers(low, high, (*shape, 1))
    values = np.concatenate([draw.integers(0, 256, (*shape, 3)) % (alpha + 1), alpha], axis=-1).astype(np.uint8)
    return snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)


def lattice_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Integer origins (in voxels) and directions, [N, 3]: outside, on the faces, inside; along axes and diagonals of faces and of space."""
    draw = np.random.default_rng(1)
    places = [(-7, 0, 3, size // 2, size, size + 5) for size in SHAPE]
    origins = np.stack([draw.choice(place, count) for place in places], axis=-1)
    directions = draw.integers(-1, 2, (count, 3))
    directions[~directions.any(axis=-1)] = (0, 0, 1)
    return origins, directions


def exact_chord(origin: list[int], direction: list[int]) -> Fraction:
    """The square of a ray's length in the box of SHAPE, in voxels, by rational arithmetic; -1 where it misses."""
    enter, leave = Fraction(0), Fraction(10**9)
    for o, d, size in zip(origin, direction, SHAPE, strict=True):
        if d == 0:
            if not 0 <= o <= size:
                return Fraction(-1)
            continue
        low, high = sorted((Fraction(-o, d), Fraction(size - o, d)))
        enter, leave = max(enter, low), min(leave, high)
    return (leave - enter) ** 2 * sum(d * d for d in direction) if leave > enter else Fraction(-1)


@pytest.mark.hard_case(31, 32)
@pytest.mark.parametrize("zero", [0.0, -0.0, 1e-310, -1e-310, 1e-15])
def test_of_a_hundred_thousand_rays_in_faces_edges_and_corners_none_is_wrong(zero: float) -> None:
    """Hit and miss by rational arithmetic; the light of those that hit by the plain float64 march."""
    scene = filled(SHAPE)
    origins, directions = lattice_rays(100_000 if zero == 0 else 20_000)
    both, back = np.unique(np.concatenate([origins, directions], axis=1), axis=0, return_inverse=True)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    got = march_rays(scene, origins * VOXEL, np.where(directions == 0, zero, unit))
    hits = np.array([exact_chord(row[:3], row[3:]) > Fraction(1, 4) for row in both.tolist()])[back.reshape(-1)]
    assert np.array_equal(got.transmittance < 1, hits)
    once = both[:, 3:] / np.linalg.norm(both[:, 3:], axis=-1, keepdims=True)
    values, through, _ = dense_rays(scene, both[:, :3] * VOXEL, once, 0.0)
    assert np.abs(got.transmittance - through[back.reshape(-1)]).max() < 1e-5
    assert np.abs(got.colour - values[back.reshape(-1)]).max() < 1e-5


@pytest.mark.hard_case(33, 34)
def test_coarse_pixels_on_a_large_sparse_grid_lose_nothing() -> None:
    """Rays of a tile are hundreds of voxels apart where they meet single voxels and clumps; skipping must find each that a ray meets."""
    draw = np.random.default_rng(3)
    scene = sparse_grid(draw, (700, 500, 600), 300)
    middle = np.array(scene.shape) * VOXEL / 2
    for index, eye in enumerate(((0.5, -0.9, 0.4), (-0.4, 0.8, -0.3), (0.05, 0.1, 0.0), (-1.1, 0.2, 0.9), (1.0, -0.1, -0.8))):
        pose = looking(tuple(middle + np.array(eye) * 40), tuple(middle))
        camera = Camera(32, 32, (19.0, 19.0), (16, 16), pose)
        rays = camera.rays(tiled_pixels(32, 32))
        skipped, whole = (march_rays(scene, *rays, MarchSettings(skip=skip, stop_transmittance=0.0)) for skip in (True, False))
        assert (whole.transmittance < 1).sum() > 15, index
        assert np.abs(skipped.transmittance - whole.transmittance).max() < 1e-6
        assert np.abs(skipped.colour - whole.colour).max() < 1e-6 and np.abs(skipped.depth - whole.depth).max() < 1e-3
        some = np.flatnonzero(whole.transmittance < 1)[:40]
        assert np.abs(dense_rays(scene, rays[0][some], rays[1][some], 0.0)[1] - whole.transmittance[some]).max() < 1e-4


@pytest.mark.hard_case(33)
def test_a_packet_stays_in_empty_bricks() -> None:
    """The box around the rays of a packet touches no brick that holds something up to the distance that it may skip."""
    draw = np.random.default_rng(7)
    occupied = draw.random((14, 9, 11)) < 0.02
    nothing = np.zeros(1, np.uint32), 4, 255.0, np.zeros(1, np.int64)
    distance = chebyshev_distance(occupied, 255).reshape(-1)
    acceleration = Acceleration(*nothing, distance, (14, 9, 11), np.zeros(1, np.uint8))
    centre = draw.uniform(0, 6 * np.array(occupied.shape), (400, 3)).T.astype(np.float32)
    direction = draw.uniform(-1, 1, (3, 400)).astype(np.float32)
    half, growth = (draw.uniform(0, most, (3, 400)).astype(np.float32) for most in (2, 0.05))
    reached = empty_distance(acceleration, centre, direction, half, growth, np.full(400, 40, np.float32))
    low = 6 * np.argwhere(occupied)
    for share in np.linspace(0, 1, 40):
        s = share * reached
        point, size = (centre + direction * s).T[:, None], (half + growth * s).T[:, None] - 1e-3
        assert not ((point + size > low) & (point - size < low + 6)).all(axis=-1).any(axis=-1)[reached > 0].any()
    assert (reached > 0).sum() > 100 and (reached >= 40).sum() > 10


def sparse_grid(draw: np.random.Generator, shape: tuple[int, int, int], blocks: int) -> Scene:
    """A grid of which `blocks` blocks have a cell, with a clump in each that touches no face of its block."""
    sides = tuple(-(-n // 30) for n in shape)
    indirection = np.full(sides, -1, np.int32)
    chosen = draw.choice(indirection.size, blocks, replace=False)
    indirection.reshape(-1)[chosen] = np.arange(blocks)
    cells = np.zeros((blocks, 32, 32, 32, 4), np.uint8)
    for cell in cells:
        low, size = draw.integers(2, 8, 3), draw.integers(3, 20, 3)
        cell[tuple(slice(a, a + b) for a, b in zip(low, size, strict=True))] = (20, 60, 90, 120)
    return Scene(np.eye(4), VOXEL, shape, indirection, cells, None)


@pytest.mark.hard_case(40, 54)
@pytest.mark.parametrize("bricks", [(205, 205, 205), (256, 256, 256), (257, 300, 280), (11, 9, 500_000)])
def test_bricks_are_numbered_past_what_single_precision_counts(bricks: tuple[int, int, int]) -> None:
    """At 2^24 bricks float32 counts in twos: the number of one brick would be that of its neighbour."""
    nothing = np.zeros(1, np.uint32), 4, 255.0, np.zeros(1, np.int64), np.zeros(1, np.uint8), bricks, np.zeros(1, np.uint8)
    queue = RayQueue(lambda chunk: None, [], 1)
    marcher = RayMarcher(Acceleration(*nothing), queue, MarchOutput(np.zeros((0, 4)), np.zeros(0)), 1, 0.0)
    draw = np.random.default_rng(0)
    places = np.concatenate([draw.integers(0, bricks, (2000, 3)), np.array(bricks) - 1 - draw.integers(0, 3, (50, 3))])
    expected = [(x * bricks[1] + y) * bricks[2] + z for x, y, z in places.tolist()]
    assert marcher.flat_brick_number(places.T.astype(np.float32)).tolist() == expected


@pytest.mark.hard_case(37)
@pytest.mark.parametrize("seed", range(3))
def test_the_acceleration_structure_is_that_of_its_definition(seed: int) -> None:
    """Distances of bricks and of stencils by brute force: one too long loses voxels, one too short only time."""
    draw = np.random.default_rng(seed)
    values = np.zeros((61, 30, 47, 4), np.uint8)
    for place in draw.integers(0, values.shape[:3], (9, 3)):
        values[tuple(place)] = (0, 1, 0, 0) if seed == 2 else (3, 4, 5, 6)  # a colour without alpha is not nothing
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)
    built = acceleration_of(scene)
    wide = np.zeros((92, 32, 62), bool)
    wide[1:62, 1:31, 1:48] = values.any(axis=-1)
    stencils = np.any([wide[x : 91 + x, y : 31 + y, z : 61 + z] for x, y, z in np.ndindex(2, 2, 2)], axis=0)  # base -1 first
    occupied = np.array(
        [
            [[stencils[6 * x : 6 * x + 7, 6 * y : 6 * y + 7, 6 * z : 6 * z + 7].any() for z in range(10)] for y in range(5)]
            for x in range(15)
        ]
    )
    occupied = np.pad(occupied, (0, 1), mode="edge")
    assert built.bricks == occupied.shape == (16, 6, 11)
    assert np.array_equal(built.brick_distance.reshape(occupied.shape), nearest(occupied))
    for block, cell in zip(np.argwhere(scene.indirection >= 0), built.voxel_skip.reshape(-1, 32, 32, 32), strict=True):
        x, y, z = 30 * block
        inside = stencils[x : x + 31, y : y + 31, z : z + 31]
        base = np.indices((31, 31, 31))
        border = np.minimum(base, 30 - base).min(axis=0)  # to the stencils that neighbours share
        expected = np.minimum(np.minimum(nearest(inside) if inside.any() else 99, np.maximum(border, 1)), 6)
        assert np.array_equal(cell[:31, :31, :31], expected)


def nearest(occupied: np.ndarray) -> np.ndarray:
    """The distance of each place to the nearest True in the maximum norm."""
    there = np.argwhere(occupied)
    return np.abs(np.argwhere(np.ones_like(occupied))[:, None] - there).max(axis=-1).min(axis=-1).reshape(occupied.shape)


@pytest.mark.hard_case(33)
@pytest.mark.parametrize("stop", [0.0, 0.2])
def test_the_voxels_that_rays_visit_are_those_of_their_samples(stop: float) -> None:
    """The voxel nearest to each sample that may hold something, up to the one with which the ray ends, and no other."""
    scene = make_snerg((34, 30, 40), diffuse=True)
    camera = Camera(9, 7, (9.0, 9.0), (4, 3), looking((0.7, -3.1, 1.2), (0, 0, 0)))
    origins, directions = camera.rays()
    for skip in (True, False):
        visited = np.zeros(len(scene.cells) * 32**3, bool)
        march_rays(scene, origins, directions, MarchSettings(stop_transmittance=stop, skip=skip), visited=visited)
        assert np.array_equal(visited, expected_visits(scene, origins, directions, stop))


def expected_visits(scene: Scene, origins: np.ndarray, directions: np.ndarray, stop: float) -> np.ndarray:
    visited = np.zeros((len(scene.cells), 32, 32, 32), bool)
    size = np.array(scene.shape)
    for origin, direction in zip((origins - scene.grid_to_world[:3, 3]) / scene.voxel_size, directions, strict=True):
        walls = np.stack([-origin / direction, (size - origin) / direction])
        start, leave = walls.min(axis=0).max(), walls.max(axis=0).min()
        through, t = 1.0, start + 0.5
        while t < leave and through > stop:
            point = origin + t * direction
            block = np.minimum(point // 30, np.array(scene.indirection.shape) - 1).astype(int)
            cell = scene.indirection[tuple(block)]
            if cell >= 0:
                local = point - 30 * block + 0.5
                base = np.floor(local).astype(int)
                if scene.cells[(cell, *(slice(b, b + 2) for b in base))].any():
                    visited[(cell, *np.floor(local + 0.5).astype(int))] = True
                through *= 1 - trilinear(scene, point[None])[0, -1]
            t += 1
    return visited.reshape(-1)


@pytest.mark.hard_case(35, 33)
def test_a_ray_that_ended_goes_no_further_than_its_samples() -> None:
    """Samples of one pass lie behind the one with which a ray ends; behind a wall nothing is visited, or a bake keeps what none sees."""
    values = np.zeros((40, 12, 12, 4), np.uint8)
    values[10:30] = (200, 200, 200, 255)
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)
    visited = np.zeros(len(scene.cells) * 32**3, bool)
    origin = np.array([[-1.0, 0.4, 0.4]])
    march_rays(scene, origin, np.array([[1.0, 0, 0]]), MarchSettings(stop_transmittance=0.01), visited=visited)
    depth = np.flatnonzero(visited.reshape(-1, 32, 32, 32)[0].any(axis=(1, 2)))
    assert depth.tolist() == [10, 11], "the last empty voxel, beside which something is, and the first opaque one; the apron is voxel 0"


@pytest.mark.hard_case(36, 42)
@pytest.mark.parametrize("camera", ["perspective", "orthographic"])
def test_clip_planes_cut_where_they_say(camera: str) -> None:
    """A plane across the view axis, not a sphere: rays at the picture's edge are longer."""
    scene = replace(filled((36, 36, 36), high=3), near=0.0)
    pose = looking((1.1, -2.0, 1.3), (1.1, 1.0, 1.3))
    focal = (14.0, 14.0) if camera == "perspective" else (8.0, 8.0)
    whole = Camera(16, 12, focal, (8, 6), pose, camera)
    for near, far in ((2.5, np.inf), (0.0, 3.2), (2.5, 3.2)):
        clipped = replace(whole, near=near, far=far)
        origins, directions = clipped.rays()
        cosines = directions @ -pose[:3, 2]
        _, through, _ = dense_rays(scene, origins, directions, near / cosines, far=far / cosines)
        got = render_scene(scene, clipped)
        assert np.abs(1 - got.alpha.reshape(-1) - through).max() < 1e-5
        assert np.abs(got.alpha - render_scene(scene, whole).alpha).max() > 0.005


@pytest.mark.hard_case(33)
def test_voxel_skips_pass_no_occupied_stencil() -> None:
    """Steep and flat rays through single voxels, many samples apart, in one cell: the jump that is longest by a sample passes one."""
    draw = np.random.default_rng(5)
    values = np.zeros((30, 30, 30, 4), np.uint8)
    for place in draw.integers(0, 30, (12, 3)):
        values[tuple(place)] = (30, 60, 90, 200)
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)
    target, origin = draw.uniform(0, 30, (3000, 3)) * VOXEL, draw.normal(size=(3000, 3))
    origin = target + 4 * origin / np.linalg.norm(origin, axis=-1, keepdims=True)
    direction = (target - origin) / 4
    got = march_rays(scene, origin, direction, MarchSettings(stop_transmittance=0.0))
    assert np.abs(got.transmittance - dense_rays(scene, origin, direction, 0.0)[1]).max() < 1e-5


def test_distances_end_at_what_a_byte_holds() -> None:
    occupied = np.zeros((300, 1, 1), bool)
    occupied[0] = True
    assert chebyshev_distance(occupied, 1000).reshape(-1).tolist() == [min(i, 255) for i in range(300)]
    assert chebyshev_distance(np.zeros((3, 1, 1), bool), 1000).max() == 255
    apart = np.zeros((2, 5, 5), bool)
    apart[0, 0, 0] = apart[1, 4, 2] = True
    expected = np.stack([nearest(one) for one in apart])
    assert np.array_equal(chebyshev_distance(apart, 9, axes=(1, 2)), expected), "cells that are not neighbours"


@pytest.mark.hard_case(37)
@pytest.mark.parametrize("quantised", [True, False])
def test_light_without_opacity_is_seen(quantised: bool) -> None:
    """Other programs bake flames that hide nothing; skipping must not pass them."""
    values = np.zeros((40, 12, 12, 4), np.uint8)
    values[20:24, 4:8, 4:8, :3] = (30, 20, 10)
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)
    if not quantised:
        scene = replace(scene, cells=scene.cells.astype(np.float32) / 255)
    origins, directions = np.array([[-1.0, 0.375, 0.375]]), np.array([[1.0, 0, 0]])
    got = march_rays(scene, origins, directions, MarchSettings(stop_transmittance=0.0))
    assert np.abs(got.colour[0] * 255 - [120, 80, 40]).max() < 1e-3 and got.transmittance[0] == 1
