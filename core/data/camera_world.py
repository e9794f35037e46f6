"""Moves cameras from the world of a capture's own files to the world in which it is trained, for camera paths of other tools."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera
from ..geometry.camera_path import CameraPath
from ..io.json_files import read_edited_json
from ..io.schema import positive
from .load import read_dataset

NERFSTUDIO = "dataparser_transforms.json"  # in each of nerfstudio's output folders: from the capture's world to its own


class CaptureWorld:
    """The world of a capture's own files, seen from the one in which it is trained. The capture is read once, when it is first needed."""

    def __init__(self, dataset: Path | None) -> None:
        """dataset: the capture; None: what is moved stays where it is."""
        self._dataset = dataset

    def moved_cameras(self, cameras: Sequence[Camera], file: str | os.PathLike[str]) -> tuple[Camera, ...]:
        """The cameras of `file`, which are in the capture's world, in the world in which it is trained.

        Those of a nerfstudio camera path are in nerfstudio's world, and NERFSTUDIO beside the path or in the capture says where that is.
        Raises SnergError when it is missing or damaged, and as `read_dataset` does.
        """
        if self._dataset is None:
            return tuple(cameras)
        similarity = self.to_training(file)
        return tuple(camera.moved(similarity) for camera in cameras)

    def moved_path(self, path: CameraPath, file: str | os.PathLike[str]) -> CameraPath:
        """The path of `file`, as `moved_cameras`."""
        return path if self._dataset is None else path.moved(self.to_training(file))

    def to_training(self, file: str | os.PathLike[str]) -> NDArray[Any]:
        """The similarity [4, 4] of what `file` holds. Raises as `moved_cameras` does."""
        if self._dataset is None:
            return np.eye(4)
        root, to_world = self._capture
        value = read_edited_json(Path(file))
        if isinstance(value, dict) and "camera_path" in value:
            return np.asarray(to_world @ from_nerfstudio(Path(file), root))
        return to_world

    @cached_property
    def _capture(self) -> tuple[Path, NDArray[Any]]:
        """The capture's folder, and the similarity [4, 4] from its world."""
        assert self._dataset is not None
        found = read_dataset(self._dataset)
        return found.root if found.root.is_dir() else found.root.parent, np.asarray(found.source_to_world)


def from_nerfstudio(path: Path, root: Path) -> NDArray[Any]:
    """The similarity [4, 4] from the world of a nerfstudio camera path to that of the capture in `root`.

    nerfstudio's world is scale * transform * p. p is in the world before the capture's applied_transform and applied_scale, which its
    transforms.json has and which its poses are in.
    """
    file = next((folder / NERFSTUDIO for folder in (path.parent, root) if (folder / NERFSTUDIO).is_file()), None)
    if file is None:
        raise SnergError(f"{path} is in nerfstudio's world; copy {NERFSTUDIO} from nerfstudio's output folder beside it, or into {root}.")
    value = read_edited_json(file)
    listing = root / "transforms.json"
    applied = read_edited_json(listing) if listing.is_file() else {}
    try:
        transform, scale = _affine(value["transform"]), positive(value["scale"], "its scale")
        before, by = _affine(applied.get("applied_transform", np.eye(4))), positive(applied.get("applied_scale", 1.0), "applied_scale")
        back: NDArray[Any] = before @ np.linalg.inv(transform)
    except (KeyError, TypeError, ValueError, AttributeError, np.linalg.LinAlgError) as error:
        raise SnergError(f"{file} or {listing} has no transform of 3 x 4 numbers, or no scale ({error}); copy it again.") from error
    back[:3, :3] = back[:3, :3] * (by / scale)
    return np.asarray(back)


def _affine(value: Any) -> NDArray[Any]:
    """A transform of 3 x 4 or 4 x 4 numbers as [4, 4] float64. Raises ValueError or TypeError when it is none."""
    matrix = np.array(value, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"a transform is {matrix.shape}")
    return np.vstack([matrix[:3], [0, 0, 0, 1]])
