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

RAYS = 16384  # rays rendered together; bounds the memory
STRETCH = 48  # samples of each ray between two checks for terminated rays
DARK = 1e-3  # transmittance below which a ray terminates: a quarter of a level of 8 bits


def render_field(field: Field, camera: Camera, progress: Progress = silent) -> Frame:
    """Volume-render a camera's picture (eqs. 5 to 7) at the sample spacing `field.spacing`. Needs JAX.

    Raises SnergError when the field's densities or colours are not finite.
    """
    origins, directions = camera.rays()
    count = len(origins)
    begin, end = camera.clip_distances(directions)
    o, d, near, far = space_rays(field.ndc, origins, directions, begin, end)
    parts = []
    for start in range(0, count, RAYS):
        rows = slice(start, start + RAYS)
        parts.append(through_space(field, o[rows], d[rows], near[rows], directions[rows], far[rows]))
        progress(min(start + RAYS, count) / count, "Rendering the field")
    gathered, transmittance = (np.concatenate(part) for part in zip(*parts, strict=True))
    rays = Composited(gathered[:, :3], gathered[:, 3:-1], transmittance, gathered[:, -1])
    colour, alpha = shade(field.network if field.view == "deferred" else None, rays, directions), 1 - transmittance
    depth = world_distance(field.ndc, origins, directions, mean_distance(np, rays.depth, alpha, 0.0), begin)
    depth = np.where(alpha > 1e-6, depth, np.inf).astype(np.float32)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))


def through_space(
    field: Field,
    origins: NDArray[Any],
    directions: NDArray[Any],
    near: NDArray[Any],
    view_directions: NDArray[Any],
    far: NDArray[Any] | float = np.inf,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """`integrate` for rays [R, 3] and lengths in the field's space (the world, or NDC: see `space_rays`) instead of field coordinates.

    Returns (composited values [R, C + 1], transmittance [R]); the last value is distance times weight, in units of the space.
    """
    centre, scale = field.domain.centre, field.domain.scale
    gathered, transmittance = integrate(field, (origins - centre) * scale, directions, near * scale, view_directions, far * scale)
    gathered[:, -1] /= np.float32(scale)
    return gathered, transmittance


def integrate(
    field: Field,
    origins: NDArray[Any],
    directions: NDArray[Any],
    near: NDArray[Any],
    view_directions: NDArray[Any],
    far: NDArray[Any] | float = np.inf,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Composite the field's values along rays (eqs. 5, 6), without shading.

    origins, directions [R, 3] (unit) and near, far ([R] or, for far, one float) are in field coordinates; view_directions: [R, 3] unit, in
    world axes. Samples begin at near and end at far, where the ray leaves the domain, or within STRETCH samples after its
    transmittance has fallen below DARK. Needs JAX.
    Returns (composited values [R, C + 1], transmittance [R]), float32. The last value is distance times weight, in field coordinates.
    """
    occupied = field.occupancy if field.occupancy is not None else np.ones(CELLS**3, bool)
    begin, leave = clip_rays(field.domain, origins, directions, near)
    leave = np.minimum(leave, far)
    live, stretch = np.flatnonzero(leave > begin), STRETCH * field.spacing
    gathered, transmittance = np.zeros((len(origins), 0), np.float32), np.ones(len(origins), np.float32)
    while len(live) or not gathered.shape[1]:  # once for no rays too, so that there are values
        end, middle = begin[live] + stretch, np.full(len(live), 0.5)
        got = pack_samples(field.domain, occupied, origins[live], directions[live], field.spacing, middle, begin[live], leave[live], end)
        density, values = field.seen(got.points, view_directions[live[got.ray]])
        values = np.concatenate([values, got.distance[:, None]], axis=-1)
        part, passed, _ = composite(np, optical_depth(np, density, np.float32(field.spacing)), values, got.ray, len(live))
        if not gathered.shape[1]:
            gathered = np.zeros((len(origins), part.shape[-1]), np.float32)
        gathered[live] += transmittance[live, None] * part
        transmittance[live] *= passed
        begin[live] = end
        live = live[(end < leave[live]) & (transmittance[live] > DARK)]
    return gathered, transmittance
