"""The arithmetic of a bake against float64: what is occupied, coarse, seen, supersampled and stored, and each threshold's own edge."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise, product

import numpy as np
import pytest

from scenes import looking, make_frame, rotation
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.occupied_voxels import (
    FAINT_DEPTH,
    ZERO_DEPTH,
    OccupiedVoxels,
    block_optical_depth,
    coarse_opacity,
    cull_faint,
    find_occupied_voxels,
    max_row_depth,
)
from snerg.core.baking.prefilter import VOXELS_PER_CHUNK, chunk_blocks, compact_cells
from snerg.core.baking.resume import ResumeCache
from snerg.core.baking.supersampling import (
    MAX_SUPERSAMPLING,
    MIN_GAIN,
    average_in_voxels,
    baked_along,
    composite,
    field_along,
    measure_supersampling,
)
from snerg.core.baking.visibility import HALF, VisibilityStatistics, coarse_opacity_scene, refine_mask
from snerg.core.baking.visibility_rays import pixels_per_unit
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.frame import Composited
from snerg.core.nerf.sampling import Domain
from snerg.core.scene.blocks import block_coordinates, blocks_in_ranges, dilate, number_blocks, pack_mask, reindex_blocks, unpack_mask
from snerg.core.scene.voxel_grid import MAX_RESOLUTION, VoxelGrid

BOX = Box.axis_aligned([-1, -1, -1], [1, 1, 1])


@dataclass(frozen=True, eq=False)
class Formula:
    """A field by a formula of the place: density and colour [N], and features of 0.25."""

    density: object
    colour: object = lambda p: np.full(len(p), 0.5)
    occupancy: np.ndarray | None = None
    ndc: None = None
    network: None = None
    view: str = "diffuse"
    params: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb = np.repeat(self.colour(points).astype(np.float32)[:, None], 3, axis=1)
        return self.density(points).astype(np.float32), rgb, np.full((len(points), 4), 0.25, np.float32)

    def holds(self, x: np.ndarray) -> np.ndarray:
        return (np.abs(x) <= 1).all(axis=-1)


def optical_depths(seed: int, blocks: int = 2) -> np.ndarray:
    draw = np.random.default_rng(seed)
    depth = draw.exponential(0.5, (blocks, 30, 30, 30)) * (draw.random((blocks, 30, 30, 30)) < 0.5)
    depth[0, :4] = draw.choice([0.0, 1e-5, 3e-4, 80.0], (4, 30, 30))
    return depth.astype(np.float32)


@pytest.mark.hard_case(18, 37)
@pytest.mark.parametrize("seed", range(3))
def test_coarse_opacity_is_the_mean_transmittance_squared_rounded_up(seed: int) -> None:
    """Against float64; nothing that hides anything is 0, and what is no more than rounding adds no level."""
    depth = optical_depths(seed)
    eight = np.exp(-depth.astype(np.float64)).reshape(2, 15, 2, 15, 2, 15, 2).mean(axis=(2, 4, 6))
    exact = 255 * (1 - eight**2)
    got = coarse_opacity(depth)
    assert got.dtype == np.uint8 and got.shape == (2, 15, 15, 15)
    assert (got >= exact - 2e-3).all() and (got <= exact + 1.0).all()
    assert np.array_equal(got, np.ceil(exact - 1e-3).clip(0, 255)) or np.abs(got - np.ceil(exact - 1e-3)).mean() < 1e-3
    assert not coarse_opacity(np.zeros((1, 30, 30, 30), np.float32)).any()
    assert (coarse_opacity(np.full((1, 30, 30, 30), 80, np.float32)) == 255).all()
    one = np.zeros((1, 30, 30, 30), np.float32)
    one[0, 7, 4, 29] = 80
    only = np.argwhere(coarse_opacity(one)[0])
    assert only.tolist() == [[3, 2, 14]] and coarse_opacity(one)[0, 3, 2, 14] == np.ceil(255 * (1 - (7 / 8) ** 2))


@pytest.mark.hard_case(44, 52)
def test_faint_voxels_are_kept_where_they_add_up() -> None:
    """Edges of the thresholds: a voxel is thick above FAINT_DEPTH; a block is kept from the sum on; fog's voxels above ZERO_DEPTH."""
    at = float(FAINT_DEPTH)
    depth = np.zeros((6, 30, 30, 30), np.float32)
    depth[0, 3, 4, 5] = at  # faint
    depth[1, 3, 4, 5] = 0.004  # thick, but too little for a block
    depth[2, 3, 4, 5], depth[2, 9, 9, 9] = 0.01, at  # thick enough; the faint one is lost
    depth[2, 12, 12, 12] = np.nextafter(FAINT_DEPTH, np.float32(1))
    depth[3, 7, 8, :] = 0.01 / 30 * 1.01  # fog along z
    depth[4, :, 8, 9] = at / 4  # faint along x, not enough
    depth[5, 2, :, 2], depth[5, 5, 5, 5], depth[5, 6, 6, 6] = at * 0.99, ZERO_DEPTH, 2 * ZERO_DEPTH
    found = cull_faint(depth, 0.01)
    assert found["full"].tolist() == [False, False, True, True, False, True]
    kept = unpack_mask(found["bits"])
    assert np.argwhere(kept[0]).tolist() == [[3, 4, 5], [12, 12, 12]] and kept[1].sum() == 30 and kept[1][7, 8].all()
    assert kept[2][2, :, 2].all() and kept[2].sum() == 31 and kept[2][6, 6, 6] and not kept[2][5, 5, 5]
    expected = [[at] * 3, [0.004] * 3, [at] * 3, [0] * 3, [30 * at / 4, at / 4, at / 4], [0] * 3]
    assert found["lost"] == pytest.approx(np.array(expected), rel=1e-5)
    exactly = np.zeros((2, 30, 30, 30), np.float32)
    exactly[0, 0, 0, 0], exactly[1, 0, 0, 0] = 0.25, np.nextafter(np.float32(0.25), np.float32(0))
    assert cull_faint(exactly, 0.25)["full"].tolist() == [True, False]
    assert np.argwhere(found["coarse"][0]).tolist() == [[1, 2, 2], [6, 6, 6]], "dropped voxels are in no march"


