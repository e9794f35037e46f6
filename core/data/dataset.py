"""A dataset: views with their cameras. The images stay on disk until they are needed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..io.images import read_image, read_mask, read_size, reduced
from .depth import DepthFile, read_depth, read_pass
from .opacity import Opacity

HELD_OUT = ("val", "test")  # both name the views held out of a source that has no splits of its own


@dataclass(frozen=True, eq=False)
class View:
    """One image, photographed or rendered, and the camera that took it."""

    camera: Camera
    image: Path
    mask: Path | None = None  # an image whose black pixels are excluded from training, or its white ones with mask_hides
    mask_hides: bool = False  # for dynamic masks of instant-ngp
    factor: int = 1  # image pixels along a side that are averaged to one pixel of the camera
    upright: bool = False  # whether the image is turned by its EXIF orientation
    image_size: tuple[int, int] | None = None  # (width, height) of the image in pixels; None if its header has not been read
    depth: DepthFile | None = None  # the depth image that the source names
    passes: Mapping[str, Path] = field(default_factory=dict)  # other passes of a renderer by name: 'normal', 'diffuse', 'glossy'
    crop_radius: float | None = None  # image pixels around its middle outside of which the image shows nothing
    opacity: Opacity | None = None  # what makes pixels transparent beside the image's own alpha


@dataclass(frozen=True)
class DatasetOptions:
    """How to read a dataset. Raises SnergError when a value is out of range."""

    holdout: int = 8  # every n-th view (0, n, 2n ...) is held out as 'val' or 'test' where the source has no splits; 0: none
    downscale: int = 1  # images are reduced by this factor along each side

    def __post_init__(self) -> None:
        if not isinstance(self.holdout, int) or self.holdout < 0 or self.holdout == 1:
            raise SnergError(f"Holding out every {self.holdout}-th view leaves none to train on; give 2 or more, or 0 for none.")
        if not isinstance(self.downscale, int) or self.downscale < 1:
            raise SnergError(f"The pictures cannot be made {self.downscale} times smaller; give a whole number from 1.")


@dataclass(frozen=True, eq=False)
class Dataset:
    """The views of one split of a capture, in world units: z up, near the origin. Images are read from disk when they are asked for."""

    root: Path
    split: str
    views: tuple[View, ...]
    box: Box | None = None  # the region that training must explain; None for `focus_box`
    box_origin: str = ""  # a sentence that says where the box comes from
    opaque_box: Box | None = None  # in its place where pictures have neither alpha nor a plain backdrop; None: the same
    points: NDArray[Any] | None = None  # [N, 3] float64, the points of structure from motion
    colours: NDArray[Any] | None = None  # [N, 3] uint8, their colours
    bounds: NDArray[Any] | None = None  # [V, 2] float64, the nearest and the farthest depth in each view
    source_to_world: NDArray[Any] = field(default_factory=lambda: np.eye(4))  # [4, 4] similarity; the identity for renders
    options: DatasetOptions = DatasetOptions()
    kind: str = "transforms"  # or 'llff' or 'colmap'
    split_names: tuple[str, ...] = ()  # of all splits of the capture
    skipped_frames: int = 0  # frames of the source that have no image
    notes: tuple[str, ...] = ()  # sentences that say what the reader passed over or repaired
    source: Source | None = None  # what the reader found, for other splits; None if the dataset was not read from files

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The views' cameras, in order."""
        return tuple(view.camera for view in self.views)

    def remarks(self) -> list[str]:
        """The sentences that say what the reader passed over or repaired: `notes`, and the frames without an image."""
        skipped = [f"{self.skipped_frames} frames of {self.root} have no image; they are left out."] if self.skipped_frames else []
        return [*self.notes, *skipped]

    def read(self, index: int) -> NDArray[Any]:
        """The image of view `index`, uint8 [H, W, 3 or 4], sRGB with straight alpha.

        Raises SnergError when it cannot be read, or is not as large as when the dataset was read.
        """
        view = self.views[index]
        pixels = read_image(view.image, upright=True) if view.upright else read_image(view.image)
        pixels = reduced(pixels if view.opacity is None else view.opacity.applied(pixels, view.upright), view.factor)
        if pixels.shape[:2] != (view.camera.height, view.camera.width):
            raise SnergError(f"The image {view.image} changed its size since the dataset was opened; open it again.")
        return pixels

    def mask(self, index: int) -> NDArray[Any] | None:
        """The pixels of view `index` to train on, bool [H, W]; None for all of them.

        Pixels that the mask hides are excluded, those outside of the crop radius, and those for which the distortion model is not valid
        (see Camera.valid_pixels). Raises SnergError when the mask cannot be read.
        """
        view = self.views[index]
        valid = view.camera.valid_pixels()
        if view.crop_radius is not None:
            inside = _circle(view.camera, view.crop_radius / view.factor)
            valid = inside if valid is None else valid & inside
        if view.mask is None:
            return valid
        width, height, factor = view.camera.width, view.camera.height, view.factor
        use = read_mask(view.mask, *(view.image_size or read_size(view.image)), view.mask_hides)[: height * factor, : width * factor]
        use = use.reshape(height, factor, width, factor).all(axis=(1, 3))
        return np.asarray(use if valid is None else use & valid)

    def depth(self, index: int) -> NDArray[Any] | None:
        """The depth of view `index` along the camera's axis (not the ray) in world units, float32 [H, W], NaN where there is no surface.

        None where the dataset has none for the view. Read from disk at each call. Raises SnergError as `read_depth` does.
        """
        view = self.views[index]
        return None if view.depth is None else read_depth(view.depth, view.camera, view.factor, self.scale)

    def render_pass(self, index: int, name: str) -> NDArray[Any] | None:
        """A pass of view `index` besides depth, float32 [H, W, 3 or 4]; None where the dataset has none for the view.

        name: 'normal' (unit vectors in the world's axes, 0 where there is no surface), 'diffuse' or 'glossy' (linear light, premultiplied
        RGBA). Read from disk at each call. Raises SnergError as `read_pass` does.
        """
        view = self.views[index]
        if name not in view.passes:
            return None
        values = read_pass(view.passes[name], view.camera, view.factor)
        if name != "normal":
            return values
        turned = values[..., :3] @ (self.source_to_world[:3, :3] / self.scale).T.astype(np.float32)
        length = np.linalg.norm(turned, axis=-1, keepdims=True)
        return np.asarray(turned / np.where(length > 0, length, 1), np.float32)

    @property
    def scale(self) -> float:
        """World units a unit of the source's poses."""
        return float(np.cbrt(np.linalg.det(self.source_to_world[:3, :3])))

    def splits(self) -> tuple[str, ...]:
        """The names of all splits of the capture, 'train' first."""
        return self.split_names or (self.split,)

    def suggested_box(self) -> Box:
        """The box to train in: `box` where there is one, else a cube around the point that the cameras look at (see `focus_box`)."""
        return self.box or focus_box(self.cameras)


