"""Sampling of rays: visual hull (Laurentini 1994), occupancy grid (Mueller et al. 2022, section 5), packed samples.

Lengths are in field coordinates, in which the domain fits [-1, 1]^3; a density is per unit of that length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.box import Box
from ..geometry.camera import Camera

CELLS = 128  # cells of the occupancy grid along an axis (Mueller et al. 2022)
MAX_STRETCH = 3  # of angles in the picture of a panorama or wide fisheye, up to which it carves
PARALLEL = 1e-12  # component of a unit direction below which a ray stays where it is along that axis: less than any spacing of samples
COARSE_CELLS = 64  # cells along an axis of the first, coarse carving, which finds the extent of the visual hull


@dataclass(frozen=True, eq=False)
class Domain:
    """The transform from the field's space (the world, or NDC) to field coordinates, x = (p - centre) * scale, and a box in these."""

    centre: NDArray[Any]  # [3] float64, in the space
    scale: float  # field coordinates per unit of the space
    low: NDArray[Any]  # [3] float64, field coordinates: the lowest corner of the box outside of which the field is empty
    high: NDArray[Any]  # [3] float64, the highest corner

    @classmethod
    def around(cls, low: NDArray[Any], high: NDArray[Any]) -> Domain:
        """The domain of the axis-aligned box from `low` [3] to `high` [3], whose longest side becomes [-1, 1]."""
        centre = (low + high) / 2
        scale = 2 / float((high - low).max())
        half = (high - low) / 2 * scale
        return cls(centre, scale, -half, half)

    def from_world(self, points: NDArray[Any]) -> NDArray[Any]:
        """Field coordinates [N, 3] float32 of points [N, 3] float64. The centre is subtracted in float64, so that points far from the
        origin keep their precision (hard case 6)."""
        return np.asarray(((points - self.centre) * self.scale).astype(np.float32))

    def to_world(self, x: NDArray[Any]) -> NDArray[Any]:
        """Points [N, 3] float64 of field coordinates [N, 3]; the inverse of `from_world`."""
        return np.asarray(np.asarray(x, np.float64) / self.scale + self.centre)

    def world_box(self) -> Box:
        """The box from `low` to `high` in world units, axis-aligned."""
        return Box.axis_aligned(self.to_world(self.low), self.to_world(self.high))


def carve(points: NDArray[Any], cameras: Sequence[Camera], masks: Sequence[NDArray[Any] | None], radius: float) -> NDArray[Any]:
    """Whether world points [N, 3] are in the visual hull, bool [N] (Laurentini 1994): at least one camera sees the point, and it lies in
    the silhouette of every camera that sees it.

    masks: a camera's silhouette [H, W] bool, or None where its image has none; such a camera excludes no point. A camera whose picture
    does not contain a point, or whose clip planes hide it, does not exclude it either. radius: in world units; a point is kept when the
    silhouette meets the sphere of this radius around it.
    """
    alive, left = np.arange(len(points)), points  # the indices of the points that no camera excluded yet, and these points
    seen = np.zeros(len(points), bool)
    for camera, mask in zip(cameras, masks, strict=True):
        pixels, depth = camera.project(left)
        x, y = pixels[:, 0], pixels[:, 1]
        inside = (depth > camera.near) & (depth < camera.far) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        seen[alive] |= inside
        if mask is None:
            continue
        size = footprint(camera, depth[inside], radius)
        gone = inside
        if camera.is_wide:
            size *= MAX_STRETCH
            gone = inside.copy()
            gone[inside] = _measurable(camera, pixels[inside], size)
        row, column = (np.where(gone, at, 0).astype(np.int64) for at in (y, x))
        kept = np.flatnonzero(~gone | dilated(mask, size).ravel().take(row * camera.width + column))
        alive, left = alive.take(kept), left.take(kept, axis=0)
    result = np.zeros(len(points), bool)
    result[alive] = True
    return np.asarray(result & seen)


def _measurable(camera: Camera, pixels: NDArray[Any], size: int) -> NDArray[Any]:
    """Whether a wide camera's picture is stretched at most MAX_STRETCH times at pixels [N, 2], and, for a panorama, the seam is more than
    `size` pixels away, bool [N]: elsewhere a sphere may cover any number of pixels, or come back on the other side."""
    sure = camera.stretch(pixels) <= MAX_STRETCH
    if camera.projection == "equirectangular":
        sure &= (pixels[:, 0] > size) & (pixels[:, 0] < camera.width - size)
    return np.asarray(sure)


