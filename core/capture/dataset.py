"""A dataset: views with cameras, on disk until they are needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import SnergError
from ..grid.box import Box
from .camera import Camera
from .images import read_image, read_size


@dataclass(frozen=True, eq=False)
class View:
    """One photograph or render, and the camera that took it."""

    camera: Camera
    image: Path


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views of one scene. `box` is what the source says of the scene's extent, None where it says nothing."""

    root: Path
    split: str
    views: tuple[View, ...]
    box: Box | None = None

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The views' cameras, in order."""
        return tuple(view.camera for view in self.views)

    def read(self, index: int) -> np.ndarray:
        """View `index` as uint8 [H, W, 3 or 4], sRGB, straight alpha."""
        view = self.views[index]
        pixels = read_image(view.image)
        if pixels.shape[:2] != (view.camera.height, view.camera.width):
            raise SnergError(f"The image {view.image} changed its size since the dataset was opened; open it again.")
        return pixels

    def suggested_box(self) -> Box:
        """The source's own box, or a cube around the point that the cameras look at (see `focus_box`)."""
        return self.box or focus_box(self.cameras)


def read_dataset(path: Path, split: str = "train") -> Dataset:
    """Open a dataset folder, or one of its transforms files.

    Raises SnergError when there is no such dataset or split, or an image is missing or unreadable.
    """
    from .readers.transforms import read_transforms

    dataset = read_transforms(Path(path), split)
    for view in dataset.views:
        size = read_size(view.image)
        if size != (view.camera.width, view.camera.height):
            raise SnergError(
                f"The image {view.image} is {size[0]} x {size[1]}, its camera {view.camera.width} x {view.camera.height}; they must agree."
            )
    return dataset


def focus_box(cameras: tuple[Camera, ...]) -> Box:
    """A cube around what the cameras look at, as wide there as the widest view of it.

    The centre is the point nearest to all optical axes in the least-squares sense. Cameras that all look the
    same way have no such point: then it lies in front of them, as far away as they are spread.
    """
    positions = np.stack([c.position for c in cameras])
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=-1).max()) or 1.0
    if np.linalg.eigvalsh(system)[0] > 1e-3:
        centre = np.linalg.solve(system, np.einsum("nij,nj->i", across, positions) / len(cameras))
    else:
        centre = positions.mean(axis=0) + axes.mean(axis=0) * 2 * spread
    halves = []
    for camera, position in zip(cameras, positions, strict=True):
        widest = max(camera.width / camera.focal[0], camera.height / camera.focal[1]) / 2
        distance = 1.0 if camera.projection == "orthographic" else float(np.linalg.norm(position - centre))
        halves.append(widest * distance)
    half = float(np.median(halves))
    return Box.axis_aligned(centre - half, centre + half)
