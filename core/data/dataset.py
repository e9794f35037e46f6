"""A dataset: views with cameras, on disk until they are needed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..io.images import read_image, read_mask, read_size, reduced

HELD_OUT = ("val", "test")  # both name the views held out of a source that has no splits of its own


@dataclass(frozen=True, eq=False)
class View:
    """One photograph or render, and the camera that took it.

    mask: a picture whose black pixels are not to be learned from; with `mask_hides`, whose white ones are not (instant-ngp's
    dynamic masks). factor: image pixels along a side to one pixel of the camera. image_size: (width, height) of the image in pixels,
    None where its header has not been read.
    """

    camera: Camera
    image: Path
    mask: Path | None = None
    mask_hides: bool = False
    factor: int = 1
    image_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class DatasetOptions:
    """How to read a dataset.

    holdout: every n-th view (0, n, 2n ...) is kept for measuring, as split 'val' or 'test', where the source has no splits of its
    own; 0 keeps none. downscale: pictures are read this many times smaller along each side.
    """

    holdout: int = 8
    downscale: int = 1

    def __post_init__(self) -> None:
        if not isinstance(self.holdout, int) or self.holdout < 0 or self.holdout == 1:
            raise SnergError(f"Holding out every {self.holdout}-th view leaves none to train on; give 2 or more, or 0 for none.")
        if not isinstance(self.downscale, int) or self.downscale < 1:
            raise SnergError(f"The pictures cannot be made {self.downscale} times smaller; give a whole number from 1.")


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views of one split of a capture.

    box: what training must explain, as far as the source tells, None where it tells nothing. points [N, 3] float64 and colours
    [N, 3] uint8: what structure from motion found. bounds: [V, 2] nearest and farthest depth a view. All in world units, after
    `source_to_world` [4, 4], the similarity that sets photographs upright near the origin (the identity for renders).
    kind: 'transforms', 'llff' or 'colmap'. skipped_frames: how many frames of the source have no image.
    source: what the reader found, with all splits that it read; None for a dataset that was not read from files.
    """

    root: Path
    split: str
    views: tuple[View, ...]
    box: Box | None = None
    points: NDArray[Any] | None = None
    colours: NDArray[Any] | None = None
    bounds: NDArray[Any] | None = None
    source_to_world: NDArray[Any] = field(default_factory=lambda: np.eye(4))
    options: DatasetOptions = DatasetOptions()
    kind: str = "transforms"
    split_names: tuple[str, ...] = ()
    skipped_frames: int = 0
    source: Source | None = None

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The views' cameras, in order."""
        return tuple(view.camera for view in self.views)

    def read(self, index: int) -> NDArray[Any]:
        """View `index` as uint8 [H, W, 3 or 4], sRGB, straight alpha. Raises SnergError when it cannot be read any more."""
        view = self.views[index]
        pixels = reduced(read_image(view.image), view.factor)
        if pixels.shape[:2] != (view.camera.height, view.camera.width):
            raise SnergError(f"The image {view.image} changed its size since the dataset was opened; open it again.")
        return pixels

    def mask(self, index: int) -> NDArray[Any] | None:
        """Which pixels of view `index` to learn from, bool [H, W], or None for all: what its mask leaves, as far as the lens's
        model holds. Raises SnergError when the mask cannot be read."""
        view = self.views[index]
        seen = view.camera.sees()
        if view.mask is None:
            return seen
        width, height, factor = view.camera.width, view.camera.height, view.factor
        use = read_mask(view.mask, *(view.image_size or read_size(view.image)), view.mask_hides)[: height * factor, : width * factor]
        use = use.reshape(height, factor, width, factor).all(axis=(1, 3))
        return np.asarray(use if seen is None else use & seen)

    def splits(self) -> tuple[str, ...]:
        """The names of the splits there are, 'train' first."""
        return self.split_names or (self.split,)

    def suggested_box(self) -> Box:
        """The box to train in: `box`, or a cube around the point that the cameras look at (see `focus_box`)."""
        return self.box or focus_box(self.cameras)


@dataclass(frozen=True, eq=False)
class Source:
    """What a reader found: all views, in the source's own world and at their images' sizes.

    splits: the numbers of the views of each split, None where the source has no splits. names: of splits that are in other files.
    photographs: whether the world has no up and no scale of its own. half_extent: half the side of
    the cube round the source's origin that the scene fills, None where the source gives none. factor: how many times smaller the images
    are still to be made along each side. skipped_frames: how many frames have no image.
    """

    root: Path
    kind: str
    views: tuple[View, ...]
    splits: dict[str, list[int]] | None = None
    names: tuple[str, ...] = ()
    box: Box | None = None
    photographs: bool = False
    points: NDArray[Any] | None = None
    colours: NDArray[Any] | None = None
    bounds: NDArray[Any] | None = None
    half_extent: float | None = None
    factor: int = 1
    skipped_frames: int = 0


def focus(cameras: tuple[Camera, ...]) -> tuple[NDArray[Any], bool]:
    """The point [3] nearest to all optical axes in the least-squares sense, and whether there is one: cameras that all look the
    same way have none, and it lies in front of them, as far away as twice their spread."""
    positions = np.stack([c.position for c in cameras])
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] > 1e-3:
        return np.linalg.solve(system, np.einsum("nij,nj->i", across, positions) / len(cameras)), True
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=-1).max()) or 1.0
    return positions.mean(axis=0) + axes.mean(axis=0) * 2 * spread, False


def focus_box(cameras: tuple[Camera, ...]) -> Box:
    """A cube around what the cameras look at (see `focus`), as wide there as the median view of it."""
    centre, _ = focus(cameras)
    halves = []
    for camera in cameras:
        widest = max(camera.width / camera.focal[0], camera.height / camera.focal[1]) / 2
        distance = 1.0 if camera.projection == "orthographic" else float(np.linalg.norm(camera.position - centre))
        halves.append(widest * distance)
    half = float(np.median(halves))
    if not (math.isfinite(half) and half > 0):
        raise SnergError("The cameras stand in the point that they look at; check their poses.")
    return Box.axis_aligned(centre - half, centre + half)