def test_rows_add_up_along_each_axis() -> None:
    depth = optical_depths(5).astype(np.float64)
    expected = [[depth[b].sum(axis=axis).max() for axis in range(3)] for b in range(2)]
    assert max_row_depth(depth) == pytest.approx(np.array(expected))


@pytest.mark.hard_case(44, 45, 46, 52)
def test_what_is_occupied_and_what_is_lost_are_those_of_every_voxel() -> None:
    """A grid with three different sides, of which none is whole blocks: against the density at each voxel's centre."""
    grid = VoxelGrid.inside(Box.axis_aligned([-1, -0.7, -0.45], [1, 0.7, 0.45]), 2 / 64)
    fog = Formula(lambda p: np.where(p @ [0.3, 0.5, 0.9] > 0.2, 40 * np.abs(p[:, 2]), 0) + 0.004 * (p[:, 0] < -0.2))
    found = find_occupied_voxels(fog, grid, 0.005, ResumeCache(None, ""), lambda f: None)
    centres = grid.voxel_centres(np.indices(grid.shape).reshape(3, -1).T)
    held = fog.holds(fog.domain.from_world(centres))
    depth = (np.where(held, fog.query(centres)[0], 0) * grid.voxel_size).reshape(grid.shape)
    assert grid.shape == (66, 47, 31)
    dense = np.zeros([30 * n for n in grid.blocks], bool)
    for block, voxels in zip(block_coordinates(found.indirection), unpack_mask(found.mask), strict=True):
        dense[tuple(slice(30 * b, 30 * b + 30) for b in block)] = voxels
    outside = dense.copy()
    outside[tuple(slice(0, n) for n in grid.shape)] = False
    thick = depth > FAINT_DEPTH
    assert not outside.any() and np.array_equal(dense[tuple(slice(0, n) for n in grid.shape)], thick)
    faint = np.where(thick, 0, depth)
    closed = [faint.sum(axis=axis).max() for axis in range(3)]
    assert -np.expm1(-max(closed)) * 0.999 <= found.opacity_lost <= -np.expm1(-2 * max(closed))


