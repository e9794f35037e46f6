"""A short look at a field: what it holds where, and how fast this machine works through it. What estimates are made from (JAX)."""

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
from ..baking.occupied_voxels import BLOCKS_PER_CHUNK, FAINT_DEPTH, block_optical_depth, candidate_blocks, cull_faint
from ..baking.resume import THREADS
from ..baking.supersampling import average_in_voxels, measure_supersampling
from ..baking.visibility import visibility_camera
from ..errors import SnergError
from ..export.atlas import atlas_blocks, slices
from ..export.codecs import pictures_of
from ..export.scene_files import PNG
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..geometry.ndc import space_rays
from ..io.images import png_bytes
from ..nerf.field import CHUNK, Field
from ..nerf.sampling import CELLS, Occupancy, cell_index, clip_rays
from ..nerf.volume_rendering import optical_depth
from ..rendering.acceleration import acceleration_of
from ..rendering.render import TILE, MarchSettings, march_rays, render_scene, tiled_pixels
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS, block_coordinates
from ..scene.quantize import quantize
from ..scene.scene import Scene
from ..scene.voxel_grid import VoxelGrid

POINTS = 4096  # that stand for all that a field may hold
FINENESS = (128, 256, 512, 1024)  # voxels along the domain's longest side at which they are looked at
PILOT = 2**17  # voxels that the small bake looks at, about
EYES = 32  # cameras that are looked from
FREE = 7.5  # voxels: what a ray takes a sample of, those round it, and the two that are let in beside (measured on a ball)
SEEN = 1024  # of the points, of which is found out whether they are seen
SAMPLE_RAYS = 100  # to choose samples a voxel by
CUBES = 40_000  # full ones that are kept at most
TIMED = 2  # which fineness is timed
BLOCKS = 48  # of it
SIZES = 40, 240  # sides of the pictures that are timed, as if they were square
LOOKS = 24, 96  # and of those that only look: their rays are further apart
REPEATS = 2
COUNTED = 48  # and of those whose samples are counted
STEEP = 1.2  # most that samples a ray may grow with: twice as fine, 2^1.2 times as many
WIDTH = 400  # of a camera where there is none
LOOKING = MarchSettings(stop_transmittance=BakeSettings().visibility_threshold)


@dataclass(frozen=True)
class Rates:
    """Seconds on this machine. start: compiling; test: a voxel of a block that may hold something; query: a point of the field, looked
    at in a bake; eye, look: a camera, and one of its rays, that decide what is visible; fill: a sample of a voxel; keep: a voxel
    that is filled, beside that; view, ray: a preview, and one of its rays; table: a block, before the first preview.
    bytes: of a kept voxel as PNG, in the small bake. met, growth: samples that a preview's ray takes there, and the power of the
    resolution with which they grow; seen_met, seen_growth: the same of rays that only look."""

    start: float
    test: float
    query: float
    eye: float
    look: float
    fill: float
    keep: float
    view: float
    ray: float
    table: float
    bytes: float
    met: float
    growth: float
    seen_met: float
    seen_growth: float


@dataclass(frozen=True, eq=False)
class FieldProbe:
    """What a field holds, by points [M, 3] of its space drawn evenly from what it may hold, each standing for `share` of its volume.

    coarse: the field with so few occupied cells that they are quickly gone through. inside: [M], whether the field may hold
    something just there. voxels: [S] sizes of voxels, falling. held, kept: bool [S, M], whether a voxel of that size there would
    hold something or border on what does, and whether some camera would see it too. samples: [S] what a bake would choose.
    filled: centres [N, 3] and the size of the cubes that hold something. pilot: voxel size of the small bake. seconds: that all
    this took, compiling left out.
    """

    field: Field
    coarse: Field
    points: NDArray[Any]
    share: float
    inside: NDArray[Any]
    voxels: NDArray[Any]
    held: NDArray[Any]
    kept: NDArray[Any]
    samples: tuple[int, ...]
    filled: tuple[NDArray[Any], float]
    pilot: float
    rates: Rates
    seconds: float


