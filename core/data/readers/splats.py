"""Reads cameras.json of Gaussian splatting (Kerbl et al. 2023) as a dataset where the photographs lie beside it.

Each camera has a name, width and height, fx and fy in pixels, and a pose: position and rotation to the world by rows, OpenCV's axes.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ...errors import SnergError
from ...io.json_files import read_edited_json
from ..dataset import DatasetOptions, Source
from ..image_resolver import has_image_folder, image_folder
from .camera_files import read_splat_camera
from .photographs import Listed, Photograph, read_photographs
from .ply import read_ply

FILE = "cameras.json"
POINTS = "input.ply"  # the points of structure from motion, which training copies beside its result


def is_splats(path: Path) -> bool:
    """Whether a path is a file cameras.json, or a folder with one, with a folder of images beside it."""
    file = path if path.is_file() else path / FILE
    return file.name == FILE and file.is_file() and has_image_folder(file.parent)


def is_splat_file(path: Path) -> bool:
    """Whether a path is a file cameras.json with a folder of images beside it."""
    return path.is_file() and is_splats(path)


def read_splats(path: Path, options: DatasetOptions) -> Source:
    """Read cameras.json and find its photographs, and the points of input.ply if it is there.

    Raises SnergError when the file is no list of cameras, or as `read_photographs` does.
    """
    file = path if path.is_file() else path / FILE
    value = read_edited_json(file)
    if not isinstance(value, list) or not value:
        raise SnergError(f"{file} is no list of cameras, as Gaussian splatting writes it; give the capture that it was trained on.")
    folder, factor = image_folder(file.parent, options.downscale, str(file))
    named = [(f"{file}, camera {index}", item) for index, item in enumerate(value)]
    listed: list[Listed] = [(where, partial(_photograph, item, where)) for where, item in named]
    reduced = DatasetOptions(options.holdout, factor)
    source = read_photographs(file, folder, listed, reduced, root=file.parent, kind="splats")
    points = file.parent / POINTS
    if not points.is_file():
        return source
    found, colours = read_ply(points)
    return replace(source, points=found, colours=colours)


def _photograph(item: Any, where: str) -> Photograph:
    camera = read_splat_camera(item, where)
    name = item.get("img_name")
    if not isinstance(name, str) or not name:
        raise SnergError(f"{where} has no img_name; export it again.")
    size = float(camera.width), float(camera.height)
    return Photograph(name, camera.camera_to_world, camera.focal, camera.centre, size)