def test_depths_are_zero_past_the_grid_and_where_the_field_holds_nothing() -> None:
    grid = VoxelGrid.inside(Box.axis_aligned([-1, -1, -1], [1, 0.2, 0.1]), 2 / 40)
    everywhere = Formula(lambda p: np.full(len(p), 3.0))
    coordinates = np.argwhere(np.ones(grid.blocks, bool))
    depth = block_optical_depth(everywhere, grid, coordinates)
    dense = np.zeros([30 * n for n in grid.blocks])
    for place, values in zip(coordinates, depth, strict=True):
        dense[tuple(slice(30 * b, 30 * b + 30) for b in place)] = values
    centres = grid.voxel_centres(np.indices(dense.shape).reshape(3, -1).T)
    held = everywhere.holds(everywhere.domain.from_world(centres)).reshape(dense.shape)
    inside = np.zeros(dense.shape, bool)
    inside[tuple(slice(0, n) for n in grid.shape)] = True
    assert np.abs(dense - 3.0 * grid.voxel_size * (held & inside)).max() < 1e-7
    assert not (held & inside).all() and (inside & ~held).any(), "the grid is a voxel wider than the field"


def test_a_grid_has_a_voxel_more_on_each_side_and_none_for_rounding() -> None:
    for side, voxel, count in ((1.0, 0.1, 12), (0.3, 0.1, 5), (1.05, 0.1, 13), (1.0 + 1e-9, 0.1, 12), (1.0 + 1e-4, 0.1, 13)):
        grid = VoxelGrid.inside(Box.axis_aligned([0, 0, 0], [side, 0.2, 0.4]), voxel)
        assert grid.shape == (count, 4, 6)
        middle = grid.grid_to_world[:3, 3] + np.array(grid.shape) * voxel / 2
        assert middle == pytest.approx([side / 2, 0.1, 0.2])
    assert VoxelGrid.inside(Box.axis_aligned([0] * 3, [1] * 3), 1 / MAX_RESOLUTION).shape == (MAX_RESOLUTION + 2,) * 3
    with pytest.raises(SnergError, match="4097"):
        VoxelGrid.inside(Box.axis_aligned([0] * 3, [1] * 3), 1 / (MAX_RESOLUTION + 1))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation((0.3, 0.2, -0.4)), (1, 2, 3)
    turned = VoxelGrid(pose, 0.5, (31, 30, 62))
    assert turned.blocks == (2, 1, 3) and turned.halved().shape == (16, 15, 31) and turned.halved().voxel_size == 1.0
    assert turned.voxel_centres(np.array([[2, 0, 1]]))[0] == pytest.approx(pose[:3, :3] @ [1.25, 0.25, 0.75] + [1, 2, 3])
    places = np.array([[1, 0, 2], [0, 0, 1]])
    expected = [turned.voxel_centres(np.array([30 * b + v for v in np.ndindex(30, 30, 30)])) for b in places]
    assert np.abs(turned.block_centres(places) - np.concatenate(expected)).max() < 1e-12


def blocks_of_seed(seed: int) -> np.ndarray:
    return number_blocks(np.random.default_rng(seed).random((3, 2, 4)) < 0.6)


@pytest.mark.hard_case(37, 46)
def test_the_coarse_scene_of_a_bake_has_each_fine_block_in_its_octant() -> None:
    draw, indirection = np.random.default_rng(0), blocks_of_seed(1)
    grid = VoxelGrid(np.eye(4), 0.1, (90, 60, 120))
    level = draw.integers(0, 256, (int(indirection.max()) + 1, HALF, HALF, HALF), np.uint8)
    occupied = OccupiedVoxels(indirection, np.zeros((len(level), 30, 30), np.uint32), level, 0.0)
    scene = coarse_opacity_scene(occupied, indirection, grid.halved(), None)
    assert scene.shape == (45, 30, 60) and scene.voxel_size == 0.2
    expected = np.zeros((62, 32, 62), np.uint8)
    for number, (x, y, z) in enumerate(block_coordinates(indirection)):
        expected[tuple(slice(1 + HALF * b, 1 + HALF * (b + 1)) for b in (x, y, z))] = level[number]
    for (x, y, z), cell in zip(block_coordinates(scene.indirection), scene.cells, strict=True):
        assert np.array_equal(cell[..., 3], expected[30 * x : 30 * x + 32, 30 * y : 30 * y + 32, 30 * z : 30 * z + 32])
        assert not cell[..., :3].any()


