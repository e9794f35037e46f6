"""Files of cameras without pictures: transforms files, nerfstudio's camera paths and cameras.json of Gaussian splatting."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SnergError
from ...geometry import wide
from ...geometry.box import Box
from ...geometry.camera import Camera, focal_from_angle, panorama_focal
from ...io.files import write_bytes
from ...io.guard import reading
from ...io.images import read_size
from ...io.json_files import json_bytes, read_edited_json
from ..image_resolver import find_image
from .dialects import check_keys
from .transforms import read_frames
from .transforms_camera import intrinsics_json, read_camera


def write_transforms(
    path: Path,
    cameras: Sequence[Camera],
    image_names: Sequence[str],
    box: Box | None = None,
    extra: dict[str, Any] | None = None,
    frame_extras: Sequence[dict[str, Any]] = (),
) -> None:
    """Write cameras as a transforms file that other NeRF tools read, whole or not at all.

    image_names: for each camera the path of its image, relative to the file. box: written as snerg_box. extra: further keys of the
    file's object. frame_extras: further keys of each frame, if any.
    """
    first = cameras[0]
    frames = [
        {"file_path": name, "transform_matrix": camera.camera_to_world.tolist(), **intrinsics_json(camera), **more}
        for camera, name, more in zip(cameras, image_names, frame_extras or [{}] * len(cameras), strict=True)
    ]
    value: dict[str, Any] = {"camera_angle_x": 2 * float(np.arctan2(first.width / 2, first.focal[0])), **(extra or {})}
    if box is not None:
        value["snerg_box"] = box.to_json()
    write_bytes(path, json_bytes({**value, "frames": frames}))


def read_cameras(path: str | os.PathLike[str], size: tuple[int | None, int | None] = (None, None)) -> tuple[Camera, ...]:
    """Read only the cameras of a transforms file or of nerfstudio's camera path, or Gaussian splatting's cameras.json,
    to render from them.

    Where the file gives w and h, the images need not exist. size: (width, height) in pixels of a camera that has neither a size nor an
    image, None where not known; ignored for others. Raises SnergError when the file has no frames, or a camera has no size at all.
    """
    with reading(Path(path), "write it again"):
        value = read_edited_json(Path(path))
        if isinstance(value, dict) and "camera_path" in value:
            return read_camera_path(value, str(path))
        if isinstance(value, list):
            return read_splat_cameras(value, str(path))
        return _read_cameras(Path(path), size)


def _read_cameras(path: Path, wanted: tuple[int | None, int | None]) -> tuple[Camera, ...]:
    value, frames = read_frames(path)
    check_keys(path, value, [])
    cameras = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        name = str(frame.get("file_path", f"{index:03d}"))
        merged = {**value, **frame}
        if "w" in merged and "h" in merged:
            size = _whole(merged["w"], where), _whole(merged["h"], where)
        elif (image := find_image(path.parent, name, where)) is not None:
            size = read_size(image)
        elif wanted[0] is not None and wanted[1] is not None:
            size = wanted[0], wanted[1]
        else:
            raise SnergError(f"{where} gives no w and h, and its image {name} does not exist; give --width and --height.")
        cameras.append(read_camera(value, frame, size, where, name=Path(name).stem))
    return tuple(cameras)


def _whole(value: Any, where: str) -> int:
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SnergError(f"{where} has a size that is not a number ({error}).") from error


def read_camera_path(value: dict[str, Any], where: str) -> tuple[Camera, ...]:
    """The cameras of nerfstudio's camera path, in its own world: camera_to_world row by row, and the vertical field of view in degrees.

    Raises SnergError for a camera_type other than 'perspective', 'fisheye' and 'equirectangular', and for missing or invalid values.
    """
    kind = str(value.get("camera_type", "perspective")).lower()
    if kind not in ("perspective", *wide.PROJECTIONS):
        raise SnergError(f"{where} is a camera path of camera_type {kind}, which is not supported; export it as perspective.")
    steps = value["camera_path"]
    if not isinstance(steps, list) or not steps:
        raise SnergError(f"{where} has a camera_path without cameras; export it again.")
    width, height = _whole(value.get("render_width"), where), _whole(value.get("render_height"), where)
    cameras = []
    for index, step in enumerate(steps):
        here = f"{where}, camera {index}"
        try:
            pose = np.array(step["camera_to_world"], np.float64).reshape(4, 4)
            one = focal_from_angle(math.radians(float(step["fov"])), height, here)
            focal = panorama_focal(width, height) if kind == "equirectangular" else (one, one)
        except (KeyError, TypeError, ValueError) as error:
            raise SnergError(f"{here} lacks camera_to_world (16 numbers) or fov (degrees); export the path again.") from error
        cameras.append(Camera(width, height, focal, (width / 2, height / 2), pose, kind, f"{index:05d}"))
    return tuple(cameras)


def read_splat_cameras(value: list[Any], where: str) -> tuple[Camera, ...]:
    """The cameras of Gaussian splatting's cameras.json (see `read_splat_camera`). Raises SnergError also when there is none."""
    if not value:
        raise SnergError(f"{where} has no cameras; export it again.")
    return tuple(read_splat_camera(item, f"{where}, camera {index}", f"{index:05d}") for index, item in enumerate(value))


def read_splat_camera(item: Any, where: str, name: str = "") -> Camera:
    """One camera of Gaussian splatting's cameras.json, in the world of its capture: OpenCV's axes, rotation to the world by rows.

    name: of a camera without img_name. Raises SnergError, which begins with `where`, when a value is missing or no number.
    """
    try:
        pose = np.eye(4)
        pose[:3, :3] = np.array(item["rotation"], np.float64).reshape(3, 3) * [1, -1, -1]
        pose[:3, 3] = np.array(item["position"], np.float64)
        width, height, focal = int(item["width"]), int(item["height"]), (float(item["fx"]), float(item["fy"]))
        name = Path(str(item.get("img_name", name))).stem
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise SnergError(f"{where} lacks position, rotation, width, height, fx or fy as numbers; export it again.") from error
    return Camera(width, height, focal, (width / 2, height / 2), pose, name=name)
