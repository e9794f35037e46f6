"""Finds the images of a capture in its folder, and scales intrinsics to the size of an image."""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.images import lies_down, read_size
from ..io.paths import inside

# In this order where one stem has several.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif", ".hif")
ABSOLUTE = re.compile(r"/|[a-zA-Z]:/")  # how an absolute path begins, of this machine or another
SPLIT_FOLDERS = ("train", "val", "test")  # whose pictures have the same names
FOLDERS = ("input", "image", "imgs", "photos", "rgb")  # where tools keep photographs beside a folder 'images', in this order


def find_image(root: Path, name: str, where: str) -> Path | None:
    """The path of the image `name`, which is relative to `root`; None when there is no such file.

    The first that exists is taken: a file of exactly that name; with one of SUFFIXES appended; the same ignoring letter case and the
    Unicode normal form; with another of SUFFIXES; an end of the path, which may name a folder of another machine (see `_tails`).
    Raises SnergError, which begins with `where`, when the path leads out of `root` and no end of it is in `root` either: a dataset
    must not read other files (hard case 62).
    """
    name = name.replace("\\", "/")
    outside: SnergError | None = None
    try:
        if (found := find_below(root, name, where)) is not None:
            return found
    except SnergError as error:
        outside = error
    for base, rest in _tails(root, name, outside is not None or bool(ABSOLUTE.match(name))):
        if (found := find_below(base, rest, where)) is not None:
            return found
    if outside is not None:
        raise outside
    return None


def _tails(root: Path, name: str, elsewhere: bool) -> Iterator[tuple[Path, str]]:
    """(folder, path below it) for each end of the path `name`, the longest first. elsewhere: whether it names a place outside `root`.

    A path of the folder itself keeps a folder, or drops the name of `root`: test/000.png must not become 000.png of another split.
    """
    parts = [part for part in name.split("/") if part not in ("", ".")]
    bases = [root, *(path for _, path in sorted(_folders(root, str(root)))), *(root / folder for folder in FOLDERS)]
    for start in range(len(parts)):
        kept, dropped = parts[start:], plain(parts[start - 1]) if start else ""
        if ".." in kept or dropped in SPLIT_FOLDERS:
            continue
        if len(parts) == 1 or elsewhere:
            yield from ((base, "/".join(kept)) for base in bases)
        elif start and (len(kept) > 1 or dropped == plain(root.name)):
            yield root, "/".join(kept)


def check_distinct(named: Iterable[tuple[str, Path | None]], where: str) -> None:
    """Raise SnergError when two names were found to be one file, as cam0/000.jpg and cam1/000.jpg are where only 000.jpg exists.

    named: each name with the path that `find_image` gave.
    """
    names: dict[Path, str] = {}
    for name, path in named:
        if path is not None and plain(names.setdefault(path, name)) != plain(name):
            raise SnergError(f"{where} names {names[path]} and {name}, but there is only {path} for both; put each of them where it says.")


def plain(name: str) -> str:
    """A name as it is compared: in one letter case and Unicode normal form, with '/' between folders and without './'."""
    return unicodedata.normalize("NFC", name.replace("\\", "/").removeprefix("./")).casefold()


def find_below(root: Path, name: str, where: str) -> Path | None:
    """The file `name` below `root`, exactly or as it is compared, with any of SUFFIXES. Raises SnergError when it leads out of `root`."""
    for suffix in ("", *SUFFIXES):
        candidate = inside(root, name + suffix, where)
        if candidate.is_file():
            return candidate
    folder = root
    *folders, last = [part for part in name.split("/") if part not in ("", ".")] or [""]
    for part in folders:
        there = _listing(folder).get(plain(part), [])
        folder = folder / (part if part in there or not there else there[0])
    there_by_name = _listing(folder)
    stem = PurePosixPath(last).stem if re.fullmatch(r"\.[A-Za-z]\w{1,4}", PurePosixPath(last).suffix) else last
    for candidate_name in (last, *(last + s for s in SUFFIXES), *(stem + s for s in SUFFIXES)):
        for real in sorted(there_by_name.get(plain(candidate_name), []), key=lambda name: name != candidate_name):
            candidate = inside(root, str(folder / real), where)
            if candidate.is_file():
                return candidate
    return None


def _listing(folder: Path) -> dict[str, list[str]]:
    """The names in a folder by the form in which they are compared; empty where there is no such folder."""
    try:
        return _names(folder, folder.stat().st_mtime_ns)
    except (OSError, ValueError):
        return {}