def test_a_refined_mask_repeats_each_coarse_voxel_eight_times() -> None:
    fine = blocks_of_seed(2)
    used = np.zeros((2, 1, 2), bool)
    used[tuple((block_coordinates(fine) // 2).T)] = True
    coarse = number_blocks(used)
    own = np.random.default_rng(3).random((int(coarse.max()) + 1, 30, 30, 30)) < 0.3
    dense = np.zeros((60, 30, 60), bool)
    for place, voxels in zip(block_coordinates(coarse), own, strict=True):
        dense[tuple(slice(30 * b, 30 * b + 30) for b in place)] = voxels
    wide = np.kron(dense, np.ones((2, 2, 2), bool))
    got = unpack_mask(refine_mask(pack_mask(own), coarse, fine))
    for place, voxels in zip(block_coordinates(fine), got, strict=True):
        assert np.array_equal(voxels, wide[tuple(slice(30 * b, 30 * b + 30) for b in place)])


def test_statistics_count_rays_that_hit_and_the_light_of_those_that_go_on() -> None:
    """Edges: 0.99 has not hit; the threshold has not gone on."""
    through = np.float32([1.0, 0.99, 0.9899, 0.5, 0.01, 0.005])
    rays = Composited(np.zeros((6, 3)), np.zeros((6, 0)), through, np.zeros(6), 12)
    found = VisibilityStatistics(1.0, 0.25, 8.0).with_rays(rays, 0.01)
    assert (found.hits, found.samples) == (5.0, 20.0) and found.transmittance == pytest.approx(0.25 + 0.9899 + 0.5, abs=1e-6)
    assert found.to_json() == {"rays": 5, "passes": round((0.25 + 0.9899 + 0.5) / 5, 4), "voxels": 8.0}
    assert VisibilityStatistics().to_json() == {"rays": 0, "passes": 0.0, "voxels": 0.0}


def test_pixels_of_a_length_are_those_of_the_projection() -> None:
    """Across both axes of the picture, where the box is farthest from the camera."""
    for eye in ((0, -5.0, 0), (3.0, 2.0, -4.0), (0, 0.01, 0)):
        camera = Camera(200, 200, (300.0, 250.0), (100, 100), looking(eye, (0, 1, 0)))
        right, up, backward = camera.camera_to_world[:3, :3].T
        farthest = camera.position - backward * max(float((camera.position - corner) @ backward) for corner in BOX.corners())
        pixels, _ = camera.project(farthest + np.array([-right, right, -up, up]) * 1e-4)
        across, down = (pixels[1] - pixels[0])[0] / 2e-4, (pixels[2] - pixels[3])[1] / 2e-4
        assert pixels_per_unit(camera, BOX, None) == pytest.approx([across, down], rel=1e-6)
    flat = Camera(200, 200, (30.0, 20.0), (100, 100), looking((0, -5, 0), (0, 0, 0)), "orthographic")
    assert pixels_per_unit(flat, BOX, None) == pytest.approx([30, 20])
    frame = make_frame()
    wide = Camera(200, 100, (320.0, 105.0), (100, 50), frame.camera_to_world)
    assert pixels_per_unit(wide, BOX, frame) == pytest.approx([320 / 1.6, 105 / 2.1])


def test_compositing_of_test_rays_is_front_to_back() -> None:
    draw = np.random.default_rng(0)
    alpha, colour = draw.random((5, 7)), draw.random((5, 7, 3))
    got = composite(colour, alpha)
    for row in range(5):
        light, total = 1.0, np.zeros(3)
        for k in range(7):
            total += light * colour[row, k]
            light *= 1 - alpha[row, k]
        assert got[row] == pytest.approx([*total, light])


@pytest.mark.hard_case(48, 49)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 16])
def test_the_samples_of_a_voxel_are_balanced_and_their_opacities_averaged(count: int) -> None:
    """A field that is linear in opacity is averaged exactly, since samples come in opposite pairs; colours count by opacity."""
    grid = VoxelGrid.inside(BOX, 2 / 20)
    voxels = np.random.default_rng(1).integers(2, 20, (200, 3))

    def alpha(p: np.ndarray) -> np.ndarray:
        return 0.4 + 0.2 * (p @ [0.5, 0.3, -0.4])

    linear = Formula(lambda p: -np.log1p(-alpha(p)) / grid.voxel_size, lambda p: 0.1 / alpha(p))
    colour, opacity = average_in_voxels(linear, grid, voxels, count, 3)
    assert np.abs(opacity - alpha(grid.voxel_centres(voxels))).max() < 1e-5
    assert np.abs(colour[:, :3] - 0.1).max() < 1e-5 and colour.shape == (200, 7)
    assert np.abs(colour[:, 3:] - 0.25 * opacity[:, None]).max() < 1e-5


@pytest.mark.hard_case(48)
def test_samples_are_spread_as_wide_as_a_voxel() -> None:
    """Their variance is that of an even distribution over the voxel: a twelfth of its side squared, along each axis."""
    grid = VoxelGrid.inside(BOX, 2 / 20)
    voxels = np.random.default_rng(2).integers(2, 20, (8000, 3))
    for axis in range(3):

        def density(p: np.ndarray, axis: int = axis) -> np.ndarray:
            off = ((p - grid.grid_to_world[:3, 3]) / grid.voxel_size)[:, axis] - voxels[:, axis] - 0.5
            return -np.log1p(-0.1 * off**2) / grid.voxel_size

        bowl = Formula(density)
        _, opacity = average_in_voxels(bowl, grid, voxels, 2, 5)
        assert opacity.mean() == pytest.approx(0.1 / 12, rel=0.06)


def test_test_rays_sample_the_field_and_the_voxels_where_they_say() -> None:
    """Four samples of the field to a voxel, one of the baked voxels; a slab's opacity is its thickness, along and across."""
    grid = VoxelGrid.inside(BOX, 2 / 20)
    start, direction = np.array([[3.0, 9.0, 9.0], [9.0, 9.0, 3.0]]), np.array([[1.0, 0, 0], [0, 0.6, 0.8]])
    even = Formula(lambda p: np.full(len(p), 2.0), lambda p: 0.5 + 0.2 * p[:, 0])
    colour, alpha = field_along(even, grid, start, direction)
    assert alpha.shape == (2, 32) and np.abs(alpha - -np.expm1(-2.0 * 0.1 / 4)).max() < 1e-6
    points = start[:, None] + direction[:, None] * ((np.arange(32) + 0.5) / 4)[:, None]
    place = grid.voxel_centres(points.reshape(-1, 3))[:, 0].reshape(2, 32)
    assert np.abs(colour[..., 0] - alpha * (0.5 + 0.2 * place)).max() < 1e-6
    colour, alpha = baked_along(even, grid, start, direction, 2, 0)
    assert alpha.shape == (2, 8) and np.abs(alpha - -np.expm1(-2.0 * 0.1)).max() < 1e-6
    points = start[:, None] + direction[:, None] * (np.arange(8) + 0.5)[:, None]
    place = grid.voxel_centres(points.reshape(-1, 3))[:, 0].reshape(2, 8)
    assert np.abs(colour[..., 0] - alpha * (0.5 + 0.2 * place)).max() < 1e-5, "linear in place, so that interpolation is exact"


def test_chunks_of_blocks_cover_all_and_cells_are_moved_to_the_front() -> None:
    sizes = np.random.default_rng(0).integers(0, 27000, 40)
    chunks = chunk_blocks(sizes)
    assert [row for chunk in chunks for row in range(chunk.start, chunk.stop)] == list(range(40))
    assert all(sizes[chunk].sum() <= 2 * VOXELS_PER_CHUNK for chunk in chunks) and len(chunks) > 3
    assert chunk_blocks(np.zeros(0, np.int64)) == []
    cells = np.arange(6)[:, None] * np.ones((6, 2), int)
    assert compact_cells(cells, np.array([1, 2, 5])).tolist() == [[1, 1], [2, 2], [5, 5]]


def test_boxes_of_blocks_are_those_of_a_loop() -> None:
    draw = np.random.default_rng(0)
    first = draw.integers(-3, 7, (30, 3))
    last = first + draw.integers(-1, 3, (30, 3))
    expected = np.zeros((5, 4, 6), bool)
    for low, high in zip(first, last, strict=True):
        for place in product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))):
            if all(0 <= p < n for p, n in zip(place, expected.shape, strict=True)):
                expected[place] = True
    assert np.array_equal(blocks_in_ranges(first, last, expected.shape), expected) and 0 < expected.mean() < 1


