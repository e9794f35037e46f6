"""Renders a baked scene from a camera to colour, alpha and depth, with NumPy alone (section 5.2).

The samples of a ray lie at t_start + 0.5 + k voxels, k = 0, 1, 2, ... Empty-space skipping only moves to a later integer k, so that the
picture equals that of a march which visits every sample (hard case 33). Packets of 64 rays skip empty bricks together
(packet_traversal.py); then each ray skips empty bricks and voxels of its own (ray_marcher.py).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.ndc import world_distance
from ..io.settings import check_flag, check_number, check_whole
from ..nerf.frame import Composited, Frame, residual, shade
from ..progress import Progress, silent, within
from ..scene.scene import Scene
from .acceleration import acceleration_of
from .early_termination import stop_transmittance_for
from .opacity import correct_opacity
from .packet_traversal import PACKET_RAYS, intersect_grid, ray_type, start_batch
from .ray_marcher import MarchOutput, RayMarcher, RecordSamples
from .ray_queue import RayBatch, RayQueue

MAX_CHUNK_RAYS = 2**17  # rays that a thread sets up at once: packet traversal takes few NumPy calls on many packets
# Rays that are clipped against the grid, or shaded, at once. It keeps matrix products below the size from which BLAS starts threads of
# its own, which would spin while the marching threads need the processor.
RAYS_PER_PASS = 16384
MAX_BATCH, MAX_THREADS = 2**24, 1024  # that may be asked for: bound the memory
TILE = 8  # pixels along the side of a tile; its 64 rays are one packet
PROGRESS_SECONDS = 0.03  # between two calls of `progress`
PREVIEW_TOLERANCE = 0.5 / 255  # half a level of an 8-bit picture: the error cannot be seen
FIRST_REDUCTION = 4  # least factor by which the first picture of a progressive render is smaller along each side
FIRST_PIXELS = 2**15  # most pixels of that picture: two cores march them in less than 0.1 s, whatever the size of the whole one


@dataclass(frozen=True)
class MarchSettings:
    """How a scene is marched. The defaults give an exact picture (to 1e-4) in the least time. Raises SnergError for values out of range."""

    tolerance: float = 1e-4  # largest error of a displayed value, 0 to 1 (see early_termination.error_bound)
    stop_transmittance: float | None = None  # if given, rays stop below this transmittance, whatever the tolerance
    per_sample_network: bool = False  # view dependence at every sample instead of once a pixel (ablation of table 1)
    batch: int = 24576  # rays marched together in a thread: what fits the processor's caches
    threads: int = 2  # marching threads
    skip: bool = True  # skip empty space; the picture is the same without, but takes longer

    def __post_init__(self) -> None:
        check_number("The tolerance of a march", self.tolerance, 0, 1)
        if self.stop_transmittance is not None:
            check_number("The transmittance at which rays stop", self.stop_transmittance, 0, 1)
        check_flag("Whether the network is evaluated at every sample", self.per_sample_network)
        check_whole("The number of rays marched together", self.batch, 1, MAX_BATCH)
        check_whole("The number of marching threads", self.threads, 1, MAX_THREADS)
        check_flag("Whether empty space is skipped", self.skip)


def render_scene(scene: Scene, camera: Camera, settings: MarchSettings = MarchSettings(), progress: Progress = silent) -> Frame:
    """Render a baked scene from a camera, between its near and far planes. `progress` may raise Cancelled, which stops the march within
    tenths of a second."""
    pixels = tiled_pixels(camera.width, camera.height)
    span = _seen_span(scene, camera, pixels)
    near = span[0]
    rays = _march(scene, lambda part: camera.rays(pixels[part]), len(pixels), settings, progress, span)
    colour, alpha = rays.colour, 1 - rays.transmittance
    depth = np.where(alpha > 0, rays.depth / np.maximum(alpha, 1e-6), np.float32(np.inf))

    def finish(part: slice) -> None:
        """Depth in the world and view dependence of the pixels that are not empty, in place."""
        rows = part.start + np.flatnonzero(alpha[part] > 0)
        origins, directions = camera.rays(pixels[rows])
        depth[rows] = world_distance(scene.ndc, origins, directions, depth[rows], near[rows])
        if not settings.per_sample_network:
            colour[rows] = shade(scene.network, rays.part(rows), directions @ scene.view_rotation.T)

    if scene.network is not None or scene.ndc is not None:
        with ThreadPoolExecutor(settings.threads) as pool:
            list(pool.map(finish, _chunks(0, len(pixels), RAYS_PER_PASS)))
    images = [np.empty((camera.height, camera.width, *values.shape[1:]), np.float32) for values in (colour, alpha, depth)]
    for image, values in zip(images, (colour, alpha, depth), strict=True):
        image[pixels[:, 1], pixels[:, 0]] = values
    return Frame(*images)


def render_progressively(
    scene: Scene, camera: Camera, settings: MarchSettings = MarchSettings(), progress: Progress = silent
) -> Iterator[Frame]:
    """A frame of a quarter of the width and height, or of FIRST_PIXELS where that is fewer; then the whole frame.

    `progress` as in `render_scene`, over both.
    """
    reduction = max(FIRST_REDUCTION, math.ceil(math.sqrt(camera.width * camera.height / FIRST_PIXELS)))
    small = camera.resized(-(-camera.width // reduction), -(-camera.height // reduction))
    share = 1 / (1 + reduction**2)
    yield render_scene(scene, small, settings, within(progress, 0, share))
    yield render_scene(scene, camera, settings, within(progress, share, 1))


def tiled_pixels(width: int, height: int) -> NDArray[Any]:
    """All pixels in the order of their tiles, [N, 2] int (column, row); a tile past the image's edge repeats the pixels at the edge."""
    columns, rows = (np.minimum(np.arange(-(-size // TILE) * TILE), size - 1).reshape(-1, TILE) for size in (width, height))
    row, column = np.broadcast_arrays(rows[:, None, :, None], columns[None, :, None, :])
    return np.stack([column.reshape(-1), row.reshape(-1)], axis=-1)


def _seen_span(scene: Scene, camera: Camera, pixels: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """World units along the rays of pixels [N, 2], each [N] or None for infinity: where they begin, and where they end."""
    if camera.near == 0 and camera.far == np.inf and camera.projection != "fisheye":
        return np.full(len(pixels), scene.near), None
    _, directions = camera.rays(pixels)
    near, ends = camera.clip_distances(directions)
    far = None if camera.far == np.inf else ends
    valid = camera.valid_pixels() if camera.projection == "fisheye" else None
    if valid is not None:  # outside of its circle a fisheye shows nothing
        far = np.where(valid[pixels[:, 1], pixels[:, 0]], np.inf if far is None else far, 0)
    return np.maximum(scene.near, near), far


def march_rays(
    scene: Scene,
    origins: NDArray[Any],
    directions: NDArray[Any],
    settings: MarchSettings = MarchSettings(),
    progress: Progress = silent,
    near: NDArray[Any] | float = 0.0,
    visited: NDArray[Any] | None = None,
    record: RecordSamples | None = None,
    far: NDArray[Any] | None = None,
) -> Composited:
    """Composite rays of the world through a scene's grid, without view dependence (eqs. 5, 6).

    origins, directions: [N, 3] float64, directions of unit length. It is fastest when every 64 consecutive rays are close together.
    near, far: world units along the ray, [N] or, for near, one for all (see Camera.clip_distances); far is infinite where it is None.
    visited: bool [M * 32^3] or None; set to True at the voxels that samples fell into (see RayMarcher);
    these are always a block's own voxels, not its apron. record: is given the samples (see RayMarcher).
    """
    span = np.broadcast_to(np.asarray(near, np.float64), (len(origins),)), far
    return _march(scene, lambda part: (origins[part], directions[part]), len(origins), settings, progress, span, visited, record)


def _march(
    scene: Scene,
    rays: Callable[[slice], tuple[NDArray[Any], NDArray[Any]]],
    count: int,
    settings: MarchSettings,
    progress: Progress,
    span: tuple[NDArray[Any], NDArray[Any] | None],
    visited: NDArray[Any] | None = None,
    record: RecordSamples | None = None,
) -> Composited:
    """`march_rays` of `count` rays that `rays` generates a part at a time: (origins, directions), each [n, 3]. span: see `_seen_span`."""
    march = _March(scene, rays, count, settings, span)
    chunk = min(MAX_CHUNK_RAYS, max(-(-count // (settings.threads * PACKET_RAYS)), 1) * PACKET_RAYS)
    queue = RayQueue(march.make_batch, _chunks(0, count, chunk), settings.threads)
    stop = settings.stop_transmittance
    if stop is None:
        stop = stop_transmittance_for(settings.tolerance, scene, settings.per_sample_network)
    view_residual = march.view_residual if march.per_sample else None

    def work(cancelled: Callable[[], bool]) -> None:
        output, batch, skip = march.output, settings.batch, settings.skip
        RayMarcher(march.acceleration, queue, output, batch, stop, skip, visited, view_residual, cancelled, record).run()

    _run_threads(work, settings.threads, lambda: progress(queue.finished / max(count, 1), "Marching"))
    return march.result(queue.samples)


class _March:
    """The arrays of one march: what rays start with, and what comes out."""

    def __init__(
        self,
        scene: Scene,
        rays: Callable[[slice], tuple[NDArray[Any], NDArray[Any]]],
        count: int,
        settings: MarchSettings,
        span: tuple[NDArray[Any], NDArray[Any] | None],
    ) -> None:
        self.scene, self.rays, self.skip = scene, rays, settings.skip
        self.near, self.far = span
        self.acceleration = acceleration_of(scene)
        kind = ray_type(scene)
        self.output = MarchOutput(np.zeros((count, self.acceleration.channels), kind), np.ones(count, kind))
        self.start = np.zeros(count, kind)  # voxels from a ray's origin to where it enters the grid
        self.per_sample = scene.network is not None and settings.per_sample_network
        self.view_directions = np.empty((count if self.per_sample else 0, 3), np.float32)

    def make_batch(self, chunk: slice) -> RayBatch:
        """The rays of a chunk that may hit something (see RayQueue)."""
        parts = [self._clip(part) for part in _chunks(chunk.start, chunk.stop, RAYS_PER_PASS)]
        entry, direction, start, stop = (np.concatenate(values, axis=-1) for values in zip(*parts, strict=True))
        self.start[chunk] = start
        return start_batch(self.acceleration, entry, direction, start, stop, self.skip, chunk.start)

    def _clip(self, part: slice) -> tuple[NDArray[Any], ...]:
        origins, directions = self.rays(part)
        if self.per_sample:
            self.view_directions[part] = directions @ self.scene.view_rotation.T
        return intersect_grid(self.scene, origins, directions, self.near[part], None if self.far is None else self.far[part])

    def view_residual(self, colour: NDArray[Any], features: NDArray[Any], index: NDArray[Any]) -> NDArray[Any]:
        """View dependence of samples (see ray_marcher.ViewResidual)."""
        assert self.scene.network is not None
        return residual(self.scene.network, colour, features, self.view_directions[index])

    def result(self, samples: int) -> Composited:
        """The composited rays, with opacity correction where the scene asks for it. Depth is made world units from the ray's origin."""
        values, transmittance = self.output.values, self.output.transmittance
        depth = values[:, -1] + (1 - transmittance) * self.start
        depth *= depth.dtype.type(self.scene.voxel_size)
        colour, features = values[:, :3].astype(np.float32, copy=False), values[:, 3:-1].astype(np.float32, copy=False)
        transmittance, depth = transmittance.astype(np.float32, copy=False), depth.astype(np.float32, copy=False)
        rays = Composited(colour, features, transmittance, depth, samples)
        return correct_opacity(rays) if self.scene.opacity_correction else rays


def _chunks(first: int, last: int, size: int) -> list[slice]:
    """The range from `first` to `last` (excluded) cut into slices of at most `size`."""
    return [slice(start, min(start + size, last)) for start in range(first, last, size)]


def _run_threads(work: Callable[[Callable[[], bool]], None], threads: int, tell: Callable[[], None]) -> None:
    """Run `work` in several threads and wait for all. `tell` is called repeatedly in this thread, at least once.

    `work` is given a function that says whether to stop. An exception in any thread, or of `tell`, stops all threads and is raised here.
    """
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
