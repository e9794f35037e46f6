"""Pictures straight from a field, before any baking: what evaluation compares a bake with (JAX)."""

from __future__ import annotations

import numpy as np

from ..capture.camera import Camera
from ..capture.ndc import space_rays, world_distance
from ..grid.march import Composited, Frame, shade
from ..progress import Progress, silent
from .field import Field
from .sampling import CELLS, Samples, pack_samples
from .volume import composite, mean_distance, optical_depth

RAYS = 8192
STRETCH = 48  # samples of each ray that are evaluated before looking which rays are used up
DARK = 1e-4  # light of which no more is followed


def render_field(field: Field, camera: Camera, progress: Progress = silent) -> Frame:
    """Volume-render a camera's picture (eqs. 5 to 7) at the field's own sample spacing."""
    origins, directions = camera.rays()
    domain, count = field.domain, len(origins)
    o, d, near, _ = space_rays(field.ndc, origins, directions, camera.near)
    occupied = field.occupancy if field.occupancy is not None else np.ones(CELLS**3, bool)
    parts = []
    for start in range(0, count, RAYS):
        rows = slice(start, start + RAYS)
        x = (o[rows] - domain.centre) * domain.scale
        samples = pack_samples(domain, occupied, x, d[rows], field.spacing, np.full(len(x), 0.5), near[rows] * domain.scale)
        parts.append(integrate(field, samples, directions[rows]))
        progress(min(start + RAYS, count) / count, "Rendering the field")
    gathered, through = (np.concatenate(part) for part in zip(*parts, strict=True))
    rays = Composited(gathered[:, :3], gathered[:, 3:-1], through, gathered[:, -1] / np.float32(domain.scale))
    colour, alpha = shade(field.network if field.view == "deferred" else None, rays, directions), 1 - through
    depth = world_distance(field.ndc, origins, directions, mean_distance(np, rays.depth, alpha, 0.0), camera.near)
    depth = np.where(alpha > 1e-6, depth, np.inf).astype(np.float32)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))


def integrate(field: Field, samples: Samples, looking: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Composite what a field holds at packed samples of rays that look along `looking` [R, 3], front to back until light is used up.

    Returns values [R, C + 1], the last of them distance, and transmittance [R].
    """
    first = np.searchsorted(samples.ray, np.arange(len(looking)))
    place = np.arange(len(samples.ray)) - first[samples.ray]
    gathered, through = np.float32(0), np.ones(len(looking), np.float32)
    for start in range(0, int(place.max(initial=0)) + 1, STRETCH):
        now = np.flatnonzero((place >= start) & (place < start + STRETCH) & (through[samples.ray] > DARK))
        ray = samples.ray[now]
        density, values = field.seen(samples.points[now], looking[ray])
        values = np.concatenate([values, samples.distance[now, None]], axis=-1)
        part, passed, _ = composite(np, optical_depth(np, density, np.float32(field.spacing)), values, ray, len(looking))
        gathered, through = gathered + through[:, None] * part, through * passed
    return np.asarray(gathered), through
