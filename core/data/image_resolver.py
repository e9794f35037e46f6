"""Finds the images of a capture in its folder, and scales intrinsics to the size of an image."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.paths import inside

SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".exr", ".webp", ".tif", ".tiff", ".bmp")


def find_image(root: Path, name: str, where: str) -> Path | None:
    """The path of the image `name`, which is relative to `root`; None when there is no such file.

    A file of exactly that name comes first; then each of SUFFIXES is appended to the name.
    Raises SnergError, which begins with `where`, when the path leads out of `root`: a dataset must not read other files (hard case 62).
    """
    name = name.replace("\\", "/")
    for suffix in ("", *SUFFIXES):
        candidate = inside(root, name + suffix, where)
        if candidate.is_file():
            return candidate
    return None


def scaled_to(size: tuple[int, int], given: tuple[float, float], where: str, **camera: Any) -> Camera:
    """The camera of an image of `size` (width, height) pixels, from intrinsics for the same image at `given` (width, height).

    camera: the other arguments of Camera. where: the start of error messages. Raises SnergError when the two sizes are not in the
    same proportion, as when the image was rotated or cropped.
    """
    (width, height), (w, h) = size, given
    if not (math.isfinite(w) and math.isfinite(h) and w > 0 and h > 0):
        raise SnergError(f"{where} says that its image is {w:g} x {h:g} pixels; both must be above 0.")
    if abs(width / w * h - height) > max(0.02 * height, 1.5):
        raise SnergError(
            f"{where} is for {w:g} x {h:g} pixels, but its image has {width} x {height}; it was turned or cropped since: use the original."
        )
    sx, sy = width / w, height / h
    (fx, fy), (cx, cy) = camera.pop("focal"), camera.pop("centre")
    return Camera(width=width, height=height, focal=(fx * sx, fy * sy), centre=(cx * sx, cy * sy), **camera)


def image_folder(root: Path, downscale: int, where: str) -> tuple[Path, int]:
    """The folder to read images from, and the factor by which they are still to be reduced.

    images_<n> holds images reduced by n. The folder is the one with the largest n that divides `downscale`; if there is none, the one
    with the smallest n, whose images are not reduced further. Raises SnergError when there is no such folder.
    """
    there = dict(sorted(_folders(root, where)))
    fitting = [n for n in there if downscale % n == 0]
    if fitting:
        return there[fitting[-1]], downscale // fitting[-1]
    if there:
        return there[min(there)], 1
    raise SnergError(f"{where} has no folder 'images' in {root}; put the photographs there.")


def _folders(root: Path, where: str) -> Iterator[tuple[int, Path]]:
    for path in root.iterdir():
        match = re.fullmatch(r"images(?:_([1-9][0-9]{0,3}))?", path.name)
        if match and path.is_dir():
            yield int(match[1] or 1), inside(root, path.name, where)


def images_in(folder: Path, where: str) -> list[Path]:
    """The images of a folder, sorted by name. Raises SnergError when one is a link to a file outside the folder (hard case 62)."""
    names = sorted(p.name for p in folder.iterdir() if PurePosixPath(p.name).suffix in SUFFIXES and not p.name.startswith("."))
    return [inside(folder, name, where) for name in names]
