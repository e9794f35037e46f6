"""All pixels of a dataset, and the rays through them in the field's coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera
from ..geometry.distortion import Distortion, Lenses
from ..geometry.ndc import Ndc, space_rays
from ..nerf.sampling import Domain, dilated


class RayDataset:
    """Pixels by number, view after view, row by row.

    pixels: [N, 4] uint8, sRGB with straight alpha, 255 where an image has none. alpha: whether every image has it and it
    varies. withheld: [views] bool, views that `draw` passes over; set it at will.
    """

    def __init__(
        self,
        images: Iterable[NDArray[Any]],
        cameras: Sequence[Camera],
        domain: Domain,
        masks: Sequence[NDArray[Any] | None] | None = None,
        ndc: Ndc | None = None,
    ) -> None:
        """images: one at a time, uint8 [H, W, 3 or 4] of its camera's size. masks: a view's [H, W] bool, False where a pixel is
        not to be learned from, or None for all. Raises SnergError when the masks leave nothing."""
        self.domain, self.ndc = domain, ndc
        self.widths = np.array([c.width for c in cameras])
        self.ends = np.cumsum([c.width * c.height for c in cameras])
        self.starts = self.ends - self.widths * np.array([c.height for c in cameras])
        self.focal = np.array([c.focal for c in cameras])
        self.centre = np.array([c.centre for c in cameras])
        self.pose = np.stack([c.camera_to_world for c in cameras])
        self.parallel = np.array([c.projection == "orthographic" for c in cameras])
        self.near = np.array([c.near for c in cameras])
        self.withheld = np.zeros(len(cameras), bool)
        self._set_lenses(cameras)
        self.pixels = np.empty((int(self.ends[-1]), 4), np.uint8)
        self.alpha = self._fill(images)
        self.useful = self._unmasked(cameras, masks or [None] * len(cameras))

    def _set_lenses(self, cameras: Sequence[Camera]) -> None:
        """Equal lenses are one."""
        kinds = list(dict.fromkeys(c.distortion for c in cameras))
        self.lens = np.array([kinds.index(c.distortion) for c in cameras])
        straight = Distortion("opencv")
        self.lenses = Lenses([k or straight for k in kinds]) if kinds != [None] else None

    def _fill(self, images: Iterable[NDArray[Any]]) -> bool:
        """Put the images in their places, and say whether they have an alpha that varies."""
        everywhere, varies = True, False
        for start, end, image in zip(self.starts, self.ends, images, strict=True):
            place = self.pixels[start:end]
            place[:, 3] = 255
            place[:, : image.shape[-1]] = image.reshape(-1, image.shape[-1])
            everywhere &= image.shape[-1] == 4
            varies = varies or bool((place[:, 3] < 255).any())
        return everywhere and varies

    def keep_near(self, silhouettes: Sequence[NDArray[Any]], masks: Sequence[NDArray[Any] | None]) -> None:
        """Draw only what no mask hides and what is on or near the scene, because the other rays miss it and teach nothing.

        silhouettes: of each view [H, W] bool; masks: as for the constructor. Silhouettes that hold nothing change nothing.
        """
        near = [dilated(s, max(s.shape) // 40 + 2) for s in silhouettes]
        kept = self._numbers([n if m is None else n & m for n, m in zip(near, masks, strict=True)])
        self.useful = kept if len(kept) else self.useful

    def _numbers(self, keep: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """The numbers of the pixels kept, of each view [H, W] bool."""
        kind = np.int32 if len(self.pixels) < 2**31 else np.int64
        return np.concatenate([(np.flatnonzero(k) + start).astype(kind) for start, k in zip(self.starts, keep, strict=True)])

    def _unmasked(self, cameras: Sequence[Camera], masks: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
        """The numbers of the pixels that no mask hides, None where all are."""
        if all(m is None for m in masks):
            return None
        kept = self._numbers([np.ones((c.height, c.width), bool) if m is None else m for c, m in zip(cameras, masks, strict=True)])
        if not len(kept):
            raise SnergError("The masks hide every pixel of every image; in a mask, white is what to use.")
        return kept

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[Any]:
        """[count] pixel numbers, int64, of views that are not withheld. Raises SnergError when all are."""
        if self.withheld.all():
            raise SnergError("Every view is held out; there is none to train on.")
        index = self._draw(count, rng)
        if not self.withheld.any():
            return index
        again = np.flatnonzero(self.withheld[self._view(index)])
        for _ in range(1000):
            if not len(again):
                return index
            index[again] = self._draw(len(again), rng)
            again = again[self.withheld[self._view(index[again])]]
        raise SnergError("Hardly a pixel is in a view that is not held out; hold out fewer views, or hide less with masks.")

    def _draw(self, count: int, rng: np.random.Generator) -> NDArray[Any]:
        if self.useful is None:
            return rng.integers(0, len(self.pixels), count)
        return np.asarray(self.useful[rng.integers(0, len(self.useful), count)].astype(np.int64))

    def _view(self, index: NDArray[Any]) -> NDArray[Any]:
        return np.searchsorted(self.ends, index, side="right")

    def rays(self, index: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Origins and unit directions [N, 3], near and far [N] in the field's coordinates, and unit directions [N, 3] in the
        world, all float64, of pixels by number (as Camera.rays and space_rays)."""
        view = self._view(index)
        row, column = np.divmod(index - self.starts[view], self.widths[view])
        flat = (np.stack([column, row], axis=-1) + 0.5 - self.centre[view]) / self.focal[view]
        if self.lenses is not None:
            flat = self.lenses.undistort(self.lens[view], flat)
        pose = self.pose[view]
        across = pose[:, :3, 0] * flat[:, :1] - pose[:, :3, 1] * flat[:, 1:]
        back = pose[:, :3, 2]
        parallel = self.parallel[view, None]
        looking = np.where(parallel, -back, across - back)
        looking /= np.linalg.norm(looking, axis=-1, keepdims=True)
        origins = np.where(parallel, pose[:, :3, 3] + across, pose[:, :3, 3])
        origins, directions, near, far = space_rays(self.ndc, origins, looking, self.near[view])
        scale = self.domain.scale
        return (origins - self.domain.centre) * scale, directions, near * scale, far * scale, looking
