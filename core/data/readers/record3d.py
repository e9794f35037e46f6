"""Reads recordings of Record3D: metadata.json with pictures in rgb and depth in depth (its export 'EXR + RGB'), or an unpacked .r3d.

poses: for each frame a quaternion (x, y, z, w) and a position, camera-to-world with OpenGL's axes, in metres. K: the intrinsics in
pixels column by column; perFrameIntrinsicCoeffs: fx, fy, cx, cy of each frame.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SnergError
from ...io.json_files import read_edited_json
from ..dataset import DatasetOptions, Source
from ..depth import DepthFile
from ..image_resolver import images_in
from .colmap_model import world_to_camera
from .photographs import Listed, Photograph, read_photographs

FILES = ("metadata.json", "metadata")  # of the export, of an unpacked .r3d
PICTURES = ("rgb", "rgbd")
MOST_FRAMES = 300  # of a recording: neighbouring frames of a video are alike, and nerfstudio takes as many by default


def _place(path: Path) -> tuple[Path, Path] | None:
    """(the file of the poses, the folder of the pictures) of the recording in a folder."""
    for folder in (path, path / "EXR_RGBD"):
        file = next((folder / name for name in FILES if (folder / name).is_file()), None)
        pictures = next((folder / name for name in PICTURES if (folder / name).is_dir()), None)
        if file is not None and pictures is not None:
            return file, pictures
    return None


def is_record3d(path: Path) -> bool:
    """Whether a path is a folder with a recording of Record3D: metadata.json with rgb, or metadata with rgbd, also in EXR_RGBD."""
    return path.is_dir() and _place(path) is not None


def read_record3d(path: Path, options: DatasetOptions) -> Source:
    """Read a recording of Record3D, at most MOST_FRAMES of its frames, evenly spaced. Pictures belong to the poses by their numbers.

    Raises SnergError as `read_photographs` does, and when the file of the poses has none.
    """
    place = _place(path)
    if place is None:
        raise SnergError(f"{path} has no metadata.json beside a folder rgb; export it from Record3D as 'EXR + RGB' again.")
    file, folder = place
    value = read_edited_json(file)
    poses = value.get("poses") if isinstance(value, dict) else None
    if not isinstance(poses, list) or not poses:
        raise SnergError(f"{file} has no poses; export the recording from Record3D again.")
    numbered = sorted((int(match[0]), p) for p in images_in(folder, str(path)) if (match := re.search(r"\d+", p.stem)))
    if not numbered:
        raise SnergError(f"{file} lists {len(poses)} images, but {folder} has none with a number for a name; put them there.")
    shots = [(index, image) for index, (_, image) in enumerate(numbered)]
    notes: tuple[str, ...] = ()
    if len(shots) != len(poses):
        shots = [(number, image) for number, image in numbered if number < len(poses)]
        notes = (f"{file} has {len(poses)} poses, but {folder} has {len(numbered)} images; they are matched by their numbers.",)
    if len(shots) > MOST_FRAMES:
        notes += (f"{MOST_FRAMES} of the {len(shots)} frames of the recording are read, evenly spaced.",)
        shots = [shots[i] for i in np.linspace(0, len(shots) - 1, MOST_FRAMES).round().astype(int)]
    listed: list[Listed] = [(f"{file}, pose {index}", partial(_photograph, value, index, image)) for index, image in shots]
    return read_photographs(file, folder, listed, options, root=path, kind="record3d", notes=notes)


def _photograph(value: dict[str, Any], index: int, image: Path) -> Photograph:
    """What the file says of one frame. Raises SnergError when a value is missing or no number."""
    try:
        x, y, z, w, *position = (float(v) for v in value["poses"][index])
        fx, fy, cx, cy = _intrinsics(value, index)
        size = float(value["w"]), float(value["h"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise SnergError(f"Frame {index} ({image.name}) lacks a pose of 7 numbers, intrinsics, w or h ({error}).") from error
    pose = np.eye(4)
    pose[:3, :3] = world_to_camera([w, x, y, z, 0, 0, 0], f"Frame {index} ({image.name})")[:, :3]
    pose[:3, 3] = position
    depth = image.parent.parent / "depth" / f"{image.stem}.exr"
    return Photograph(image.name, pose, (fx, fy), (cx, cy), size, depth=DepthFile(depth, 1.0) if depth.is_file() else None)


def _intrinsics(value: dict[str, Any], index: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a frame, in pixels."""
    each = value.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and index < len(each):
        fx, fy, cx, cy = (float(v) for v in each[index][:4])
        return fx, fy, cx, cy
    matrix = np.array(value["K"], np.float64).reshape(3, 3).T
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