def test_blocks_are_numbered_anew_by_their_place() -> None:
    old, new = blocks_of_seed(4), blocks_of_seed(5)
    values = np.arange(int(old.max()) + 1) + 100
    got = reindex_blocks(values, old, new)
    for place in np.ndindex(*old.shape):
        if new[place] >= 0:
            assert got[new[place]] == (values[old[place]] if old[place] >= 0 else 0)


@pytest.mark.hard_case(34)
def test_voxels_are_dilated_along_one_axis_at_a_time_across_each_face() -> None:
    """A voxel in each corner of a block reaches seven neighbours, and no opposite side."""
    used = np.ones((3, 3, 3), bool)
    for corner in product((0, 29), repeat=3):
        own = np.zeros((27, 30, 30, 30), bool)
        own[13][corner] = True
        dense = np.zeros((90, 90, 90), bool)
        got = unpack_mask(dilate(pack_mask(own), number_blocks(used)))
        for place, voxels in zip(np.argwhere(used), got, strict=True):
            dense[tuple(slice(30 * b, 30 * b + 30) for b in place)] = voxels
        expected = np.argwhere(np.ones((3, 3, 3))) + 29 + np.array(corner)
        assert np.array_equal(np.argwhere(dense), expected)


@pytest.mark.hard_case(36, 44)
def test_cameras_keep_what_they_see_to_the_voxel() -> None:
    """A wall with nothing behind it that is seen: kept from its front to two coarse voxels behind what hides, on the camera's side."""
    wall = Formula(lambda p: np.where(np.abs(p[:, 1]) < 0.6, 400.0, 0))
    camera = Camera(200, 200, (150.0, 150.0), (100, 100), looking((0, -4, 0), (0, 0, 0)))
    whole, seen = (bake(wall, BOX, cameras, BakeSettings(60, supersampling=1)) for cameras in ((), (camera,)))
    dense = []
    for scene in (whole, seen):
        values = np.zeros([30 * n for n in scene.indirection.shape], bool)
        for place, cell in zip(block_coordinates(scene.indirection), scene.cells, strict=True):
            values[tuple(slice(30 * b, 30 * b + 30) for b in place)] = cell[1:-1, 1:-1, 1:-1, -1] > 0
        dense.append(values[20:42, :, 20:42])
    front = int(np.flatnonzero(dense[0].any(axis=(0, 2)))[0])
    assert dense[1][:, front : front + 3].all(), "every voxel of the front"
    kept = np.flatnonzero(dense[1].any(axis=(0, 2)))
    assert kept[0] == front and 4 <= len(kept) <= 10 < np.flatnonzero(dense[0].any(axis=(0, 2))).size