@dataclass(frozen=True, eq=False)
class StatedBox:
    """The cube in which another tool trains, by its file. It may be the scene's size or an upper bound."""

    box: Box  # axis-aligned
    key: str  # of the file, for messages


@dataclass(frozen=True, eq=False)
class Source:
    """What a reader found: all views, in the source's own world, their cameras at the size of the images."""

    root: Path
    kind: str  # 'transforms', 'llff' or 'colmap'
    views: tuple[View, ...]
    splits: dict[str, list[int]] | None = None  # indices into `views` by split; None if the source has no splits
    names: tuple[str, ...] = ()  # of all splits, where each has a file of its own
    box: Box | None = None
    photographs: bool = False  # whether the world's up direction and scale are arbitrary
    points: NDArray[Any] | None = None  # [N, 3] float64
    colours: NDArray[Any] | None = None  # [N, 3] uint8
    bounds: NDArray[Any] | None = None  # [V, 2] float64, the nearest and the farthest depth in each view
    stated: StatedBox | None = None  # the cube that another tool's file states; None if not given
    box_origin: str = ""  # a sentence that says where `box` comes from; empty before it has been found
    opaque_box: Box | None = None  # see Dataset
    factor: int = 1  # by which the images are still to be reduced along each side
    skipped_frames: int = 0  # frames that have no image
    notes: tuple[str, ...] = ()  # sentences that say what was passed over or repaired
    up: NDArray[Any] | None = None  # [3] unit vector, the up direction of photographs that the source states; None: found from the cameras


def _circle(camera: Camera, radius: float) -> NDArray[Any]:
    """The pixels of a camera's image within `radius` pixels of its middle, bool [H, W]."""
    across, down = np.arange(camera.width) + 0.5 - camera.width / 2, np.arange(camera.height) + 0.5 - camera.height / 2
    return np.asarray(np.hypot(across[None], down[:, None]) <= radius)


def focus(cameras: tuple[Camera, ...]) -> tuple[NDArray[Any], bool]:
    """The point [3] that the cameras look at, float64, and whether their optical axes determine it.

    It is the point with the least sum of squared distances to the optical axes. Where the axes are parallel, it lies on their mean
    direction, at twice the largest distance of a camera from the mean position.
    """
    positions = np.stack([c.position for c in cameras])
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] > 1e-3:
        return np.linalg.solve(system, np.einsum("nij,nj->i", across, positions) / len(cameras)), True
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=-1).max()) or 1.0
    return positions.mean(axis=0) + axes.mean(axis=0) * 2 * spread, False


def focus_box(cameras: tuple[Camera, ...]) -> Box:
    """An axis-aligned cube around the point that the cameras look at (see `focus`), as wide as the median view is there.

    Raises SnergError when the cameras stand in that point.
    """
    centre, _ = focus(cameras)
    half_widths = []
    for camera in cameras:
        tangent = 1.0 if camera.is_wide else max(camera.width / camera.focal[0], camera.height / camera.focal[1]) / 2
        distance = 1.0 if camera.projection == "orthographic" else float(np.linalg.norm(camera.position - centre))
        half_widths.append(tangent * distance)
    half = float(np.median(half_widths))
    if not (math.isfinite(half) and half > 0):
        raise SnergError("The cameras stand in the point that they look at; check their poses.")
    return Box.axis_aligned(centre - half, centre + half)
