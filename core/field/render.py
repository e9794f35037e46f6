"""Pictures straight from a field, before any baking: what evaluation compares a bake with (JAX)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..capture.camera import Camera
from ..capture.ndc import space_rays, world_distance
from ..grid.march import Composited, Frame, shade
from .field import Field
from .sampling import CELLS, pack_samples
from .volume import composite, mean_distance, optical_depth

Progress = Callable[[float, str], None]
RAYS = 8192


def render_field(field: Field, camera: Camera, progress: Progress = lambda fraction, what: None) -> Frame:
    """Volume-render a camera's picture (eqs. 5 to 7) at the field's own sample spacing."""
    origins, directions = camera.rays()
    domain, count = field.domain, len(origins)
    o, d, near, _ = space_rays(field.ndc, origins, directions, camera.near)
    occupied = field.occupancy if field.occupancy is not None else np.ones(CELLS**3, bool)
    parts = []
    for start in range(0, count, RAYS):
        rows = slice(start, start + RAYS)
        x, size = (o[rows] - domain.centre) * domain.scale, len(o[rows])
        samples = pack_samples(domain, occupied, x, d[rows], field.spacing, np.full(size, 0.5), near[rows] * domain.scale)
        density, values = field.seen(samples.points, directions[rows][samples.ray])
        values = np.concatenate([values, samples.distance[:, None]], axis=-1)
        thickness = optical_depth(np, density, np.float32(field.spacing))
        parts.append(composite(np, thickness, values, samples.ray, size)[:2])
        progress(min(start + RAYS, count) / count, "Rendering the field")
    gathered, through = (np.concatenate(part) for part in zip(*parts, strict=True))
    rays = Composited(gathered[:, :3], gathered[:, 3:-1], through, gathered[:, -1] / np.float32(domain.scale))
    colour, alpha = shade(field.network if field.view == "deferred" else None, rays, directions), 1 - through
    depth = world_distance(field.ndc, origins, directions, mean_distance(np, rays.depth, alpha, 0.0), camera.near)
    depth = np.where(alpha > 1e-6, depth, np.inf).astype(np.float32)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))