def footprint(camera: Camera, depth: NDArray[Any], radius: float) -> int:
    """The radius in pixels of a sphere of `radius` world units at the nearest of depths [N], at most an eighth of the picture."""
    if not len(depth):
        return 1
    nearest = 1.0 if camera.projection == "orthographic" else max(float(depth.min()), 1e-9)
    return int(min(np.ceil(max(camera.focal) * radius / nearest) + 1, max(camera.width, camera.height) / 8 + 1))


def dilated(mask: NDArray[Any], radius: int) -> NDArray[Any]:
    """Dilation of a mask, bool [H, W], by a square of 2 * radius + 1 pixels; bool [H, W]."""
    for axis in (0, 1):
        total = np.cumsum(np.insert(mask, 0, False, axis=axis), axis=axis, dtype=np.int32)
        size = mask.shape[axis]
        index = np.arange(size)
        upper = np.minimum(index + radius + 1, size)
        lower = np.maximum(index - radius, 0)
        mask = np.take(total, upper, axis=axis) > np.take(total, lower, axis=axis)
    return mask


def hull(box: Box, cameras: Sequence[Camera], masks: Sequence[NDArray[Any] | None]) -> tuple[Domain, NDArray[Any]]:
    """(domain, occupancy bool [CELLS^3], z fastest): the visual hull of a capture, and the smallest domain that contains it.

    Carving runs twice: with COARSE_CELLS over the whole box for the extent of the hull, then with CELLS over that extent.
    When the hull is empty because the silhouettes contradict each other, the domain is the whole box and every cell is occupied.
    """
    corners = box.corners()
    whole = Domain.around(corners.min(axis=0), corners.max(axis=0))
    coarse = cells_alive(whole, COARSE_CELLS, box, cameras, masks)
    if not coarse.any():
        return whole, np.ones(CELLS**3, bool)
    where = np.argwhere(coarse.reshape((COARSE_CELLS,) * 3))
    size = 2 / COARSE_CELLS
    low = np.maximum(where.min(axis=0) * size - 1 - size / 2, whole.low)
    high = np.minimum((where.max(axis=0) + 1) * size - 1 + size / 2, whole.high)
    tight = Domain.around(whole.to_world(low), whole.to_world(high))
    alive = cells_alive(tight, CELLS, box, cameras, masks)
    return tight, alive if alive.any() else np.ones(CELLS**3, bool)


def cells_alive(domain: Domain, cells: int, box: Box, cameras: Sequence[Camera], masks: Sequence[NDArray[Any] | None]) -> NDArray[Any]:
    """The cells of [-1, 1]^3 inside the box and the visual hull, bool [cells^3], z fastest."""
    x = cell_centres(cells)
    margin = 1.0 / cells
    near = ((x >= domain.low - margin) & (x <= domain.high + margin)).all(axis=-1)
    alive = np.zeros(cells**3, bool)
    candidates = np.flatnonzero(near)
    world = domain.to_world(x[candidates])
    radius = np.sqrt(3) / cells / domain.scale
    grown = Box(box.box_to_world, box.size + 2 * radius)
    held = grown.contains(world)
    alive[candidates[held]] = carve(world[held], cameras, masks, radius)
    return alive


def cell_centres(cells: int) -> NDArray[Any]:
    """The centres [cells^3, 3] of the cells of a grid on [-1, 1]^3, z fastest, float64."""
    axis = (np.arange(cells) + 0.5) * (2 / cells) - 1
    return np.asarray(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3))


