"""The field probe: what a field contains, by random points and a small bake, and how fast this machine processes it (JAX).

The measurements that the cost model (cost_model.py) starts from.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baking.bake import BakeSettings, bake, check_field
from ..baking.jitter import voxel_uniform
from ..baking.occupied_voxels import BLOCKS_PER_CHUNK, FAINT_DEPTH, ZERO_DEPTH, block_optical_depth, candidate_blocks, cull_faint
from ..baking.resume import THREADS
from ..baking.supersampling import average_in_voxels, measure_supersampling
from ..baking.visibility_rays import ray_grid
from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..geometry.ndc import space_rays
from ..nerf.field import CHUNK, Field
from ..nerf.frame import Composited
from ..nerf.sampling import CELLS, Occupancy, cell_index, clip_rays
from ..nerf.volume_rendering import optical_depth
from ..progress import Progress, silent
from ..rendering.acceleration import acceleration_of
from ..rendering.render import TILE, MarchSettings, march_rays, render_scene, tiled_pixels
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates
from ..scene.quantize import quantize, quantize_roots
from ..scene.scene import Scene
from ..scene.voxel_grid import VoxelGrid
from .voxel_bytes import kept_voxel_bytes

POINTS = 4096  # random points of the occupied cells: counts of voxels have a standard error of about 2 %
RESOLUTIONS = (128, 256, 512, 1024)  # voxels along the domain's longest side at which points are tested
PILOT_VOXELS = 2**17  # voxels in occupied cells at the resolution of the small bake, about: it takes a second
MIN_PILOT, MAX_PILOT = 48, 192  # voxels along the longest side of the small bake
PILOT_CAMERAS = 4  # that cull it
MAX_CAMERAS = 32  # whose visibility is tested; others are left out evenly
FREE_VOXELS = (
    7.5  # length of a ray before a point that does not hide it: its own sample's voxels, and the margin of 2 that visibility keeps
)
VISIBILITY_POINTS = 1024  # points whose visibility is tested; the others get the same share at random
SUPERSAMPLING_RAYS = 100  # test rays by which the samples a voxel are chosen
MAX_CUBES = 40_000  # occupied cubes, or cells of the coarse occupancy grid, that are kept
TIMED_RESOLUTION = 2  # index in RESOLUTIONS of the grid whose voxels are timed
TIMED_BLOCKS = 48  # blocks of that grid whose test is timed
PREVIEW_SIDES = 40, 240  # pixels along the sides of the two square images that are timed
VISIBILITY_SIDES = 24, 96  # and of those whose rays only mark visible voxels: they are further apart
REPEATS = 2  # of each timing; the shortest counts
COUNTED_SIDE = 48  # pixels along the sides of the square images whose samples are counted
MAX_GROWTH = 1.2  # of samples a ray with the resolution, as an exponent: a surface gives 0, a volume 1
DEFAULT_WIDTH = 400  # pixels of the camera that stands in where the field has none
VISIBILITY_MARCH = MarchSettings(stop_transmittance=BakeSettings().visibility_threshold)


@dataclass(frozen=True)
class Rates:
    """Times in seconds, bytes and counts of samples, measured on this machine with this field."""

    compile: float  # of the first query of the field
    block_voxel: float  # of a voxel of a candidate block that the occupancy stage tests
    query: float  # of a point at which the field is queried
    visibility_view: float  # of a camera of the visibility stage, apart from its rays
    visibility_ray: float  # of a ray of the visibility stage
    sample: float  # of a sample of a voxel in the prefilter stage
    kept_voxel: float  # of a kept voxel in the prefilter stage, apart from its samples
    preview_view: float  # of a preview, apart from its rays
    preview_ray: float  # of a ray of a preview
    acceleration_block: float  # of a block, to build the acceleration structure
    preview_samples: float  # samples of a ray of a preview of the small bake
    preview_growth: float  # the power of the resolution with which they grow
    visibility_samples: float  # samples of a ray of the visibility stage of the small bake
    visibility_growth: float  # the power of the resolution with which they grow


@dataclass(frozen=True, eq=False)
class FieldProbe:
    """What a field contains, by M random points, and how fast this machine processes it.

    The points are uniform in the field's occupied cells and their neighbours. S voxel sizes are tested.
    """

    field: Field
    coarse: Field  # the field with an occupancy grid of at most MAX_CUBES occupied cells
    points: NDArray[Any]  # [M, 3] in the field's space
    share: float  # volume that each point stands for, in units of that space
    inside: NDArray[Any]  # [M] bool, whether the point is in an occupied cell
    voxels: NDArray[Any]  # [S] sizes of voxels, falling
    held: NDArray[Any]  # [S, M] bool, whether a voxel there would hold something or border on one that does
    kept: NDArray[Any]  # [S, M] bool, whether a camera would see it too
    samples: tuple[int, ...]  # [S] samples a voxel that a bake would choose
    kept_bytes: NDArray[Any]  # [S] bytes of a kept voxel as PNG
    filled: tuple[NDArray[Any], float]  # centres [N, 3] of the cubes that hold something, and their size
    pilot: float  # voxel size of the small bake
    rates: Rates
    seconds: float  # that the probe took, compiling left out


def probe_field(field: Field, seed: int = 0, progress: Progress = silent) -> FieldProbe:
    """Test points of a field, bake it at a low resolution, and time this machine on it (JAX). Takes seconds, apart from compiling.

    Raises SnergError for a field that cannot be baked, or that is empty; Cancelled when `progress` does.
    """
    check_field(field)
    if field.occupancy is not None and not field.occupancy.any():
        raise SnergError("The field holds nothing, so that there is nothing to bake; train it longer.")
    progress(0.0, "Compiling")
    began = time.perf_counter()
    field.query(field.domain.to_world(field.domain.low[None]))
    compile_seconds = time.perf_counter() - began
    progress(0.1, "Baking at a low resolution")
    rng, box, resolution = np.random.default_rng(seed), field.domain.world_box(), small_resolution(field)
    coarser, small = small_bake(field, box, resolution // 2), small_bake(field, box, resolution)
    progress(0.4, "Testing random points")
    points, share = random_points(field, rng)
    voxels = float(box.size.max()) / np.array(RESOLUTIONS)
    tests = [occupied_or_bordering(field, points, float(voxel)) for voxel in voxels]
    held, query = np.stack([flags for flags, _, _ in tests]), min(seconds for _, seconds, _ in tests)
    kept = held & _visible_points(field, points, held, voxels, rng) if field.cameras else held
    samples = tuple(choose_supersampling(field, box, points[k], float(v), rng) for v, k in zip(voxels, kept, strict=True))
    progress(0.6, "Measuring the bytes of a few blocks")
    kept_bytes = _kept_bytes(field, box, points, kept, voxels, [faint for *_, faint in tests], small.square_roots)
    progress(0.8, "Timing this machine")
    grid, some = VoxelGrid.inside(box, float(voxels[TIMED_RESOLUTION])), points[kept[TIMED_RESOLUTION]]
    return FieldProbe(
        field=field,
        coarse=coarse(field),
        points=points,
        share=share,
        inside=field.holds(field.domain.from_world(points)),
        voxels=voxels,
        held=held,
        kept=kept,
        samples=samples,
        kept_bytes=kept_bytes,
        filled=_occupied_cubes(small),
        pilot=small.voxel_size,
        rates=_measure_rates(field, grid, some, compile_seconds, query, small, coarser),
        seconds=time.perf_counter() - began - compile_seconds,
    )


def coarse(field: Field) -> Field:
    """The field with occupancy cells of twice the size, repeated until at most MAX_CUBES are occupied."""
    while field.occupancy is not None and field.occupancy.sum() > MAX_CUBES:
        half = round(len(field.occupancy) ** (1 / 3)) // 2
        field = replace(field, occupancy=field.occupancy.reshape((half, 2) * 3).any(axis=(1, 3, 5)).reshape(-1))
    return field


def random_points(field: Field, rng: np.random.Generator) -> tuple[NDArray[Any], float]:
    """Uniform points [M, 3] of the field's occupied cells and their neighbours, and the volume that each stands for."""
    wide = np.ones((CELLS,) * 3, bool) if field.occupancy is None else field.occupancy.reshape((CELLS,) * 3).copy()
    for axis in range(3):
        for way in (1, -1):  # np.roll wraps at the edge; the extra cells hold nothing and change no count
            wide |= np.roll(wide, way, axis)
    cells = np.flatnonzero(wide)
    x = Occupancy.points_in(rng.choice(cells, POINTS), rng)
    return field.domain.to_world(x), len(cells) * (2 / CELLS / field.domain.scale) ** 3 / POINTS


