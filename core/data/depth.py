"""Depth images and other passes that lie beside the pictures of a dataset: found, checked, and converted to world units.

Depth is given to the rest of the program along the camera's axis (z), not along the ray, in world units; NaN where there is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.exr import read_channels
from ..io.guard import check_file, reading
from ..io.images import MAX_BYTES, check_size, read_numbers
from ..io.paths import inside

DEPTH_KEYS = ("depth_file_path", "depth_path")  # of a frame: nerfstudio's and instant-ngp's
UNIT_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")  # of a file: units of the poses a stored unit, theirs again
MILLIMETRE = 1e-3  # nerfstudio's default for integers: millimetres where the poses are in metres
DEPTH_CHANNELS = ("Z", "Depth.Z", "Depth.V", "depth", "Y", "V", "R")  # of OpenEXR, the first that is there; Depth.* of any layer
FARTHEST = 1e9  # values above are renderers' marks for no surface: Blender writes 1e10
PASSES = {"normal": "normal_file_path", "diffuse": "diffuse_file_path", "glossy": "glossy_file_path"}  # keys of a frame
PROPORTION = 0.02  # relative difference of the proportions of a depth image and its picture that is rounding


@dataclass(frozen=True)
class DepthFile:
    """A depth image on disk, which may be missing."""

    path: Path
    unit: float | None = None  # units of the poses a stored unit, NaN if the source's is invalid; None: 1, but MILLIMETRE for integers
    along_ray: bool = False  # whether it is the distance from the camera; else the distance along the camera's axis


def depth_of_frame(root: Path, value: dict[str, Any], frame: dict[str, Any]) -> DepthFile | None:
    """The depth image that a frame of a transforms file names; None where it names none. value: the whole file.

    Training does not need it, so that nothing is refused here: a wrong unit is NaN, and a path that leads out of `root` is missing.
    """
    name = next((frame[key] for key in DEPTH_KEYS if isinstance(frame.get(key), str) and frame[key]), None)
    if name is None:
        return None
    stated = next((merged[key] for merged in (frame, value) for key in UNIT_KEYS if key in merged), None)
    if stated is not None and (isinstance(stated, bool) or not isinstance(stated, int | float) or not 0 < stated < math.inf):
        stated = math.nan
    return DepthFile(_own(root, name) or root / PurePosixPath(name).name, stated, bool(value.get("is_euclidean_depth", False)))


def passes_of_frame(root: Path, frame: dict[str, Any]) -> dict[str, Path]:
    """The passes besides depth that a frame names and that exist in `root`, by their names in PASSES."""
    named = {name: frame[key] for name, key in PASSES.items() if isinstance(frame.get(key), str) and frame[key]}
    paths = {name: _own(root, file) for name, file in named.items()}
    return {name: path for name, path in paths.items() if path is not None and path.is_file()}


def _own(root: Path, name: str) -> Path | None:
    """The path of a file inside `root`; None where it leads out of it."""
    try:
        return inside(root, name.replace("\\", "/"), "The dataset")
    except SnergError:
        return None


def read_depth(file: DepthFile, camera: Camera, factor: int, scale: float) -> NDArray[Any]:
    """The depth of each pixel of `camera` along its axis in world units, float32 [H, W]; NaN where no surface was measured.

    camera: of the picture reduced by `factor`. scale: world units a unit of the poses. A smaller depth image of the same proportions is
    enlarged to the nearest values. A reduced pixel has the lower median of its block, so that no depth between two surfaces appears.
    Raises SnergError when the file is missing or damaged, has other proportions than the picture, holds negative values, or no depth.
    """
    if file.unit is not None and math.isnan(file.unit):
        raise SnergError(f"The unit of the depth image {file.path} is not a number above 0; correct {UNIT_KEYS[0]} in the dataset's file.")
    values, whole = _stored(file.path)
    if (values < 0).any():
        raise SnergError(f"The depth image {file.path} holds negative values; depth is a distance in front of the camera: write it again.")
    found = (values > 0) & (values < FARTHEST)  # false for NaN
    unit = file.unit if file.unit is not None else MILLIMETRE if whole else 1.0
    depth = np.where(found, values * np.float32(unit * scale), np.float32(np.nan))
    depth = _blocks(_fitted(file.path, depth, camera, factor), camera, factor)
    if file.along_ray:
        _, directions = camera.rays()
        depth = depth * camera.cosines(directions).reshape(depth.shape)
    return np.ascontiguousarray(depth, np.float32)


def read_pass(path: Path, camera: Camera, factor: int) -> NDArray[Any]:
    """A pass of colours or directions at the resolution of `camera`, float32 [H, W, 3 or 4]: linear, premultiplied where there is alpha.

    Raises SnergError when the file is missing or damaged, or not as large as the picture.
    """
    channels = read_channels(path)
    names = next((names for names in ("RGBA", "RGB", "XYZ") if all(name in channels for name in names)), "")
    if not names:
        raise SnergError(f"The pass {path} has no channels R, G and B but {', '.join(channels)[:80]}; render it again.")
    values = np.stack([channels[name] for name in names], axis=-1)
    height, width = camera.height, camera.width
    if values.shape[0] // factor != height or values.shape[1] // factor != width:
        raise SnergError(f"The pass {path} is {values.shape[1]} x {values.shape[0]}, not as large as its picture; render it again.")
    if not np.isfinite(values).all():
        raise SnergError(f"The pass {path} holds values that are not finite; render it again.")
    blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return np.ascontiguousarray(blocks.mean(axis=(1, 3)), np.float32)


def _stored(path: Path) -> tuple[NDArray[Any], bool]:
    """(the numbers of a depth image, float32 [H, W], whether they are stored as integers)."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        channels = read_channels(path)
        name = next((key for last in DEPTH_CHANNELS for key in channels if key == last or ("." in last and key.endswith(f".{last}"))), None)
        if name is None:
            raise SnergError(f"The depth image {path} has no channel Z or Y but {', '.join(channels)[:80]}; write depth alone.")
        return channels[name], False
    if suffix == ".npy":
        size = check_file(path, MAX_BYTES)
        with reading(path, "write it again"):
            values = np.load(path, mmap_mode="r", allow_pickle=False)
            if values.dtype.kind not in "fiu" or values.ndim not in (2, 3) or values.size != math.prod(values.shape[:2]):
                raise ValueError(f"it holds {values.dtype} {values.shape}, not one number a pixel")
            check_size(path, values.shape[1], values.shape[0], size)
            return np.array(values, np.float32).reshape(values.shape[:2]), values.dtype.kind != "f"
    values = read_numbers(path)
    if values.dtype == np.uint8:
        raise SnergError(f"The depth image {path} has 8 bits a value, which are a picture of depth; write 16 bits, or OpenEXR.")
    return values.astype(np.float32), values.dtype.kind != "f"