def folders_in(root: Path, names: tuple[str, ...]) -> list[Path]:
    """The folders in `root` that are called one of `names`, which are in lower case, ignoring theirs; in the order of `names`."""
    return [root / real for name in names for real in _listing(root).get(name, []) if (root / real).is_dir()]


@lru_cache(maxsize=64)
def _names(folder: Path, _changed: int) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name in sorted(os.listdir(folder)):
        found.setdefault(plain(name), []).append(name)
    return found


def size_for(image: Path, given: tuple[float, float]) -> tuple[tuple[int, int], bool]:
    """((width, height) of an image in pixels, whether it is to be turned by its EXIF orientation) for a camera of `given` size.

    It is turned only where it then has the camera's proportion and else has not.
    """
    width, height = read_size(image)
    if fits((width, height), given) or not fits((height, width), given) or not lies_down(image):
        return (width, height), False
    return (height, width), True


def fits(size: tuple[int, int], given: tuple[float, float]) -> bool:
    """Whether an image of `size` (width, height) has the proportion of `given` (width, height), by 2 % or 1.5 pixels."""
    (width, height), (w, h) = size, given
    return w > 0 and abs(width / w * h - height) <= max(0.02 * height, 1.5)


def scaled_to(size: tuple[int, int], given: tuple[float, float], where: str, **camera: Any) -> Camera:
    """The camera of an image of `size` (width, height) pixels, from intrinsics for the same image at `given` (width, height).

    camera: the other arguments of Camera. where: the start of error messages. Raises SnergError when the two sizes are not in the
    same proportion, as when the image was rotated or cropped.
    """
    (width, height), (w, h) = size, given
    if not (math.isfinite(w) and math.isfinite(h) and w > 0 and h > 0):
        raise SnergError(f"{where} says that its image is {w:g} x {h:g} pixels; both must be above 0.")
    if not fits(size, given):
        raise SnergError(
            f"{where} is for {w:g} x {h:g} pixels, but its image has {width} x {height}; it was turned or cropped since: use the original."
        )
    sx, sy = width / w, height / h
    (fx, fy), (cx, cy) = camera.pop("focal"), camera.pop("centre")
    return Camera(width=width, height=height, focal=(fx * sx, fy * sy), centre=(cx * sx, cy * sy), **camera).widened()


def image_folder(root: Path, downscale: int, where: str) -> tuple[Path, int]:
    """The folder to read images from, and the factor by which they are still to be reduced.

    images_<n> holds images reduced by n. The folder is the one with the largest n that divides `downscale`; if there is none, the one
    with the smallest n, whose images are not reduced further. Without such folders it is the first of FOLDERS, then `root` itself if
    photographs lie there. Raises SnergError when there is none.
    """
    there = dict(sorted(_folders(root, where)))
    fitting = [n for n in there if downscale % n == 0]
    if fitting:
        return there[fitting[-1]], downscale // fitting[-1]
    if there:
        return there[min(there)], 1
    for name in (real for folder in FOLDERS for real in _listing(root).get(folder, [])):
        if (root / name).is_dir():
            return inside(root, name, where), downscale
    if images_in(root, where):
        return root, downscale
    raise SnergError(f"{where} has no folder 'images' or 'input' in {root}; put the photographs there.")


def has_image_folder(root: Path) -> bool:
    """Whether `image_folder` finds a folder of images in `root`, `root` itself not counted."""
    names = [name for compared, real in _listing(root).items() if _numbered(compared) or compared in FOLDERS for name in real]
    return any((root / name).is_dir() for name in names)


def _numbered(name: str) -> re.Match[str] | None:
    return re.fullmatch(r"images(?:_([1-9][0-9]{0,3}))?", name)


def _folders(root: Path, where: str) -> Iterator[tuple[int, Path]]:
    for compared, names in _listing(root).items():
        if (match := _numbered(compared)) and (root / names[0]).is_dir():
            yield int(match[1] or 1), inside(root, names[0], where)


def images_in(folder: Path, where: str) -> list[Path]:
    """The images of a folder, sorted by name. Raises SnergError when one is a link to a file outside the folder (hard case 62)."""
    names = sorted(p.name for p in folder.iterdir() if PurePosixPath(p.name).suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return [inside(folder, name, where) for name in names]
