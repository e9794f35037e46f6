"""Reads the raw data of Polycam: keyframes/cameras/<name>.json beside keyframes/images/<name>.jpg, with depth of the LiDAR.

A camera's file has its intrinsics in pixels and t_00 .. t_23, the rows of its camera-to-world matrix with OpenGL's axes (ARKit's), in
metres, y up. corrected_cameras and corrected_images are there where Polycam optimised the poses.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ...errors import SnergError
from ...io.json_files import read_edited_json
from ..dataset import DatasetOptions, Source
from ..depth import DepthFile
from ..image_resolver import find_below
from .photographs import Listed, Photograph, read_photographs

FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))  # (of cameras, of pictures): the first that is there
DEPTH_FOLDERS = ("depth", "corrected_depth")
DRIFT = (
    "{} has no corrected_cameras: its poses are as the phone tracked them and may drift; process the capture in Polycam for better ones."
)


def _keyframes(path: Path) -> Path | None:
    """The folder 'keyframes' at or in a path."""
    return next((p for p in (path, path / "keyframes") if p.name == "keyframes" and _folders(p) is not None), None)


def _folders(keyframes: Path) -> tuple[Path, Path] | None:
    for cameras, images in FOLDERS:
        if (keyframes / images).is_dir() and next((keyframes / cameras).glob("*.json"), None) is not None:
            return keyframes / cameras, keyframes / images
    return None


def is_polycam(path: Path) -> bool:
    """Whether a path is a folder of Polycam's raw data, or its folder keyframes."""
    return path.is_dir() and _keyframes(path) is not None


def read_polycam(path: Path, options: DatasetOptions) -> Source:
    """Read Polycam's raw data. A camera's file that is damaged leaves its photograph out.

    Raises SnergError as `read_photographs` does.
    """
    keyframes = _keyframes(path)
    folders = None if keyframes is None else _folders(keyframes)
    if keyframes is None or folders is None:
        raise SnergError(f"{path} has no keyframes with cameras and images of Polycam; export its raw data again.")
    cameras, images = folders
    listed: list[Listed] = [(str(file), partial(_photograph, file, keyframes)) for file in sorted(cameras.glob("*.json"))]
    notes = () if cameras.name == FOLDERS[0][0] else (DRIFT.format(keyframes),)
    return read_photographs(cameras, images, listed, options, root=path, kind="polycam", notes=notes)


def _photograph(file: Path, keyframes: Path) -> Photograph:
    """What one camera's file says. Raises SnergError when a value is missing or no number."""
    value = read_edited_json(file)
    try:
        pose = np.array([[float(value[f"t_{row}{column}"]) for column in range(4)] for row in range(3)])
        size = float(value["width"]), float(value["height"])
        focal, centre = (float(value["fx"]), float(value["fy"])), (float(value["cx"]), float(value["cy"]))
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{file} lacks fx, fy, cx, cy, width, height or t_00 to t_23 as numbers ({error}).") from error
    found = [find_below(keyframes, f"{folder}/{file.stem}.png", str(file)) for folder in DEPTH_FOLDERS]
    depth = next((DepthFile(path) for path in found if path is not None), None)
    return Photograph(file.stem, pose, focal, centre, size, depth=depth)