def occupied_or_bordering(field: Field, points: NDArray[Any], voxel: float) -> tuple[NDArray[Any], float, bool]:
    """Whether a voxel centred at each point [M, 3], or one of its 26 neighbours, has more optical depth than a bake culls: [M] bool.

    voxel: its size. Also returns the seconds of a query of one point, and whether the field is so thin a fog that its faint voxels hold
    most of its optical depth: a bake keeps them then (see find_occupied_voxels).
    """
    around = np.array(list(product((-1, 0, 1), repeat=3))) * voxel
    parts = np.array_split((points[:, None] + around).reshape(-1, 3), 2 * THREADS)
    density, seconds = in_threads(lambda some: field.query(some)[0], parts)
    depth = optical_depth(np, np.concatenate(density), np.float32(voxel))
    faint = bool(2 * depth[depth <= FAINT_DEPTH].sum() > depth.sum())
    occupied = depth > (ZERO_DEPTH if faint else FAINT_DEPTH)
    return occupied.reshape(len(points), -1).any(axis=-1), seconds / (len(points) * len(around)), faint


def in_threads(work: Callable[[Any], Any], parts: Sequence[Any]) -> tuple[list[Any], float]:
    """The results of `work` on each part in THREADS threads, as in a bake, and the seconds that all took."""
    with ThreadPoolExecutor(THREADS) as pool:
        began = time.perf_counter()
        results = list(pool.map(work, parts))
        return results, time.perf_counter() - began


