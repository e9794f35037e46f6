"""The files of COLMAP's sparse models, in its text or binary format.

Formats: https://colmap.github.io/format.html. COLMAP's cameras look along +z with y down (OpenCV's axes).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.distortion import Distortion
from ...io.guard import check_file, reading
from ...io.paths import inside
from ...io.schema import FAR
from ..left_out import UnsupportedLens
from .ply import read_ply

MODELS = {  # COLMAP's model id: (name, number of parameters)
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
COUNTS = {name: count for name, count in MODELS.values()}
# Models with one focal length for x and y; the others begin with two.
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")
# Models that are recognised and refused.
OTHERS = ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR")
MAX_BYTES = 2**32  # of a model's file
MAX_NAME = 4096  # bytes of an image's name


@dataclass(frozen=True, eq=False)
class Lens:
    """The intrinsics of one of a model's cameras, which several images may share. Lengths are in pixels."""

    width: int
    height: int
    focal: tuple[float, float]  # along x and y
    centre: tuple[float, float]  # principal point, x and y, pixel centres at +0.5
    distortion: Distortion | None  # None for a pinhole camera


@dataclass(frozen=True, eq=False)
class Shot:
    """One of a model's images and its pose."""

    name: str  # path relative to the folder of images
    lens: int  # id of its camera in the model
    pose: list[float]  # rotation as a quaternion (w, x, y, z), and translation
    seen: NDArray[Any]  # [N] int64, ids of the 3D points that were matched in it

    @cached_property
    def world_to_camera(self) -> NDArray[Any]:
        """[3, 4] float64, rotation and translation, OpenCV's axes, units of the model. Raises SnergError as `world_to_camera`."""
        return world_to_camera(self.pose, f"The image {self.name}")


@dataclass(frozen=True, eq=False)
class Points:
    """A model's 3D points, in ascending order of their ids."""

    numbers: NDArray[Any]  # [N] int64, ids
    points: NDArray[Any]  # [N, 3] float64, units of the model
    colours: NDArray[Any]  # [N, 3] uint8, sRGB


Lenses = dict[int, Lens | UnsupportedLens]  # a model's cameras by id; of one with a lens that is not supported, the error that says so
T = TypeVar("T")


