"""The marcher: a baked scene and a camera to colour, alpha and depth, with NumPy alone (section 5.2).

One lattice of samples a ray, t_start + 0.5 + k voxels: skipping only ever moves to a later integer k, so the
picture is the one that a dense march gives (hard case 33). What is skipped is known to be zero: bundles of rays pass
through empty bricks together (approach.py), rays one by one through bricks and voxels that hold nothing (walk.py).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.ndc import world_distance
from ..nerf.frame import Composited, Frame, residual, shade
from ..progress import Progress, silent, within
from ..scene.scene import Scene
from .acceleration import acceleration_of
from .early_termination import stop_transmittance_for
from .packet_traversal import PACKET_RAYS, intersect_grid, start_batch
from .ray_marcher import MarchOutput, RayMarcher
from .ray_queue import RayBatch, RayQueue

MAX_CHUNK_RAYS = 2**17  # rays whose way through empty space is found together: few steps of many bundles
# Rays that are made, or shaded, together, and those whose colours the network is asked for in one product. BLAS would take threads of its
# own for more, and keep them waiting in a loop for the next product while the marcher's own want the processor.
RAYS_PER_PASS = 16384
TILE = 8  # pixels along the side of a tile, whose rays are one bundle
PROGRESS_SECONDS = 0.03  # between two calls of `progress`
PREVIEW_TOLERANCE = 0.5 / 255  # a tolerance: half a level of a picture of 8 bits
FIRST_REDUCTION = 4  # how many times smaller, each way, the first picture is


@dataclass(frozen=True)
class MarchSettings:
    """tolerance: the largest error allowed in a displayed value, 0 to 1; what follows from it is derived in tolerance.py.
    stop_transmittance: if given, a ray ends when less than this passes, whatever the tolerance.
    per_sample_network: view dependence at every sample instead of once a pixel, to compare with (table 1 of the paper).

    batch: rays marched together (what fits the caches), new ones taken in as others end. threads: such batches at a time.
    skip: jump over what is empty; the picture is the same without, only later.
    """

    tolerance: float = 1e-4
    stop_transmittance: float | None = None
    per_sample_network: bool = False
    batch: int = 24576
    threads: int = 2
    skip: bool = True


def render_scene(
    scene: Scene,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),
    progress: Progress = silent,
) -> Frame:
    """Render a baked scene from a camera. `progress` may raise Cancelled; that stops the march within a few tenths of a second."""
    pixels, near = tiled_pixels(camera.width, camera.height), max(scene.near, camera.near)
    found = _march(scene, lambda some: camera.rays(pixels[some]), len(pixels), settings, progress, near)
    colour, alpha = found.colour, 1 - found.transmittance
    depth = np.where(alpha > 0, found.depth / np.maximum(alpha, 1e-6), np.float32(np.inf))

    def finish(some: slice) -> None:
        seen = some.start + np.flatnonzero(alpha[some] > 0)
        origins, directions = camera.rays(pixels[seen])
        depth[seen] = world_distance(scene.ndc, origins, directions, depth[seen], near)
        if not settings.per_sample_network:
            colour[seen] = shade(scene.network, found.part(seen), directions @ scene.view_rotation.T)

    if scene.network is not None or scene.ndc is not None:
        with ThreadPoolExecutor(settings.threads) as pool:
            list(pool.map(finish, _chunks(0, len(pixels), RAYS_PER_PASS)))
    picture = [np.empty((camera.height, camera.width, *values.shape[1:]), np.float32) for values in (colour, alpha, depth)]
    for whole, values in zip(picture, (colour, alpha, depth), strict=True):
        whole[pixels[:, 1], pixels[:, 0]] = values
    return Frame(*picture)


def render_progressively(
    scene: Scene,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),
    progress: Progress = silent,
) -> Iterator[Frame]:
    """First a picture of a quarter of the width and height, then the whole one. `progress` as in `march`, over both."""
    small = camera.resized(-(-camera.width // FIRST_REDUCTION), -(-camera.height // FIRST_REDUCTION))
    share = 1 / (1 + FIRST_REDUCTION**2)
    yield render_scene(scene, small, settings, within(progress, 0, share))
    yield render_scene(scene, camera, settings, within(progress, share, 1))


def tiled_pixels(width: int, height: int) -> NDArray[Any]:
    """[N, 2] (column, row) of all pixels, tile by tile; tiles that reach past the picture's edge repeat the pixels there."""
    across, down = (np.minimum(np.arange(-(-size // TILE) * TILE), size - 1).reshape(-1, TILE) for size in (width, height))
    row, column = np.broadcast_arrays(down[:, None, :, None], across[None, :, None, :])
    return np.stack([column.reshape(-1), row.reshape(-1)], axis=-1)


def march_rays(
    scene: Scene,
    origins: NDArray[Any],
    directions: NDArray[Any],
    settings: MarchSettings = MarchSettings(),
    progress: Progress = silent,
    near: float = 0.0,
    visited: NDArray[Any] | None = None,
) -> Composited:
    """Composite rays given in the world (origins and unit directions [N, 3] float64) through the grid (eqs. 5, 6).

    Quickest where every 64 rays that follow one another are close together. near: world units along the ray. visited: bool
    [M * 32^3], set where a sample was taken in a voxel (always in a block's own part of its cell).
    """
    return _march(scene, lambda some: (origins[some], directions[some]), len(origins), settings, progress, near, visited)


def _march(
    scene: Scene,
    rays: Callable[[slice], tuple[NDArray[Any], NDArray[Any]]],
    count: int,
    settings: MarchSettings,
    progress: Progress,
    near: float,
    visited: NDArray[Any] | None = None,
) -> Composited:
    """`march_rays` of rays that are made when their turn comes."""
    tables = acceleration_of(scene)
    into = MarchOutput(np.zeros((count, tables.channels), np.float32), np.ones(count, np.float32))
    begins = np.zeros(count, np.float32)
    sampled = scene.network is not None and settings.per_sample_network
    views = np.empty((count if sampled else 0, 3), np.float32)

    def entered(some: slice) -> tuple[NDArray[Any], ...]:
        origins, directions = rays(some)
        if sampled:
            views[some] = directions @ scene.view_rotation.T
        return intersect_grid(scene, origins, directions, near)

    def make(some: slice) -> RayBatch:
        parts = [entered(part) for part in _chunks(some.start, some.stop, RAYS_PER_PASS)]
        entry, direction, start, stop = (np.concatenate(values, axis=-1) for values in zip(*parts, strict=True))
        begins[some] = start
        return start_batch(tables, entry, direction, start, stop, settings.skip, some.start)

    def shaded(colour: NDArray[Any], features: NDArray[Any], index: NDArray[Any]) -> NDArray[Any]:
        assert scene.network is not None
        return residual(scene.network, colour, features, views[index])

    light = settings.stop_transmittance
    if light is None:
        light = stop_transmittance_for(settings.tolerance, scene, settings.per_sample_network)

    bundled = min(MAX_CHUNK_RAYS, max(-(-count // (settings.threads * PACKET_RAYS)), 1) * PACKET_RAYS)
    supply = RayQueue(make, _chunks(0, count, bundled), settings.threads)

    def work(cancelled: Callable[[], bool]) -> None:
        RayMarcher(tables, supply, into, settings.batch, light, settings.skip, visited, shaded if sampled else None, cancelled).run()

    _run_threads(work, settings.threads, lambda: progress(supply.finished / max(count, 1), "Marching"))
    depth = into.values[:, -1] + (1 - into.through) * begins
    depth *= np.float32(scene.voxel_size)
    found = Composited(into.values[:, :3], into.values[:, 3:-1], into.through, depth, supply.samples)
    return correct_opacity(found) if scene.opacity_correction else found


def _chunks(first: int, last: int, most: int) -> list[slice]:
    return [slice(start, min(start + most, last)) for start in range(first, last, most)]


def _run_threads(work: Callable[[Callable[[], bool]], None], threads: int, tell: Callable[[], None]) -> None:
    """Do `work` in several threads; `tell` is called now and then, at least once, in this one. Whatever one of them raises ends all."""
    stopped = threading.Event()
    with ThreadPoolExecutor(threads) as pool:
        running = {pool.submit(work, stopped.is_set) for _ in range(threads)}
        try:
            while running:
                done, running = wait(running, PROGRESS_SECONDS)
                for one in done:
                    one.result()
                tell()
        finally:
            stopped.set()


def correct_opacity(rays: Composited) -> Composited:
    """Rays up to 1.5 times as opaque, all of what they gather with them (eq. 9): baking lets a little light through surfaces.

    The factor is written so that it is finite at alpha 0 and continuous at 2/3, above which a ray is opaque (hard case 53).
    """
    alpha = 1 - rays.transmittance
    factor = np.where(alpha < 2 / 3, 1.5, 1 / np.maximum(alpha, 2 / 3)).astype(np.float32)
    through = np.maximum(1 - factor * alpha, 0)
    return Composited(rays.colour * factor[:, None], rays.features * factor[:, None], through, rays.depth * factor, rays.samples)