def estimates(value: NDArray[Any], name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """A copy of estimates read from a training's state: float32 >= 0, of any shape `shape`, infinite where not measured.

    Raises ValueError, which begins with `name`, when `value` is anything else.
    """
    if value.shape != shape or value.dtype != np.float32 or not (value >= 0).all():
        raise ValueError(f"{name} is {value.dtype} {value.shape}, or not above 0; it must be float32 {shape}")
    return value.copy()


class Occupancy:
    """The occupancy grid of a field in training (Mueller et al. 2022, section 5).

    cells: indices of the occupied cells. most: float32 [CELLS^3], z fastest, a running upper estimate of the density in each cell, per
    unit of field coordinates; infinite in cells that were not measured yet, 0 in empty cells.
    """

    def __init__(self, most: NDArray[Any]) -> None:
        self.most = most
        self.cells = np.flatnonzero(most > 0)

    @classmethod
    def of_hull(cls, alive: NDArray[Any]) -> Occupancy:
        """The occupancy grid before training: the cells of the visual hull, bool [CELLS^3], are occupied and not yet measured."""
        return cls(np.where(alive, np.float32(np.inf), np.float32(0)))

    def update(self, query: Callable[[NDArray[Any]], NDArray[Any]], count: int, rng: np.random.Generator) -> None:
        """Measure the density at one random point in each of up to `count` occupied cells; `query` maps [N, 3] float32 to density [N]."""
        cells = self.cells if len(self.cells) <= count else rng.choice(self.cells, count, replace=False)
        found = query(self.points_in(cells, rng))
        most = self.most[cells]
        self.most[cells] = np.where(np.isinf(most), found, np.maximum(found, 0.8 * most + 0.2 * found))

    def prune(self, threshold: float) -> None:
        """Mark cells as empty whose upper estimate of the density is at most `threshold`. They stay empty: without samples in them the
        field is not trained there, so its density there means nothing."""
        given_up = self.cells[self.most[self.cells] <= threshold]
        self.most[given_up] = 0
        self.cells = np.flatnonzero(self.most > 0)

    @staticmethod
    def points_in(cells: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
        """A random point in each of the cells with indices [N]: field coordinates [N, 3] float32."""
        index = np.stack(np.unravel_index(cells, (CELLS,) * 3), axis=-1)
        return ((index + rng.random(index.shape)) * (2 / CELLS) - 1).astype(np.float32)

    @property
    def occupied(self) -> NDArray[Any]:
        """The cells that may hold something, bool [CELLS^3], z fastest."""
        return self.most > 0


def clip_rays(
    domain: Domain, origins: NDArray[Any], directions: NDArray[Any], near: float | NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Distances [N] at which rays (field coordinates, unit directions) enter and leave the domain; leave <= enter is a miss.

    A ray that is parallel to a face lies between the two faces, on one of them, or beside them, whatever its other components are
    (hard cases 31, 32).
    """
    parallel = np.abs(directions) < PARALLEL
    safe = np.where(parallel, 1.0, directions)
    first = np.where(parallel, -np.inf, (domain.low - origins) / safe)
    second = np.where(parallel, np.inf, (domain.high - origins) / safe)
    beside = parallel & ((origins < domain.low) | (origins > domain.high))
    enter = np.maximum(np.minimum(first, second).max(axis=-1), near)
    leave = np.maximum(first, second).min(axis=-1)
    return enter, np.where(beside.any(axis=-1), enter, leave)


@dataclass(frozen=True, eq=False)
class Samples:
    """The N samples of R rays in one list, ray after ray. Lengths are in field coordinates."""

    points: NDArray[Any]  # [N, 3] float32
    ray: NDArray[Any]  # [N] the samples' rays, ascending
    length: float  # spacing of the samples along a ray
    distance: NDArray[Any]  # [N] float32, from the ray's origin
    cut: NDArray[Any]  # [R] bool, rays that `until` cuts off before they leave the domain


def pack_samples(
    domain: Domain,
    occupied: NDArray[Any],
    origins: NDArray[Any],
    directions: NDArray[Any],
    length: float,
    offset: NDArray[Any],
    near: float | NDArray[Any] = 0.0,
    far: float | NDArray[Any] = np.inf,
    until: float | NDArray[Any] = np.inf,
) -> Samples:
    """Sample rays at a constant spacing `length` and keep the samples in occupied cells (Mueller et al. 2022, section 5).

    All lengths are in field coordinates. occupied: bool [CELLS^3]. origins, directions: [R, 3], the directions of length 1.
    Sample i of a ray lies at the distance enter + (i + offset) * length; offset: [R] in [0, 1).
    enter is where the ray enters the domain, but at least near; the last sample comes before it leaves the domain, before far and
    before until. near, far, until: [R] or one float; `until` is an estimate (a termination depth), so Samples.cut marks its rays.
    """
    enter, counts, cut = count_steps(domain, origins, directions, length, offset, near, far, until)
    ray, step = coarse_steps(occupied, origins, directions, enter, length, offset, counts)
    distance = (enter[ray] + (step + offset[ray]) * length).astype(np.float32)
    points = origins[ray].astype(np.float32) + directions[ray].astype(np.float32) * distance[:, None]
    full = np.flatnonzero(occupied[cell_index(points)])
    return Samples(points[full], ray[full], length, distance[full], cut)


def count_steps(
    domain: Domain,
    origins: NDArray[Any],
    directions: NDArray[Any],
    length: float,
    offset: NDArray[Any],
    near: float | NDArray[Any],
    far: float | NDArray[Any],
    until: float | NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(distance at which each ray enters the domain [R], number of its steps int64 [R], whether `until` cuts it bool [R]).

    A ray that misses the domain has no steps. See `pack_samples`.
    """
    enter, leave = clip_rays(domain, origins, directions, near)
    leave = np.minimum(leave, far)
    cut = until < leave
    leave = np.minimum(leave, until)
    return enter, np.ceil(np.maximum(leave - enter, 0) / length - offset).clip(0).astype(np.int64), cut


BLOCK = 8  # steps of a ray that one lookup in the coarse grid decides on


def coarse_steps(
    occupied: NDArray[Any],
    origins: NDArray[Any],
    directions: NDArray[Any],
    enter: NDArray[Any],
    length: float,
    offset: NDArray[Any],
    counts: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """(ray [N], step [N]) of the steps of rays that a coarser occupancy grid does not exclude, in order along each ray.

    enter, offset, counts: [R], a ray's first distance, the offset of its steps in [0, 1) and their number. Other arguments: see
    `pack_samples`.
    """
    span = BLOCK * length
    blocks = -(-counts // BLOCK)
    ray = np.repeat(np.arange(len(counts)), blocks)
    first = np.cumsum(blocks) - blocks
    block = np.arange(len(ray)) - first[ray]
    middle = enter[ray] + (offset[ray] + (BLOCK - 1) / 2) * length + block * span
    points = origins[ray].astype(np.float32) + directions[ray].astype(np.float32) * middle[:, None].astype(np.float32)
    coarse, factor = coarser(occupied, span)
    index = ((points + 1) * np.float32(CELLS // factor / 2)).astype(np.int32).clip(0, CELLS // factor - 1)
    size = CELLS // factor
    keep = np.flatnonzero(coarse[(index[:, 0] * size + index[:, 1]) * size + index[:, 2]])
    ray = np.repeat(ray[keep], BLOCK)
    step = (block[keep, None] * BLOCK + np.arange(BLOCK)).reshape(-1)
    inside = step < counts[ray]
    return ray[inside], step[inside]


_coarser: dict[tuple[int, int, int], tuple[NDArray[Any], NDArray[Any]]] = {}


def coarser(occupied: NDArray[Any], span: float) -> tuple[NDArray[Any], int]:
    """(occupancy bool [(CELLS / factor)^3] in cells `factor` times as wide, factor).

    It is dilated, so that one lookup at the middle of a ray segment of length `span` (field coordinates) finds any occupied cell that
    the segment meets. Smaller cells exclude more, larger ones need less dilation: a cell is at most half of the segment.
    """
    factor = 1
    while factor < 8 and 8 * factor / CELLS <= span:  # of cells at most a quarter as long as the segment, two become one
        factor *= 2
    reach = int(np.ceil(span / 2 * CELLS / (2 * factor)))
    key = (id(occupied), reach, factor)
    kept = _coarser.get(key)
    if kept is None or kept[0] is not occupied:
        size = CELLS // factor
        coarse = occupied.reshape(size, factor, size, factor, size, factor).any(axis=(1, 3, 5))
        for axis in range(3):
            for _ in range(reach):
                wide = coarse.copy()
                ahead, back = [slice(None)] * 3, [slice(None)] * 3
                ahead[axis], back[axis] = slice(1, None), slice(None, -1)
                wide[tuple(back)] |= coarse[tuple(ahead)]
                wide[tuple(ahead)] |= coarse[tuple(back)]
                coarse = wide
        _coarser.clear()
        kept = _coarser[key] = (occupied, coarse.reshape(-1))
    return kept[1], factor


def cell_index(points: NDArray[Any]) -> NDArray[Any]:
    """The index [N] of the occupancy cell of points [N, 3] in field coordinates, z fastest; outside [-1, 1]^3, of the nearest cell.

    Points and result are NumPy or JAX arrays.
    """
    index = ((points + np.float32(1)) * np.float32(CELLS / 2)).astype(np.int32).clip(0, CELLS - 1)
    cell: NDArray[Any] = (index[:, 0] * CELLS + index[:, 1]) * CELLS + index[:, 2]
    return cell