@pytest.mark.hard_case(45, 52)
@pytest.mark.parametrize("axis", range(3))
def test_what_is_lost_adds_up_along_the_row(axis: int) -> None:
    """Fog in a row of blocks along one axis: a ray along it loses all of it, one across a block's share."""
    size = np.full(3, 0.25)
    size[axis] = 2.0
    box = Box.axis_aligned(-size / 2, size / 2)
    grid = VoxelGrid.inside(box, 2 / 128)
    found = find_occupied_voxels(Formula(lambda p: np.full(len(p), 0.002)), grid, 0.005, ResumeCache(None, ""), lambda f: None)
    assert sorted(grid.blocks) == [1, 1, 5] and not len(found.mask)
    assert found.opacity_lost == pytest.approx(-np.expm1(-0.002 * 128 * grid.voxel_size), rel=0.02)


@pytest.mark.hard_case(46)
def test_cells_reach_as_far_as_their_corners_in_a_turned_box() -> None:
    """Against the corners of each occupied cell, turned unevenly: along each axis of the grid as far as one, and no block further."""
    from snerg.core.baking.occupied_voxels import candidate_blocks

    draw = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation((0.0, 0.3, 1.1)), (0.1, 0.0, -0.1)
    grid = VoxelGrid.inside(Box(pose, np.array([1.0, 1.2, 0.9])), 1.2 / 1800)
    expected = np.zeros(grid.blocks, bool)
    occupied = np.zeros((128,) * 3, bool)
    places = draw.integers(40, 88, (12, 3))
    occupied[tuple(places.T)] = True
    for place in places:
        corners = (place + np.array(list(product((0, 1), repeat=3)))) / 64 - 1
        voxels = (corners - grid.grid_to_world[:3, 3]) @ grid.grid_to_world[:3, :3] / grid.voxel_size
        low, high = (np.floor(ends / 30).astype(int) for ends in (voxels.min(axis=0) - 1e-3, voxels.max(axis=0) + 1e-3))
        expected[tuple(slice(max(a, 0), max(b + 1, 0)) for a, b in zip(low, high, strict=True))] = True
    assert np.array_equal(candidate_blocks(Formula(None, occupancy=occupied.reshape(-1)), grid), expected) and expected.any()


