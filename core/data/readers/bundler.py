"""Reads Bundler's models (bundle.out, Snavely et al. 2006), which RealityCapture, Pix4D, Zephyr, Metashape and VisualSFM export.

A camera has f, k1, k2, then a rotation by rows and a translation, world-to-camera; it looks along -z with y up (OpenGL's axes). Its
pixels are counted from the middle of the picture, f is in pixels, and the radial factor is 1 + k1 r^2 + k2 r^4. f is 0 where the
photograph was not registered. The names are lines of a list beside the model, in the order of the cameras.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...io.guard import check_file, reading
from ...io.schema import FAR
from ..dataset import DatasetOptions, Source
from ..image_resolver import has_image_folder, image_folder
from .photographs import Listed, Photograph, brown, read_photographs

HEAD = b"# Bundle file"
FOLDERS = ("", "bundler", "bundle")  # of a dataset, in which the model may lie
MAX_BYTES = 2**31
CAMERA_NUMBERS = 15  # f, k1, k2, a rotation of 9, a translation of 3


def find_file(path: Path) -> Path | None:
    """Bundler's model at a path, or the first in a folder or its FOLDERS; None where there is none."""
    if path.is_file():
        return path if path.suffix.lower() == ".out" and _is_bundle(path) else None
    files = [file for folder in FOLDERS for file in sorted((path / folder).glob("*.out"))]
    return next((file for file in files if _is_bundle(file)), None)


def _is_bundle(file: Path) -> bool:
    with open(file, "rb") as data:
        return data.read(len(HEAD)) == HEAD


def is_bundler(path: Path) -> bool:
    """Whether a path is a model of Bundler, or a folder that holds one."""
    return find_file(path) is not None


def read_bundler(path: Path, options: DatasetOptions) -> Source:
    """Read a model of Bundler, its list of photographs and its points. Photographs that were not registered are left out, and counted.

    Raises SnergError when the list is missing, or as `read_photographs` does.
    """
    file = find_file(path)
    if file is None:
        raise SnergError(f"{path} has no model of Bundler (bundle.out); export it again.")
    root = path if path.is_dir() else next((p for p in file.parents[:2] if has_image_folder(p)), file.parent)
    check_file(file, MAX_BYTES)
    with reading(file, "export it again"):
        cameras, points, colours = _model(file)
    names = _names(file, len(cameras))
    registered = [(name, row) for name, row in zip(names, cameras, strict=False) if row[0] != 0]
    left = len(cameras) - len(registered)
    notes = (f"{left} of the {len(cameras)} photographs in {file} were not registered; they are left out.",) if left else ()
    folder, factor = image_folder(root, options.downscale, str(file))
    listed: list[Listed] = [(f"{file}, {name},", partial(_photograph, name, row)) for name, row in registered]
    source = read_photographs(file, folder, listed, DatasetOptions(options.holdout, factor), root=root, kind="bundler", notes=notes)
    return replace(source, points=points, colours=colours) if len(points) else source


def _model(file: Path) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(cameras [C, CAMERA_NUMBERS] float64, points [N, 3] float64, their colours [N, 3] uint8). Raises ValueError for a damaged file."""
    with open(file, encoding="utf-8") as data:
        words = _words(data)
        count, points = int(next(words)), int(next(words))
        size = file.stat().st_size
        if count < 0 or points < 0 or 2 * (CAMERA_NUMBERS * count + 7 * points) > size:  # before anything is allocated for it
            raise ValueError(f"it says that it has {count} cameras and {points} points, more than its size allows")
        cameras = np.array([[float(next(words)) for _ in range(CAMERA_NUMBERS)] for _ in range(count)]).reshape(count, CAMERA_NUMBERS)
        rows = []
        for _ in range(points):
            rows.append([float(next(words)) for _ in range(6)])
            for _ in range(4 * int(next(words))):  # the views that show it
                next(words)
    table = np.array(rows).reshape(points, 6)
    table = table[(np.abs(table) <= FAR).all(axis=-1)]
    return cameras, table[:, :3], table[:, 3:].clip(0, 255).astype(np.uint8)


def _words(lines: Iterator[str]) -> Iterator[str]:
    """The words of a file without its comments. Raises ValueError past the end."""
    for line in lines:
        if not line.startswith("#"):
            yield from line.split()
    raise ValueError("it ends too early")


def _names(file: Path, count: int) -> list[str]:
    """The names of `count` photographs in the list beside a model. Raises SnergError when there is none as long."""
    for listing in sorted(file.parent.glob("*.txt"), key=lambda p: (file.name not in p.name, "list" not in p.name, p.name)):
        check_file(listing, MAX_BYTES)
        with reading(listing, "export it again"):
            lines = [line.strip() for line in listing.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        if len(lines) == count:
            return [_name(line) for line in lines]
    raise SnergError(f"{file} has {count} cameras, but no list of as many photographs beside it (list.txt); export it again.")


def _name(line: str) -> str:
    """The name in a line of a list: it may be followed by 0 and a focal length from EXIF."""
    words = line.rsplit(maxsplit=2)
    return words[0] if len(words) == 3 and words[1] == "0" else line


def _photograph(name: str, row: NDArray[Any]) -> Photograph:
    """One camera of a model. Raises SnergError when its numbers are not finite."""
    if not np.isfinite(row).all():
        raise SnergError(f"The camera of {name} has numbers that are not finite; export the model again.")
    turn = row[3:12].reshape(3, 3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ row[12:]
    lens = brown((float(row[1]), float(row[2]), 0.0, 0.0), 0.0, 0.0)
    return Photograph(name, pose, (float(row[0]),) * 2, (0.0, 0.0), distortion=lens, in_pixels=True)
