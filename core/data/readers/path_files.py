"""Files of camera paths: SNeRG's own, and any file of cameras, whose cameras are then the frames."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...errors import SnergError
from ...geometry.camera import Camera
from ...geometry.camera_path import FORMAT, MAX_KEYS, CameraPath, Shot
from ...io.guard import reading
from ...io.json_files import read_edited_json
from .camera_files import read_cameras

FPS = 24.0  # frames a second of a file that does not say


def read_path(path: str | os.PathLike[str], size: tuple[int | None, int | None] = (None, None)) -> CameraPath:
    """Read a camera path: a file of FORMAT, or one that `read_cameras` reads, where each camera is the next frame, from frame 1 on.

    nerfstudio's camera path says how many frames a second. size: as in `read_cameras`.
    Raises SnergError when the file holds no path, or its cameras cannot be one: of different kinds or sizes, or panoramic.
    """
    with reading(Path(path), "write it again"):
        value = read_edited_json(Path(path))
        if isinstance(value, dict) and value.get("format") == FORMAT:
            return CameraPath.from_json(value)
        return path_of_cameras(read_cameras(path, size), frames_a_second(value))


def frames_a_second(value: Any) -> float:
    """The rate that a nerfstudio camera path gives; FPS where a file gives none that can be used."""
    given = value.get("fps") if isinstance(value, dict) else None
    if isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given) and 0 < given <= 1000:
        return float(given)
    return FPS


def path_of_cameras(cameras: Sequence[Camera], fps: float = FPS) -> CameraPath:
    """The path with a camera for each frame, from frame 1 on. Raises SnergError where the cameras cannot be one path."""
    if not 0 < len(cameras) <= MAX_KEYS:
        raise SnergError(f"A camera path of {len(cameras)} cameras was given; it must have from 1 to {MAX_KEYS}.")
    plain = [Camera(c.width, c.height, c.focal, c.centre, c.camera_to_world, c.projection, c.name, c.near, None, c.far) for c in cameras]
    return CameraPath((Shot(tuple(map(float, range(1, len(plain) + 1))), tuple(plain)),), 1, len(plain), fps)