def test_a_dilated_mask_has_own_voxels_alone() -> None:
    own = np.zeros((2, 30, 30, 30), bool)
    own[0, 3, 3, 0] = own[0, 9, 9, 29] = own[1, 4, 4, 29] = True
    bits = dilate(pack_mask(own), np.arange(2, dtype=np.int32).reshape(1, 1, 2))
    assert not (bits & np.uint32(0x80000001)).any() and (bits & np.uint32(0x7FFFFFFE)).any()


def test_blocks_are_listed_by_their_numbers() -> None:
    indirection = np.full((2, 2, 2), -1, np.int32)
    indirection[1, 0, 1], indirection[0, 1, 0], indirection[1, 1, 1] = 2, 1, 0
    assert block_coordinates(indirection).tolist() == [[1, 1, 1], [0, 1, 0], [1, 0, 1]]


@pytest.mark.hard_case(6)
@pytest.mark.parametrize("projection", ["perspective", "equirectangular"])
def test_pixels_of_a_length_do_not_depend_on_where_the_scene_stands(projection: str) -> None:
    found = []
    for at in (np.zeros(3), np.array([1e3, -2e3, 5e2])):
        focal = (300.0, 300.0) if projection == "perspective" else (200 / np.pi / 2, 100 / np.pi)
        camera = Camera(200, 100, focal, (100, 50), looking(tuple(at + np.array([0, -4, 1])), tuple(at)), projection)
        found.append(pixels_per_unit(camera, Box.axis_aligned(at - 1, at + 1), None))
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    if projection == "equirectangular":
        assert found[0] == pytest.approx(np.array(focal) / np.linalg.norm([1, 5, 2])), "by the distance of the farthest corner"


def rods(width: float, fine: float = 16.0) -> Formula:
    def density(p: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(p[:, :2] * fine - np.round(p[:, :2] * fine), axis=-1) < width, 30.0, 0)

    return Formula(density)


def test_samples_double_while_they_pay() -> None:
    """The rule, on what was measured: each doubling but the last gains a fiftieth of the error or more, and there are at most sixteen."""
    grid, counts, gains = VoxelGrid.inside(BOX, 2 / 20), set(), []
    for made in (rods(0.3, 12.0), rods(0.35, 9.0), Formula(lambda p: 2 + np.sin(25 * p[:, 0]))):
        for seed in range(4):
            rng = np.random.default_rng(seed)
            start = rng.integers(3, 18, (40, 3))
            count, evidence = measure_supersampling(made, grid, start, rng, seed)
            tried, errors = [e["samples"] for e in evidence], [e["error"] for e in evidence]
            paid = [b <= (1 - MIN_GAIN) * a for a, b in pairwise(errors)]
            assert tried == [2**i for i in range(len(tried))] and tried[-1] <= MAX_SUPERSAMPLING == 16 and MIN_GAIN == 0.02
            assert all(paid[:-1]) and count == (tried[-1] if paid[-1] else tried[-2]) and (tried[-1] == 16 or not paid[-1])
            counts.add(count)
            gains += [1 - b / a for a, b in pairwise(errors) if a]
    assert {1, 16} <= counts and any(0 < gain < MIN_GAIN for gain in gains)