def _visible_points(field: Field, points: NDArray[Any], held: NDArray[Any], voxels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """[S, M] bool: `visible` of VISIBILITY_POINTS of the held points; of the others the same share, at random."""
    some = np.flatnonzero(held.any(axis=0))
    some = some[:: max(1, len(some) // VISIBILITY_POINTS)]
    flags = visible(field, points[some], voxels)
    share = (flags & held[:, some]).sum(axis=1) / np.maximum(held[:, some].sum(axis=1), 1)
    everywhere: NDArray[Any] = rng.random(held.shape) < share[:, None]
    everywhere[:, some] = flags
    return everywhere


def visible(field: Field, points: NDArray[Any], voxels: NDArray[Any]) -> NDArray[Any]:
    """Whether one of up to MAX_CAMERAS cameras sees each point [M, 3] in voxels of each size [S]: [S, M] bool.

    A point is visible where the transmittance to a camera is at least the visibility threshold. The density is that of occupancy cells.
    The first FREE_VOXELS of the way are left out, because the visibility stage keeps the voxels around each sample.
    """
    density, step = _cell_densities(field), 2 / CELLS
    start = field.domain.from_world(points)
    least = np.full((len(voxels), len(points)), np.inf, np.float32)  # optical depth to the best camera
    for camera in field.cameras[:: max(1, len(field.cameras) // MAX_CAMERAS)]:
        inside, direction, distance = _toward_camera(field, points, camera)
        _, leave = clip_rays(field.domain, start[inside], direction[inside], 0.0)
        distance = np.minimum(distance[inside] * field.domain.scale, leave)
        along = ((np.arange(int(np.ceil(distance.max(initial=0) / step)) + 1) + 0.5) * step).astype(np.float32)
        x = start[inside, None] + direction[inside, None].astype(np.float32) * along[:, None]
        depth = density[cell_index(x.reshape(-1, 3))].reshape(len(x), -1) * np.float32(step)
        depth[along > distance[:, None]] = 0
        remaining = np.cumsum(depth[:, ::-1], axis=1)[:, ::-1]  # optical depth from each step to the camera
        for row, free in enumerate(FREE_VOXELS * voxels * field.domain.scale / step):
            first = min(int(free), remaining.shape[1] - 1)
            beyond = remaining[:, first] - min(free - first, 1.0) * depth[:, first]
            least[row, inside] = np.minimum(least[row, inside], beyond)
    return np.asarray(least <= -np.log(BakeSettings().visibility_threshold))


def _cell_densities(field: Field) -> NDArray[Any]:
    """Density float32 [CELLS^3], per unit of field coordinates, at the centres of occupied cells; where there are more than 2^18 of
    them, eight cells share the density at their common corner."""
    cells = np.arange(CELLS**3) if field.occupancy is None else np.flatnonzero(field.occupancy)
    index = np.stack(np.unravel_index(cells, (CELLS,) * 3), axis=-1)
    width = 1 if len(cells) <= 2**18 else 2
    corner, inverse = np.unique((index // width) @ [CELLS**2, CELLS, 1], return_inverse=True)
    middle = (np.stack(np.unravel_index(corner, (CELLS,) * 3), axis=-1) + 0.5) * width * (2 / CELLS) - 1
    density = np.zeros(CELLS**3, np.float32)
    density[cells] = field.evaluate(middle.astype(np.float32))[0][inverse.reshape(-1)]
    return density


def _toward_camera(field: Field, points: NDArray[Any], camera: Camera) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Of points [M, 3] of the field's space: whether the camera's image shows them [M] bool, the unit direction [M, 3] to the camera in
    that space, and the distance [M] to its near plane."""
    world = points if field.ndc is None else field.ndc.to_world(points)
    along = camera.toward(world)
    parallel = camera.projection == "orthographic"
    eye = world - camera.project(world)[1][:, None] * along if parallel else np.broadcast_to(camera.position, world.shape)
    origin, toward, near, _ = space_rays(field.ndc, eye, along, camera.clip_distances(along)[0])
    return camera.shows(world), -toward, np.linalg.norm(points - origin, axis=-1) - near


def choose_supersampling(field: Field, box: Box, points: NDArray[Any], voxel: float, rng: np.random.Generator) -> int:
    """Samples a voxel of size `voxel` that a bake would choose, measured by fewer test rays, which start at kept points [M, 3]."""
    if not len(points):
        return 1
    grid = VoxelGrid.inside(box, voxel)
    some = points[rng.choice(len(points), min(len(points), SUPERSAMPLING_RAYS), replace=False)]
    return int(measure_supersampling(field, grid, _voxels_of(grid, some), rng, 0)[0])


def _voxels_of(grid: VoxelGrid, points: NDArray[Any]) -> NDArray[Any]:
    """The voxels [M, 3] int64 that points [M, 3] of the field's space are in."""
    local = (points - grid.grid_to_world[:3, 3]) @ grid.grid_to_world[:3, :3] / grid.voxel_size
    return np.asarray(np.floor(local).astype(np.int64))


def _kept_bytes(
    field: Field,
    box: Box,
    points: NDArray[Any],
    kept: NDArray[Any],
    voxels: NDArray[Any],
    faint: Sequence[bool],
    square_roots: bool,
) -> NDArray[Any]:
    """`kept_voxel_bytes` for voxels of each size [S], of blocks that hold points [M, 3] whose voxels are kept there, bool [S, M].

    faint: [S] whether faint voxels are kept. square_roots: whether the small bake stores them, as a bake of faint voxels does.
    """

    def of_size(row: int) -> float:
        grid = VoxelGrid.inside(box, float(voxels[row]))
        blocks = np.unique(np.maximum(_voxels_of(grid, points[kept[row]]), 0) // DATA_VOXELS, axis=0)
        inside = blocks[(blocks < grid.blocks).all(axis=-1)]
        return kept_voxel_bytes(field, grid, inside, quantize_roots if square_roots or faint[row] else quantize, faint[row])

    return np.array(in_threads(of_size, range(len(voxels)))[0])


def small_resolution(field: Field) -> int:
    """Resolution of the small bake: about PILOT_VOXELS voxels are in occupied cells."""
    occupied = CELLS**3 if field.occupancy is None else int(field.occupancy.sum())
    return int(np.clip(CELLS * (PILOT_VOXELS / max(occupied, 1)) ** (1 / 3), MIN_PILOT, MAX_PILOT))


def small_bake(field: Field, box: Box, resolution: int) -> Scene:
    """A bake with 1 sample a voxel and a few of the cameras, without opacity correction (equation 9)."""
    settings = BakeSettings(resolution=resolution, supersampling=1, opacity_correction=False)
    return bake(field, box, field.cameras[:: max(1, len(field.cameras) // PILOT_CAMERAS)], settings)


def _measure_rates(
    field: Field, grid: VoxelGrid, points: NDArray[Any], compile_seconds: float, query: float, small: Scene, coarser: Scene
) -> Rates:
    """The rates of this machine. grid, points [N, 3]: some voxels that a bake keeps. small, coarser: bakes, the second at half the
    resolution of the first."""
    views = field.cameras[:: max(1, len(field.cameras) // 2)][:2] or [outside_camera(small.box)]
    sample, kept_voxel = _time_prefilter(field, grid, points)
    visibility, preview, acceleration_block = _time_marching(small, views)
    preview_samples, preview_growth = sample_growth(small, coarser, views, MarchSettings())
    visibility_samples, visibility_growth = sample_growth(small, coarser, views, VISIBILITY_MARCH)
    return Rates(
        compile=compile_seconds,
        block_voxel=_time_blocks(field, grid, query),
        query=query,
        visibility_view=visibility[0],
        visibility_ray=visibility[1],
        sample=sample,
        kept_voxel=kept_voxel,
        preview_view=preview[0],
        preview_ray=preview[1],
        acceleration_block=acceleration_block,
        preview_samples=preview_samples,
        preview_growth=preview_growth,
        visibility_samples=visibility_samples,
        visibility_growth=visibility_growth,
    )


def _time_blocks(field: Field, grid: VoxelGrid, query: float) -> float:
    """Seconds of a voxel of a candidate block in the occupancy stage, apart from the queries in it, which take `query` seconds each."""
    candidates = np.argwhere(candidate_blocks(field, grid))
    some = candidates[np.linspace(0, len(candidates) - 1, min(len(candidates), TIMED_BLOCKS)).astype(int)]
    parts = np.array_split(some, max(1, len(some) // BLOCKS_PER_CHUNK))
    _, seconds = in_threads(lambda part: cull_faint(block_optical_depth(field, grid, part), 0.005), parts)
    queried = sum(int(field.holds(field.domain.from_world(grid.block_centres(block[None]))).sum()) for block in some)
    return max(seconds - query * queried, 0.2 * seconds) / max(len(some) * DATA_VOXELS**3, 1)


def _time_prefilter(field: Field, grid: VoxelGrid, points: NDArray[Any]) -> tuple[float, float]:
    """Seconds of a sample of a voxel in the prefilter stage, and of a voxel apart from its samples, near kept points [N, 3]."""
    neighbours = np.array(list(product(range(4), repeat=3)))  # 64 voxels a point, so that few chunks of points are mostly padding
    corners = np.maximum(_voxels_of(grid, points)[: 2 * THREADS * CHUNK // len(neighbours)], 0)
    voxels = (corners[:, None] + neighbours).reshape(-1, 3)
    parts = np.array_split(voxels, 2 * THREADS)
    values, sampling = in_threads(lambda part: average_in_voxels(field, grid, part, 2, 0), parts)
    channels = 4 if field.network is None else 8
    stored = [np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1) for colour, alpha in values]
    pairs = list(zip(parts, stored, strict=True))
    _, storing = in_threads(lambda pair: quantize(pair[1], voxel_uniform(pair[0], channels, 1)), pairs)
    return sampling / max(2 * len(voxels), 1), storing / max(len(voxels), 1)


def sample_growth(small: Scene, coarser: Scene, views: Sequence[Camera], settings: MarchSettings) -> tuple[float, float]:
    """(mean samples per ray of the views in `small`, the exponent g in samples ~ resolution^g, in [0, MAX_GROWTH]).

    g is measured by comparing with `coarser`, a bake of the same field at a lower resolution; 0 where it is not lower.
    """
    counts, some = [], [_resized(camera, COUNTED_SIDE) for camera in views]
    for scene in (coarser, small):
        samples = sum(_march(scene, camera, settings).samples or 0 for camera in some)
        counts.append(samples / sum(_ray_count(camera) for camera in some))
    ratio, finer = counts[1] / max(counts[0], 1e-6), coarser.voxel_size / small.voxel_size
    return counts[1], float(np.clip(np.log(max(ratio, 1e-6)) / np.log(finer), 0, MAX_GROWTH)) if finer > 1 else 0.0


def _resized(camera: Camera, side: int) -> Camera:
    """The camera with about side x side pixels, in its own aspect ratio."""
    scale = side / np.sqrt(camera.width * camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def _ray_count(camera: Camera) -> int:
    """Rays of an image, which is marched in whole tiles."""
    return -(-camera.width // TILE) * -(-camera.height // TILE) * TILE**2


def _march(scene: Scene, camera: Camera, settings: MarchSettings, visited: NDArray[Any] | None = None) -> Composited:
    """March an image's rays, in tiles."""
    origins, directions = camera.rays(tiled_pixels(camera.width, camera.height))
    near, far = camera.clip_distances(directions)
    return march_rays(scene, origins, directions, settings, near=near, visited=visited, far=far)


def _time_marching(scene: Scene, views: Sequence[Camera]) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Seconds (of a camera, of each of its rays) in the visibility stage, the same of a preview, and seconds of a block to build the
    acceleration structure."""
    began = time.perf_counter()
    acceleration_of(scene)
    block = (time.perf_counter() - began) / max(len(scene.cells), 1)
    visited = np.zeros(len(scene.cells) * CELL_VOXELS**3, bool)
    render_scene(scene, views[0].resized(16, 16))  # what is computed once for a scene

    def mark_visible(camera: Camera) -> None:
        _march(scene, camera, VISIBILITY_MARCH, visited)

    visibility = _time_view_and_ray(mark_visible, views, VISIBILITY_SIDES)
    return visibility, _time_view_and_ray(lambda camera: render_scene(scene, camera), views, PREVIEW_SIDES), block


def _time_view_and_ray(work: Callable[[Camera], Any], views: Sequence[Camera], sides: Sequence[int]) -> tuple[float, float]:
    """Seconds of a camera, and of each of its rays, from images of two sizes. Of the repeats the shortest counts, because other
    processes can only add time."""
    seconds, rays = [], []
    for side in sides:
        some = [_resized(camera, side) for camera in views]
        seconds.append(sum(min(_seconds(work, camera) for _ in range(REPEATS)) for camera in some) / len(some))
        rays.append(sum(_ray_count(camera) for camera in some) / len(some))
    ray = max((seconds[1] - seconds[0]) / (rays[1] - rays[0]), 0.2 * seconds[1] / rays[1])
    return max(seconds[0] - ray * rays[0], 0.0), ray


def _seconds(work: Callable[[Camera], Any], camera: Camera) -> float:
    began = time.perf_counter()
    work(camera)
    return time.perf_counter() - began


def visibility_rays(field: Field, grid: VoxelGrid) -> float:
    """Rays of all cameras together in the visibility stage of a bake to a grid, extrapolated from some of the cameras."""
    half, some = grid.halved(), field.cameras[:: max(1, len(field.cameras) // MAX_CAMERAS)]
    box = half.box_of(np.zeros(3), np.array(half.shape))
    return sum(ray_grid(camera, box, half.voxel_size, field.ndc).count for camera in some) * len(field.cameras) / max(len(some), 1)


def outside_camera(box: Box) -> Camera:
    """A camera that shows the whole box from -y (Blender's front view), for fields without cameras."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[:3, 3] = box.box_to_world[:3, 3] - [0, 1.8 * float(box.size.max()), 0]
    half = DEFAULT_WIDTH / 2
    return Camera(DEFAULT_WIDTH, DEFAULT_WIDTH, (2.8 * half, 2.8 * half), (half, half), pose)


def _occupied_cubes(scene: Scene) -> tuple[NDArray[Any], float]:
    """Centres [N, 3] and the size of at most MAX_CUBES cubes that together hold all occupied voxels."""
    row, *local = np.nonzero(scene.cells[:, 1:-1, 1:-1, 1:-1, -1])
    voxel, size = block_coordinates(scene.indirection)[row] * DATA_VOXELS + np.stack(local, axis=-1), 1
    while len(voxel) > MAX_CUBES:
        voxel, size = np.unique(voxel // 2, axis=0), 2 * size
    centres = (voxel + 0.5) * (size * scene.voxel_size)
    return centres @ scene.grid_to_world[:3, :3].T + scene.grid_to_world[:3, 3], size * scene.voxel_size