def probe_field(field: Field, seed: int = 0) -> FieldProbe:
    """Look at a field, and time this machine on it (JAX). Takes a few seconds beside compiling.

    Raises SnergError for a field that cannot be baked, or that is empty.
    """
    check_field(field)
    if field.occupancy is not None and not field.occupancy.any():
        raise SnergError("The field holds nothing, so that there is nothing to bake; train it longer.")
    began = time.perf_counter()
    field.query(field.domain.to_world(field.domain.low[None]))
    start = time.perf_counter() - began
    rng = np.random.default_rng(seed)
    box = field.domain.world_box()
    points, share = points_of(field, rng)
    inside = field.holds(field.domain.from_world(points))
    voxels = float(box.size.max()) / np.array(FINENESS)
    looks = [bordering(field, points, float(voxel)) for voxel in voxels]
    held = np.stack([found for found, _ in looks])
    kept = held & _reached(field, points, held, voxels, rng) if field.cameras else held
    samples = tuple(fitting(field, box, points[k], float(v), rng) for v, k in zip(voxels, kept, strict=True))
    resolution = small_resolution(field)
    coarser, small = pilot(field, box, resolution // 2), pilot(field, box, resolution)
    rates = timed(field, VoxelGrid.inside(box, float(voxels[TIMED])), points[kept[TIMED]], start, min(s for _, s in looks), small, coarser)
    took = time.perf_counter() - began - start
    return FieldProbe(
        field, coarse(field), points, share, inside, voxels, held, kept, samples, _filled(small), small.voxel_size, rates, took
    )


def coarse(field: Field) -> Field:
    """The field with cells of occupancy twice as large, again and again, until they are few."""
    while field.occupancy is not None and field.occupancy.sum() > CUBES:
        half = round(len(field.occupancy) ** (1 / 3)) // 2
        field = replace(field, occupancy=field.occupancy.reshape((half, 2) * 3).any(axis=(1, 3, 5)).reshape(-1))
    return field


def points_of(field: Field, rng: np.random.Generator) -> tuple[NDArray[Any], float]:
    """Points [M, 3] drawn evenly from the field's occupied cells and their neighbours, and the volume that each stands for."""
    wide = np.ones((CELLS,) * 3, bool) if field.occupancy is None else field.occupancy.reshape((CELLS,) * 3).copy()
    for axis in range(3):
        for way in (1, -1):  # what lies past the edge comes back on the other side, outside the domain or harmless
            wide |= np.roll(wide, way, axis)
    cells = np.flatnonzero(wide)
    x = Occupancy.points_in(rng.choice(cells, POINTS), rng)
    return field.domain.to_world(x), len(cells) * (2 / CELLS / field.domain.scale) ** 3 / POINTS


def bordering(field: Field, points: NDArray[Any], voxel: float) -> tuple[NDArray[Any], float]:
    """[M] bool: whether a voxel round each point, or one of its 26 neighbours, holds more than a bake leaves out; and the seconds
    that the field took a point."""
    around = np.array(list(product((-1, 0, 1), repeat=3))) * voxel
    parts = np.array_split((points[:, None] + around).reshape(-1, 3), 2 * THREADS)
    found, seconds = together(lambda some: field.query(some)[0], parts)
    thick = optical_depth(np, np.concatenate(found), np.float32(voxel)) > FAINT_DEPTH
    return thick.reshape(len(points), -1).any(axis=-1), seconds / (len(points) * len(around))


def together(work: Callable[[Any], Any], parts: Sequence[Any]) -> tuple[list[Any], float]:
    """Work done on parts by a few threads, as a bake's is, and the seconds that it took."""
    with ThreadPoolExecutor(THREADS) as pool:
        began = time.perf_counter()
        done = list(pool.map(work, parts))
        return done, time.perf_counter() - began


def _reached(field: Field, points: NDArray[Any], held: NDArray[Any], voxels: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """[S, M] bool: `seen` of SEEN of the points that hold something; of the others as large a share, anyhow."""
    some = np.flatnonzero(held.any(axis=0))
    some = some[:: max(1, len(some) // SEEN)]
    found = seen(field, points[some], voxels)
    share = (found & held[:, some]).sum(axis=1) / np.maximum(held[:, some].sum(axis=1), 1)
    reached = rng.random(held.shape) < share[:, None]
    reached[:, some] = found
    return reached


def seen(field: Field, points: NDArray[Any], voxels: NDArray[Any]) -> NDArray[Any]:
    """[S, M] bool: whether light comes from points (of the field's space) to one of a few cameras, by a grid of a density a cell.

    The first FREE voxels of the way count for nothing: so far does what is seen reach round what a ray meets (visibility.py).
    """
    density, step = _grid(field), 2 / CELLS
    start = field.domain.from_world(points)
    least = np.full((len(voxels), len(points)), np.inf, np.float32)
    for camera in field.cameras[:: max(1, len(field.cameras) // EYES)]:
        inside, back, length = _way(field, points, camera)
        _, leave = clip_rays(field.domain, start[inside], back[inside], 0.0)
        length = np.minimum(length[inside] * field.domain.scale, leave)
        along = ((np.arange(int(np.ceil(length.max(initial=0) / step)) + 1) + 0.5) * step).astype(np.float32)
        there = start[inside, None] + back[inside, None].astype(np.float32) * along[:, None]
        depth = density[cell_index(there.reshape(-1, 3))].reshape(len(there), -1) * np.float32(step)
        depth[along > length[:, None]] = 0
        left = np.cumsum(depth[:, ::-1], axis=1)[:, ::-1]
        for row, free in enumerate(FREE * voxels * field.domain.scale / step):
            first = min(int(free), left.shape[1] - 1)
            beyond = left[:, first] - min(free - first, 1.0) * depth[:, first]
            least[row, inside] = np.minimum(least[row, inside], beyond)
    return least <= -np.log(BakeSettings().visibility_threshold)


def _grid(field: Field) -> NDArray[Any]:
    """Density float32 [CELLS^3], per unit of field coordinates, at the centres of occupied cells, of every eighth where they are many."""
    cells = np.arange(CELLS**3) if field.occupancy is None else np.flatnonzero(field.occupancy)
    index = np.stack(np.unravel_index(cells, (CELLS,) * 3), axis=-1)
    coarse = 1 if len(cells) <= 2**18 else 2
    corner, back = np.unique((index // coarse) @ [CELLS**2, CELLS, 1], return_inverse=True)
    middle = (np.stack(np.unravel_index(corner, (CELLS,) * 3), axis=-1) + 0.5) * coarse * (2 / CELLS) - 1
    density = np.zeros(CELLS**3, np.float32)
    density[cells] = field.evaluate(middle.astype(np.float32))[0][back.reshape(-1)]
    return density


def _way(field: Field, points: NDArray[Any], camera: Camera) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Which points [M, 3] of the field's space are in a camera's picture [M], and the unit way [M, 3] and its length [M] to it there."""
    world = points if field.ndc is None else field.ndc.to_world(points)
    along = camera.toward(world)
    parallel = camera.projection == "orthographic"
    eye = world - camera.project(world)[1][:, None] * along if parallel else np.broadcast_to(camera.position, world.shape)
    origin, toward, near, _ = space_rays(field.ndc, eye, along, camera.near)
    return camera.shows(world), -toward, np.linalg.norm(points - origin, axis=-1) - near


def fitting(field: Field, box: Box, points: NDArray[Any], voxel: float, rng: np.random.Generator) -> int:
    """Samples a voxel that a bake would choose: as it does, by fewer rays, from some of the points [M, 3] that are kept."""
    if not len(points):
        return 1
    voxel_grid = VoxelGrid.inside(box, voxel)
    some = points[rng.choice(len(points), min(len(points), SAMPLE_RAYS), replace=False)]
    start = np.floor((some - voxel_grid.grid_to_world[:3, 3]) @ voxel_grid.grid_to_world[:3, :3] / voxel).astype(np.int64)
    return measure_supersampling(field, voxel_grid, start, rng, 0)[0]


def small_resolution(field: Field) -> int:
    """Of a small bake: about PILOT voxels are looked at."""
    occupied = CELLS**3 if field.occupancy is None else int(field.occupancy.sum())
    return int(np.clip(CELLS * (PILOT / max(occupied, 1)) ** (1 / 3), 48, 192))


def pilot(field: Field, box: Box, resolution: int) -> Scene:
    """A small bake, seen by a few of the cameras; what equation 9 would change in it is not looked at."""
    settings = BakeSettings(resolution=resolution, samples=1, opacity_correction=False)
    return bake(field, box, field.cameras[:: max(1, len(field.cameras) // 4)], settings)


def timed(field: Field, voxel_grid: VoxelGrid, points: NDArray[Any], start: float, query: float, small: Scene, coarser: Scene) -> Rates:
    """What this machine takes for parts of a bake on a lattice, some of whose kept voxels are round points [N, 3], and of a march.

    small, coarser: bakes of the field, the second half as fine.
    """
    candidates = np.argwhere(candidate_blocks(field, voxel_grid))
    places = candidates[np.linspace(0, len(candidates) - 1, min(len(candidates), BLOCKS)).astype(int)]
    _, tested = together(
        lambda some: cull_faint(block_optical_depth(field, voxel_grid, some), 0.005),
        np.array_split(places, max(1, len(places) // BLOCKS_PER_CHUNK)),
    )
    held = sum(int(field.holds(field.domain.from_world(voxel_grid.block_centres(place[None]))).sum()) for place in places)
    test = max(tested - query * held, 0.2 * tested) / max(len(places) * DATA_VOXELS**3, 1)
    corner = np.floor((points - voxel_grid.grid_to_world[:3, 3]) @ voxel_grid.grid_to_world[:3, :3] / voxel_grid.voxel_size).astype(
        np.int64
    )
    near = np.array(list(product(range(4), repeat=3)))  # so many that no chunk of points is mostly padding
    voxels = (np.maximum(corner[: 2 * THREADS * CHUNK // len(near)], 0)[:, None] + near).reshape(-1, 3)
    parts = np.array_split(voxels, 2 * THREADS)
    values, filled = together(lambda some: average_in_voxels(field, voxel_grid, some, 2, 0), parts)
    channels = 4 if field.network is None else 8
    mixed = [np.concatenate([colour[:, : channels - 1], alpha[:, None]], axis=-1) for colour, alpha in values]
    pairs = list(zip(parts, mixed, strict=True))
    _, kept = together(lambda pair: quantize(pair[1], voxel_uniform(pair[0], channels, 1)), pairs)
    views = field.cameras[:: max(1, len(field.cameras) // 2)][:2] or [outside(small.box)]
    eye, look, view, ray, table = _marches(small, views)
    met, growth = growing(small, coarser, views, MarchSettings())
    seen_met, seen_growth = growing(small, coarser, views, LOOKING)
    pictures = (picture for part in slices(small.cells, atlas_blocks(len(small.cells))) for picture in pictures_of(part, PNG).values())
    return Rates(
        start=start,
        test=test,
        query=query,
        eye=eye,
        look=look,
        fill=filled / max(2 * len(voxels), 1),
        keep=kept / max(len(voxels), 1),
        view=view,
        ray=ray,
        table=table,
        bytes=sum(len(png_bytes(picture)) for picture in pictures) / max(kept_voxels(small.about["bake"]), 1),
        met=met,
        growth=growth,
        seen_met=seen_met,
        seen_growth=seen_growth,
    )


def growing(small: Scene, coarser: Scene, views: Sequence[Camera], settings: MarchSettings) -> tuple[float, float]:
    """Samples that a ray takes in a bake, and the power of the resolution with which they grow, from a bake half as fine."""
    met, some = [], [_sized(camera, COUNTED) for camera in views]
    for scene in (coarser, small):
        taken = sum(march_rays(scene, *_rays(camera), settings, near=camera.near).samples or 0 for camera in some)
        met.append(taken / sum(_count(camera) for camera in some))
    ratio, finer = met[1] / max(met[0], 1e-6), coarser.voxel_size / small.voxel_size
    return met[1], float(np.clip(np.log(max(ratio, 1e-6)) / np.log(finer), 0, STEEP)) if finer > 1 else 0.0


def _sized(camera: Camera, side: int) -> Camera:
    """A camera with about side x side pixels, whatever its picture's shape."""
    scale = side / np.sqrt(camera.width * camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def _count(camera: Camera) -> int:
    """Rays of a picture, which is marched in whole tiles."""
    return -(-camera.width // TILE) * -(-camera.height // TILE) * TILE**2


def _rays(camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    return camera.rays(tiled_pixels(camera.width, camera.height))


def kept_voxels(told: dict[str, Any]) -> int:
    """Voxels that a bake filled, by what it tells of itself."""
    voxels = told["voxels"]
    return int(voxels["held"] if voxels["seen"] is None else voxels["seen"])


def _marches(snerg: Scene, views: Sequence[Camera]) -> tuple[float, float, float, float, float]:
    """Seconds of a camera and of each of its rays where they only look, of a picture and of each of its rays, and of the tables a block."""
    began = time.perf_counter()
    acceleration_of(snerg)
    table = (time.perf_counter() - began) / max(len(snerg.cells), 1)
    visited = np.zeros(len(snerg.cells) * CELL_VOXELS**3, bool)
    render_scene(snerg, views[0].resized(16, 16))  # what is done once

    def look(camera: Camera) -> None:
        march_rays(snerg, *_rays(camera), LOOKING, near=camera.near, visited=visited)

    return *_line(look, views, LOOKS), *_line(lambda camera: render_scene(snerg, camera), views, SIZES), table


def _line(work: Callable[[Camera], Any], views: Sequence[Camera], sides: Sequence[int]) -> tuple[float, float]:
    """Seconds that a camera costs, and each of its rays, from pictures of two sizes; what else runs on a machine only adds to them."""
    seconds, rays = [], []
    for side in sides:
        some = [_sized(camera, side) for camera in views]
        seconds.append(sum(min(_seconds(work, camera) for _ in range(REPEATS)) for camera in some) / len(some))
        rays.append(sum(_count(camera) for camera in some) / len(some))
    ray = max((seconds[1] - seconds[0]) / (rays[1] - rays[0]), 0.2 * seconds[1] / rays[1])
    return max(seconds[0] - ray * rays[0], 0.0), ray


def _seconds(work: Callable[[Camera], Any], camera: Camera) -> float:
    began = time.perf_counter()
    work(camera)
    return time.perf_counter() - began


def rays_of(field: Field, voxel_grid: VoxelGrid) -> float:
    """Rays of all cameras together that decide what is visible on a lattice, by some of them."""
    half, some = voxel_grid.halved(), field.cameras[:: max(1, len(field.cameras) // EYES)]
    nothing = np.full(half.blocks, -1, np.int32), np.zeros((0, *(CELL_VOXELS,) * 3, 4), np.uint8)
    scene = Scene(half.grid_to_world, half.voxel_size, half.shape, *nothing, None, ndc=field.ndc)
    return sum(_count(visibility_camera(camera, scene)) for camera in some) * len(field.cameras) / max(len(some), 1)


def outside(box: Box) -> Camera:
    """A camera that sees a box from Blender's front, for fields that come without cameras."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[:3, 3] = box.box_to_world[:3, 3] - [0, 1.8 * float(box.size.max()), 0]
    return Camera(WIDTH, WIDTH, (1.4 * WIDTH, 1.4 * WIDTH), (WIDTH / 2, WIDTH / 2), pose)


def _filled(snerg: Scene) -> tuple[NDArray[Any], float]:
    """Centres [N, 3] and the size of cubes, not too many, that hold something."""
    row, *local = np.nonzero(snerg.cells[:, 1:-1, 1:-1, 1:-1, -1])
    voxel, size = block_coordinates(snerg.indirection)[row] * DATA_VOXELS + np.stack(local, axis=-1), 1
    while len(voxel) > CUBES:
        voxel, size = np.unique(voxel // 2, axis=0), 2 * size
    local_centres = (voxel + 0.5) * (size * snerg.voxel_size)
    return local_centres @ snerg.grid_to_world[:3, :3].T + snerg.grid_to_world[:3, 3], size * snerg.voxel_size
