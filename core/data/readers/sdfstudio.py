"""Reads meta_data.json of SDFStudio, which nerfstudio reads as well: frames with OpenCV's axes and a matrix of intrinsics each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SnergError
from ...io.guard import reading
from ...io.json_files import read_edited_json
from ..dataset import DatasetOptions, Source
from .transforms import is_transforms, source_of

FILE = "meta_data.json"
SHARED = {"width": "w", "height": "h", "camera_model": "camera_model", "scene_box": "scene_box"}  # its keys of the whole file, ours
FILES = {"rgb_path": "file_path", "sensor_depth_path": "depth_file_path", "foreground_mask": "mask_path"}  # its keys of a frame, ours
ESTIMATED = ("mono_depth_path", "mono_normal_path")


def is_sdfstudio(path: Path) -> bool:
    """Whether the path is a file meta_data.json, or a folder that holds one and no transforms file."""
    return path.name == FILE if path.is_file() else (path / FILE).is_file() and not is_transforms(path)


def read_sdfstudio(path: Path, split: str, options: DatasetOptions) -> Source:
    """Read meta_data.json and find its images. scene_box.aabb is the cube that the scene fills.

    Raises SnergError when the file is damaged, or a pose, a lens or an image is missing or invalid.
    """
    file = path if path.is_file() else path / FILE
    with reading(file, "write it again"):
        value = read_edited_json(file)
        if not isinstance(value, dict) or not isinstance(value.get("frames"), list) or not value["frames"]:
            raise SnergError(f"{file} has no frames; a dataset needs at least one image with its camera.")
        frames = [_frame(frame, f"{file}, frame {index}") for index, frame in enumerate(value["frames"])]
        shared = {ours: value[theirs] for theirs, ours in SHARED.items() if theirs in value}
        source = source_of(file, shared, frames, (), split, options)
        said = any(key in frame for frame in value["frames"] for key in ESTIMATED)
        notes = (f"{file.name}: depth and normals as a network estimates them have no effect.",) if said else ()
        return replace(source, notes=notes + source.notes)


def _frame(frame: Any, where: str) -> dict[str, Any]:
    """A frame with the keys of a transforms file."""
    try:
        pose, lens = np.array(frame["camtoworld"], np.float64)[:4, :4], np.array(frame["intrinsics"], np.float64)
        pose[:3, 1:3] *= -1  # from OpenCV's axes to OpenGL's
        intrinsics = {"fl_x": lens[0, 0], "fl_y": lens[1, 1], "cx": lens[0, 2], "cy": lens[1, 2]}
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise SnergError(f"{where} has no camtoworld and intrinsics of 4 x 4 numbers; every frame needs them.") from error
    files = {ours: frame[theirs] for theirs, ours in FILES.items() if frame.get(theirs) is not None}
    return {"transform_matrix": pose.tolist(), **intrinsics, **files}
