"""Pictures straight from a field, before any baking: what evaluation compares a bake with (JAX)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..capture.camera import Camera
from ..grid.march import Composited, Frame, shade
from .field import Field
from .sampling import CELLS, pack_samples
from .volume import composite, optical_depth

Progress = Callable[[float, str], None]
RAYS = 8192


def render_field(field: Field, camera: Camera, progress: Progress = lambda fraction, what: None) -> Frame:
    """Volume-render a camera's picture (eqs. 5 to 7) at the field's own sample spacing."""
    origins, directions = camera.rays()
    count = len(origins)
    gathered, through = np.zeros((count, 8), np.float32), np.ones(count, np.float32)
    occupied = field.occupancy if field.occupancy is not None else np.ones(CELLS**3, bool)
    for start in range(0, count, RAYS):
        rows = slice(start, start + RAYS)
        x, towards = (origins[rows] - field.domain.centre) * field.domain.scale, directions[rows]
        samples = pack_samples(field.domain, occupied, x, towards, field.spacing, np.full(len(x), 0.5), camera.near * field.domain.scale)
        density, values = field.evaluate(samples.points)
        values = np.concatenate([values, samples.distance[:, None]], axis=-1)
        thickness = optical_depth(np, density, np.float32(field.spacing))
        gathered[rows], through[rows], _ = composite(np, thickness, values, samples.ray, len(x))
        progress(min(start + RAYS, count) / count, "Rendering the field")
    rays = Composited(gathered[:, :3], gathered[:, 3:7], through, gathered[:, 7] / np.float32(field.domain.scale))
    colour, alpha = shade(field.network, rays, directions), 1 - through
    depth = np.where(alpha > 0, rays.depth / np.maximum(alpha, 1e-6), np.inf).astype(np.float32)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))
