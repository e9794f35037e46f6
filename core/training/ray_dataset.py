"""All pixels of a dataset, and their rays in field coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry import wide
from ..geometry.camera import LEAST_COSINE, Camera
from ..geometry.distortion import Distortion, Lenses
from ..geometry.ndc import Ndc, space_rays
from ..nerf.sampling import Domain, dilated


class RayDataset:
    """The pixels of all views and their rays. Pixels are numbered view after view, row by row.

    pixels: [N, 4] uint8, sRGB with straight alpha, which is 255 where an image has none. alpha: whether every image has an alpha channel
    and some pixel is not opaque. diffuse: [N, 3] uint8, the sRGB colour of the light on diffuse surfaces, with the alpha of `pixels`; None
    where it is not trained on. withheld: [views] bool, views from which `draw` draws no pixel; callers may set it at any time.
    """

    def __init__(
        self,
        images: Iterable[NDArray[Any]],
        cameras: Sequence[Camera],
        domain: Domain,
        masks: Sequence[NDArray[Any] | None] | None = None,
        ndc: Ndc | None = None,
    ) -> None:
        """images: for each camera, uint8 [H, W, 3 or 4] of its size; read one at a time. masks: for each view bool [H, W], False for pixels
        that are excluded from training, or None. Raises SnergError when the masks exclude every pixel."""
        self.domain, self.ndc = domain, ndc
        self.widths = np.array([c.width for c in cameras])
        self.ends = np.cumsum([c.width * c.height for c in cameras])
        self.starts = self.ends - self.widths * np.array([c.height for c in cameras])
        self.focal = np.array([c.focal for c in cameras])
        self.centre = np.array([c.centre for c in cameras])
        self.pose = np.stack([c.camera_to_world for c in cameras])
        self.parallel = np.array([c.projection == "orthographic" for c in cameras])
        self.near, self.far = np.array([c.near for c in cameras]), np.array([c.far for c in cameras])
        self.withheld = np.zeros(len(cameras), bool)
        self._set_lenses(cameras)
        self.pixels = np.empty((int(self.ends[-1]), 4), np.uint8)
        self.alpha = self._fill(images)
        self.diffuse: NDArray[Any] | None = None
        self.useful = self._unmasked(cameras, masks or [None] * len(cameras))

    def _set_lenses(self, cameras: Sequence[Camera]) -> None:
        """Collect the distinct distortions, so that rays of all views with the same one are undistorted together."""
        self.wide = np.array([c.is_wide for c in cameras])
        self.wide_kinds = [(c.projection, c.distortion.coefficients if c.distortion else ()) if c.is_wide else None for c in cameras]
        bent = [None if c.is_wide else c.distortion for c in cameras]
        kinds = list(dict.fromkeys(bent))
        self.lens = np.array([kinds.index(distortion) for distortion in bent])
        straight = Distortion("opencv")
        self.lenses = Lenses([k or straight for k in kinds]) if kinds != [None] else None

    def _fill(self, images: Iterable[NDArray[Any]]) -> bool:
        """Copy the images into `pixels`. Returns whether every image has an alpha channel and some pixel is not opaque."""
        everywhere, varies = True, False
        for start, end, image in zip(self.starts, self.ends, images, strict=True):
            place = self.pixels[start:end]
            place[:, 3] = 255
            place[:, : image.shape[-1]] = image.reshape(-1, image.shape[-1])
            everywhere &= image.shape[-1] == 4
            varies = varies or bool((place[:, 3] < 255).any())
        return everywhere and varies

    def keep_near(self, silhouettes: Sequence[NDArray[Any]], masks: Sequence[NDArray[Any] | None]) -> None:
        """Let `draw` draw only pixels in or near a silhouette, and not excluded by a mask: other rays miss the scene.

        silhouettes: for each view bool [H, W]; masks: as for the constructor. Nothing changes when no pixel would be left.
        """
        near = [dilated(s, max(s.shape) // 40 + 2) for s in silhouettes]
        kept = self._numbers([n if m is None else n & m for n, m in zip(near, masks, strict=True)])
        self.useful = kept if len(kept) else self.useful

    def _numbers(self, keep: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """The numbers [K] of the pixels that are True in `keep`, bool [H, W] for each view."""
        kind = np.int32 if len(self.pixels) < 2**31 else np.int64
        return np.concatenate([(np.flatnonzero(k) + start).astype(kind) for start, k in zip(self.starts, keep, strict=True)])

    def _unmasked(self, cameras: Sequence[Camera], masks: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
        """The numbers [K] of the pixels that no mask excludes; None where no view has a mask. Raises SnergError when there are none."""
        if all(m is None for m in masks):
            return None
        kept = self._numbers([np.ones((c.height, c.width), bool) if m is None else m for c, m in zip(cameras, masks, strict=True)])
        if not len(kept):
            raise SnergError("The masks hide every pixel of every image; in a mask, white is what to use.")
        return kept

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[Any]:
        """Draw `count` pixel numbers uniformly, with replacement, int64 [count], from the views that are not withheld.

        Raises SnergError when all views are withheld, or nearly all pixels belong to withheld views.
        """
        if self.withheld.all():
            raise SnergError("Every view is held out; there is none to train on.")
        index = self._draw(count, rng)
        if not self.withheld.any():
            return index
        again = np.flatnonzero(self.withheld[self.view(index)])
        for _ in range(1000):
            if not len(again):
                return index
            index[again] = self._draw(len(again), rng)
            again = again[self.withheld[self.view(index[again])]]
        raise SnergError("Hardly a pixel is in a view that is not held out; hold out fewer views, or hide less with masks.")

    def _draw(self, count: int, rng: np.random.Generator) -> NDArray[Any]:
        if self.useful is None:
            return rng.integers(0, len(self.pixels), count)
        return np.asarray(self.useful[rng.integers(0, len(self.useful), count)].astype(np.int64))

    def view(self, index: NDArray[Any]) -> NDArray[Any]:
        """The views [N] of the pixels with numbers `index` [N]."""
        return np.searchsorted(self.ends, index, side="right")

    def rays(self, index: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """The rays of pixels with numbers `index` [N]: (origins [N, 3], unit directions [N, 3], near [N], far [N], view directions [N, 3]).

        All are float64 and in field coordinates, except the view directions, which are unit vectors in world axes. The same rays as those
        of Camera.rays and `space_rays`.
        """
        view = self.view(index)
        row, column = np.divmod(index - self.starts[view], self.widths[view])
        flat = (np.stack([column, row], axis=-1) + 0.5 - self.centre[view]) / self.focal[view]
        of_wide = self._wide_directions(view, flat)
        if self.lenses is not None:
            flat = self.lenses.undistort(self.lens[view], flat)
        pose = self.pose[view]
        across = pose[:, :3, 0] * flat[:, :1] - pose[:, :3, 1] * flat[:, 1:]
        back = pose[:, :3, 2]
        parallel = self.parallel[view, None]
        view_directions = np.where(parallel, -back, across - back)
        view_directions /= np.linalg.norm(view_directions, axis=-1, keepdims=True)
        if of_wide is not None:
            view_directions = np.where(self.wide[view, None], np.einsum("nij,nj->ni", pose[:, :3, :3], of_wide), view_directions)
        origins = np.where(parallel, pose[:, :3, 3] + across, pose[:, :3, 3])
        cosines = np.where(self.wide[view], 1, -np.einsum("ni,ni->n", view_directions, back))  # clip planes: Camera.clip_distances
        near, far = (planes[view] / np.maximum(cosines, LEAST_COSINE) for planes in (self.near, self.far))
        origins, directions, near, far = space_rays(self.ndc, origins, view_directions, near, far)
        scale = self.domain.scale
        return (origins - self.domain.centre) * scale, directions, near * scale, far * scale, view_directions

    def _wide_directions(self, view: NDArray[Any], flat: NDArray[Any]) -> NDArray[Any] | None:
        """Local unit directions [N, 3] of the flat coordinates [N, 2] of pixels of views [N], 0 where the view is not wide; None where none
        is."""
        if not self.wide.any():
            return None
        result = np.zeros((len(view), 3))
        for kind in dict.fromkeys(self.wide_kinds):
            if kind is not None:
                rows = np.flatnonzero(np.array([k == kind for k in self.wide_kinds])[view])
                result[rows] = wide.directions(kind[0], flat[rows], kind[1])
        return result
