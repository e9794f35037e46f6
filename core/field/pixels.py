"""All pixels of a dataset, and the rays through them in the field's coordinates."""

from __future__ import annotations

import numpy as np

from ..capture.camera import Camera
from .sampling import Domain, dilated


class PixelPool:
    """Pixels by number, view after view, row by row. alpha: whether every image has it."""

    def __init__(self, images: list[np.ndarray], cameras: tuple[Camera, ...], domain: Domain) -> None:
        self.alpha = all(i.shape[-1] == 4 for i in images)
        self.pixels = np.concatenate([_with_alpha(i).reshape(-1, 4) for i in images])
        self.widths = np.array([c.width for c in cameras])
        ends = np.cumsum([c.width * c.height for c in cameras])
        self.starts, self.ends = ends - ends[0] if len(ends) == 1 else np.concatenate([[0], ends[:-1]]), ends
        self.focal = np.array([c.focal for c in cameras])
        self.centre = np.array([c.centre for c in cameras])
        self.pose = np.stack([c.camera_to_world for c in cameras])
        self.parallel = np.array([c.projection == "orthographic" for c in cameras])
        self.near = np.array([c.near for c in cameras]) * domain.scale
        self.domain = domain
        self.useful = self._useful(images) if self.alpha else None

    def _useful(self, images: list[np.ndarray]) -> np.ndarray:
        """Pixels on or near something, int64: the others' rays miss the hull and teach nothing."""
        masks = [dilated(i[..., 3] > 0, max(i.shape[:2]) // 40 + 2).reshape(-1) for i in images]
        found = np.flatnonzero(np.concatenate(masks))
        return found if len(found) else np.arange(len(self.pixels))

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """[count] pixel numbers."""
        if self.useful is not None:
            return self.useful[rng.integers(0, len(self.useful), count)]
        return rng.integers(0, len(self.pixels), count)

    def rays(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins, unit directions [N, 3] and near [N], field coordinates, of pixels by number (as Camera.rays)."""
        view = np.searchsorted(self.ends, index, side="right")
        row, column = np.divmod(index - self.starts[view], self.widths[view])
        x = (column + 0.5 - self.centre[view, 0]) / self.focal[view, 0]
        y = -(row + 0.5 - self.centre[view, 1]) / self.focal[view, 1]
        pose = self.pose[view]
        across = pose[:, :3, 0] * x[:, None] + pose[:, :3, 1] * y[:, None]
        back = pose[:, :3, 2]
        parallel = self.parallel[view, None]
        directions = np.where(parallel, -back, across - back)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        origins = np.where(parallel, pose[:, :3, 3] + across, pose[:, :3, 3])
        return (origins - self.domain.centre) * self.domain.scale, directions, self.near[view]


def _with_alpha(image: np.ndarray) -> np.ndarray:
    return image if image.shape[-1] == 4 else np.concatenate([image, np.full_like(image[..., :1], 255)], axis=-1)
