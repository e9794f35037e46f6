"""Moves cameras from the world of a capture's own files to the world in which it is trained, for camera paths of other tools."""

from __future__ import annotations

import os
from collections.abc import Sequence
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


def in_training_world(cameras: Sequence[Camera], file: str | os.PathLike[str], dataset: Path) -> tuple[Camera, ...]:
    """The cameras of `file`, which are in the world of the capture at `dataset`, in the world in which that capture is trained.

    Those of a nerfstudio camera path are in nerfstudio's world, and NERFSTUDIO beside the path or in the capture says where that is.
    Raises SnergError when it is missing or damaged, and as `read_dataset` does.
    """
    similarity = to_training_world(file, dataset)
    return tuple(camera.moved(similarity) for camera in cameras)


def placed_path(path: CameraPath, file: str | os.PathLike[str], dataset: Path | None) -> CameraPath:
    """The path of `file` in the world in which the capture at `dataset` is trained; as it is where that is None."""
    return path if dataset is None else path.moved(to_training_world(file, dataset))


def to_training_world(file: str | os.PathLike[str], dataset: Path) -> NDArray[Any]:
    """The similarity [4, 4] of `in_training_world`. Raises as it does."""
    found = read_dataset(dataset)
    root = found.root if found.root.is_dir() else found.root.parent
    value = read_edited_json(Path(file))
    to_capture = np.eye(4)
    if isinstance(value, dict) and "camera_path" in value:
        to_capture = from_nerfstudio(Path(file), root)
    return np.asarray(found.source_to_world @ to_capture)


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