def _fitted(path: Path, depth: NDArray[Any], camera: Camera, factor: int) -> NDArray[Any]:
    """Depth at the whole picture's resolution, up to the last rows and columns that a reduced picture leaves out."""
    (rows, columns), (height, width) = depth.shape, (camera.height * factor, camera.width * factor)
    if 0 <= rows - height < factor and 0 <= columns - width < factor:
        return depth[:height, :width]
    if abs(columns * height - rows * width) > PROPORTION * rows * width + factor * max(rows, columns):
        raise SnergError(f"The depth image {path} is {columns} x {rows}, its picture {width} x {height}; make it of the same proportions.")
    down, across = (np.arange(height) + 0.5) * rows / height, (np.arange(width) + 0.5) * columns / width
    return np.asarray(depth[np.ix_(down.astype(int), across.astype(int))])


def _blocks(depth: NDArray[Any], camera: Camera, factor: int) -> NDArray[Any]:
    """The lower median of the depths in each block of factor x factor pixels; NaN where a block has none."""
    if factor == 1:
        return depth
    blocks = depth.reshape(camera.height, factor, camera.width, factor).transpose(0, 2, 1, 3).reshape(camera.height, camera.width, -1)
    ordered = np.sort(blocks, axis=-1)  # NaN last
    middle = np.maximum(np.isfinite(ordered).sum(axis=-1) - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0])
