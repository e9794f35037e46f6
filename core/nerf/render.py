"""Volume rendering of a field (section 4.2, eqs. 5 to 7), without baking: the reference for a bake. Needs JAX."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.ndc import space_rays, world_distance
from ..progress import Progress, silent
from .field import Field
from .frame import Composited, Frame, shade
from .sampling import CELLS, clip_rays, pack_samples
from .volume_rendering import composite, mean_distance, optical_depth

RAYS = 16384  # rays in memory together
STRETCH = 48  # steps of each ray between two checks which rays have terminated
DARK = 1e-3  # transmittance below which a ray terminates: a quarter of a level of 8 bits


def render_field(field: Field, camera: Camera, progress: Progress = silent) -> Frame:
    """Volume-render a camera's picture (eqs. 5 to 7) at the field's own sample spacing."""
    origins, directions = camera.rays()
    count = len(origins)
    o, d, near, _ = space_rays(field.ndc, origins, directions, camera.near)
    parts = []
    for start in range(0, count, RAYS):
        rows = slice(start, start + RAYS)
        parts.append(through_space(field, o[rows], d[rows], near[rows], directions[rows]))
        progress(min(start + RAYS, count) / count, "Rendering the field")
    gathered, through = (np.concatenate(part) for part in zip(*parts, strict=True))
    rays = Composited(gathered[:, :3], gathered[:, 3:-1], through, gathered[:, -1])
    colour, alpha = shade(field.network if field.view == "deferred" else None, rays, directions), 1 - through
    depth = world_distance(field.ndc, origins, directions, mean_distance(np, rays.depth, alpha, 0.0), camera.near)
    depth = np.where(alpha > 1e-6, depth, np.inf).astype(np.float32)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))


def through_space(
    field: Field,
    origins: NDArray[Any],
    directions: NDArray[Any],
    near: NDArray[Any],
    looking: NDArray[Any],
    far: NDArray[Any] | float = np.inf,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """`integrate` along rays [R, 3] of the field's space, with lengths in its units."""
    centre, scale = field.domain.centre, field.domain.scale
    gathered, through = integrate(field, (origins - centre) * scale, directions, near * scale, looking, far * scale)
    gathered[:, -1] /= np.float32(scale)
    return gathered, through


def integrate(
    field: Field,
    origins: NDArray[Any],
    directions: NDArray[Any],
    near: NDArray[Any],
    looking: NDArray[Any],
    far: NDArray[Any] | float = np.inf,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Composite what a field holds along rays [R, 3] of its coordinates that look along `looking` [R, 3] in the world, a stretch after
    another, from `near` [R] as far as light reaches, or `far` [R].

    Returns values [R, C + 1], the last of them distance, and transmittance [R].
    """
    occupied = field.occupancy if field.occupancy is not None else np.ones(CELLS**3, bool)
    begin, leave = clip_rays(field.domain, origins, directions, near)
    leave = np.minimum(leave, far)
    live, stretch = np.flatnonzero(leave > begin), STRETCH * field.spacing
    gathered, through = np.zeros((len(origins), 0), np.float32), np.ones(len(origins), np.float32)
    while len(live) or not gathered.shape[1]:  # once for no rays too, so that there are values
        end, middle = begin[live] + stretch, np.full(len(live), 0.5)
        got = pack_samples(field.domain, occupied, origins[live], directions[live], field.spacing, middle, begin[live], leave[live], end)
        density, values = field.seen(got.points, looking[live[got.ray]])
        values = np.concatenate([values, got.distance[:, None]], axis=-1)
        part, passed, _ = composite(np, optical_depth(np, density, np.float32(field.spacing)), values, got.ray, len(live))
        if not gathered.shape[1]:
            gathered = np.zeros((len(origins), part.shape[-1]), np.float32)
        gathered[live] += through[live, None] * part
        through[live] *= passed
        begin[live] = end
        live = live[(end < leave[live]) & (through[live] > DARK)]
    return gathered, through