def read_model(folder: Path) -> tuple[Lenses, list[Shot], Points]:
    """Read a model's files: (cameras by id, images in the order of the file, 3D points).

    The binary files are read where there are both. Without a points3D file, the points are those of points3D.ply, which Gaussian
    splatting makes of it, or none.
    Raises SnergError when a file is damaged, cameras or images are missing, or an image names a camera that the model does not have.
    """
    binary = (folder / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    lenses = _read(folder / f"cameras{suffix}", binary_lenses if binary else text_lenses)
    shots = _read(folder / f"images{suffix}", binary_shots if binary else text_shots)
    file = folder / f"points3D{suffix}"
    points = _read(file, binary_points if binary else text_points) if file.is_file() else _ply_points(folder)
    for shot in shots:
        if shot.lens not in lenses:
            raise SnergError(f"{folder}: the image {shot.name} has camera {shot.lens}, which the model does not have.")
    return lenses, shots, points


def _read(path: Path, reader: Callable[[Path], T]) -> T:
    folder = path.parent
    file = inside(folder, path.name, str(folder))
    if not file.is_file():
        raise SnergError(f"The COLMAP model {folder} has no {file.name}; export the model again.")
    check_file(file, MAX_BYTES)
    with reading(file, "export the model again"):
        return reader(file)


def lens_of(model: str, width: int, height: int, values: list[float], where: str) -> Lens:
    """The lens of one of COLMAP's cameras. width, height: in pixels; values: its parameters, in COLMAP's order (lengths in pixels).

    Raises SnergError, which begins with `where`, when the lens model is not supported or has another number of parameters.
    """
    if model not in COUNTS or model in OTHERS:
        raise UnsupportedLens(
            f"{where} has the lens model {model}, which is not supported; undistort with COLMAP's image_undistorter first."
        )
    if len(values) != COUNTS[model]:
        raise SnergError(f"{where} gives {len(values)} parameters for the lens model {model}, which has {COUNTS[model]}.")
    if model in ONE_FOCAL:
        values = [values[0], *values]
    fx, fy, cx, cy, *bent = values
    distortion = None
    if "FISHEYE" in model:
        distortion = Distortion("fisheye", tuple(bent))
    elif any(bent):
        distortion = Distortion("opencv", tuple(bent))
    return Lens(width, height, (fx, fy), (cx, cy), distortion)


def _lens_or_error(model: str, width: int, height: int, values: list[float], where: str) -> Lens | UnsupportedLens:
    """As `lens_of`, but a known model that is not supported is returned as its error, since other images may have other lenses."""
    try:
        return lens_of(model, width, height, values, where)
    except UnsupportedLens as error:
        if model not in COUNTS:
            raise
        return error


class Bytes:
    """A binary file and a position in it. Reads little-endian values; raises an error instead of reading past the end."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values in a layout of `struct`, such as 'IiQQ'. Raises struct.error past the end."""
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, least: int) -> int:
        """The next number (uint64), which counts the records that follow, of at least `least` bytes each.

        Raises ValueError when the rest of the file is too short for so many.
        """
        (count,) = self.take("Q")
        if count * least > len(self.data) - self.at:
            raise ValueError(f"it says that {count} records follow, more than its size allows")
        return int(count)

    def array(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        """The next `count` records, [count] of dtype `kind`."""
        found = np.frombuffer(self.data, kind, count, self.at)
        self.at += count * kind.itemsize
        return found

    def text(self) -> str:
        """The next string, UTF-8, which ends with a zero byte. Raises ValueError when it is longer than MAX_NAME or not UTF-8."""
        end = self.data.index(b"\0", self.at, self.at + MAX_NAME)
        found = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return found


def binary_lenses(path: Path) -> Lenses:
    """Read cameras.bin: lenses by camera id. Raises SnergError as `lens_of`."""
    file = Bytes(path)
    lenses: Lenses = {}
    for _ in range(file.count(24)):
        number, model, width, height = file.take("IiQQ")
        name, count = MODELS.get(model, (f"number {model}", 0))
        lenses[number] = _lens_or_error(name, width, height, list(file.take(f"{count}d")), f"{path}, camera {number},")
    return lenses


SEEN = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def binary_shots(path: Path) -> list[Shot]:
    """Read images.bin: the images in the order of the file."""
    file = Bytes(path)
    shots = []
    for _ in range(file.count(64 + 1 + 8)):
        _, *pose, lens = file.take("I7dI")
        name = file.text()
        seen = file.array(SEEN, file.count(SEEN.itemsize))["point"]
        shots.append(Shot(name, lens, pose, seen[seen >= 0]))
    return shots


def binary_points(path: Path) -> Points:
    """Read points3D.bin. Points farther than FAR from the origin along an axis are left out."""
    file = Bytes(path)
    rows = []
    for _ in range(file.count(51)):
        number, x, y, z, red, green, blue, _ = file.take("Q3d3Bd")
        seen_by = file.count(8)
        file.at += 8 * seen_by
        rows.append((number, x, y, z, red, green, blue))
    return _points(rows)


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file without the comments, trimmed. Values may be separated by commas, and a byte order mark may lead."""
    with open(path, encoding="utf-8-sig") as file:
        for line in file:
            if not line.lstrip().startswith("#"):
                yield line.strip()


def _values(line: str, most: int = 0) -> list[str]:
    """The values of a line; with `most`, the rest of the line is the last of so many."""
    return re.split(r"\s*,\s*|\s+", line.strip(), maxsplit=max(most - 1, 0))


def shot_lines(path: Path) -> Iterator[tuple[str, str]]:
    """The two lines of each image in images.txt: its pose, and its 2D points, which may be empty."""
    lines = _lines(path)
    for line in lines:
        if line:
            yield line, next(lines, "")


def text_lenses(path: Path) -> Lenses:
    """Read cameras.txt: lenses by camera id. Raises SnergError as `lens_of`."""
    lenses: Lenses = {}
    for line in _lines(path):
        if line.strip():
            number, model, width, height, *values = _values(line)
            where = f"{path}, camera {number},"
            lenses[int(number)] = _lens_or_error(model, int(width), int(height), [float(v) for v in values], where)
    return lenses


def text_shots(path: Path) -> list[Shot]:
    """Read images.txt: the images in the order of the file. Each has two lines, of which the second, its 2D points, may be empty."""
    shots = []
    for line, matches in shot_lines(path):
        _, *pose, lens, name = _values(line, 10)
        tracks = _values(matches) if matches else []
        seen = np.array(tracks[2::3], np.int64)
        if len(pose) != 7:
            raise ValueError(f"the image {name} has a pose of {len(pose)} numbers instead of 7")
        shots.append(Shot(name, int(lens), [float(v) for v in pose], seen[seen >= 0]))
    return shots


def text_points(path: Path) -> Points:
    """Read points3D.txt. Points farther than FAR from the origin along an axis are left out."""
    rows = []
    for line in _lines(path):
        if line.strip():
            number, x, y, z, *colour = _values(line, 8)[:7]
            rows.append((int(number), float(x), float(y), float(z), *(int(c) for c in colour)))
    return _points(rows)


def _ply_points(folder: Path) -> Points:
    """The points of points3D.ply, with numbers below 0, which no image has matched; none without the file."""
    path = inside(folder, "points3D.ply", str(folder))
    if not path.is_file():
        return _points([])
    points, colours = read_ply(path)
    grey = np.full((len(points), 3), 128, np.uint8)
    return Points(np.arange(-len(points), 0), points, grey if colours is None else colours)


def _points(rows: list[tuple[Any, ...]]) -> Points:
    rows = sorted(row for row in rows if (np.abs(row[1:4]) <= FAR).all())
    return Points(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3),
        np.array([row[4:7] for row in rows], np.int64).reshape(-1, 3).clip(0, 255).astype(np.uint8),
    )


def world_to_camera(pose: list[float], where: str) -> NDArray[Any]:
    """The rigid transform [3, 4] from a pose of 7 numbers: a quaternion (w, x, y, z), normalised here, and a translation.

    Raises SnergError, which begins with `where`, when they are not finite or the quaternion is 0.
    """
    q = np.array(pose[:4], np.float64)
    length = float(np.linalg.norm(q))
    if not np.isfinite(pose).all() or length < 1e-9:
        raise SnergError(f"{where} has a pose that is not a finite rotation and position; run COLMAP's mapper again.")
    w, x, y, z = q / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.concatenate([rotation, np.array(pose[4:])[:, None]], axis=1)
