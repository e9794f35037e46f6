"""Keys of transforms files that single tools know, beside poses, lenses and the names of files: which are honoured, refused or said.

Those of the loaders of instant-ngp and nerfstudio. The parts of instant-ngp that change what training does, not what the pictures show,
are said, since another program trains here.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...io.images import LINEAR
from ...io.paths import inside
from ..left_out import UnsupportedLens
from ..opacity import Opacity

NEIGHBOURS = 3  # frames before and after one whose mean sharpness instant-ngp compares with its own
REFUSED = {  # keys of the whole file, if they hold anything but false or 0: what to do
    "from_mitsuba": "whose axes are not supported; turn its poses to OpenGL's axes and take the key out",
    "normal_mts_args": "which says that it is for Mitsuba, whose axes are not supported; turn its poses and take the key out",
    "from_na": "whose axes are not supported; turn its poses to OpenGL's axes and take the key out",
}
SAID = {  # keys of the whole file that have no effect here, if they hold anything but false or 0: why
    "sharpen": "pictures are not sharpened",
    "importance_sampling": "pixels are drawn alike",
    "n_extra_learnable_dims": "light that differs between pictures is not learned",
    "envmap": "there is no background picture",
    "render_aabb": "what is shown is the box, which can be made smaller",
}
UPRIGHT = (0.0, 0.0, 1.0)


def check_keys(file: Path, value: dict[str, Any], names: list[str]) -> None:
    """Raise SnergError, which names the key, for one of the whole file that cannot be honoured. names: of the pictures."""
    for key, why in REFUSED.items():
        if value.get(key):
            raise SnergError(f"{file} has {key}, {why}.")
    if value.get("fix_premult") and any(name.lower().endswith(LINEAR) for name in names):
        raise SnergError(f"{file} has fix_premult: its OpenEXR pictures have straight alpha; premultiply them and take the key out.")


def remarks(file: Path, value: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[str, ...]:
    """Sentences about the keys that have no effect here."""
    found = [f"{key} has no effect: {why}" for key, why in SAID.items() if value.get(key)]
    if any(isinstance(frame.get("driver_parameters"), dict) for frame in frames):
        found.append("driver_parameters have no effect: light that differs between pictures is not learned")
    times = [frame["time"] for frame in frames if isinstance(frame.get("time"), int | float)]
    if times and min(times) < max(times):
        found.append("time has no effect: what moves between the pictures will be blurred")
    return tuple(f"{file.name}: {sentence}." for sentence in found)


def kept_frames(file: Path, value: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """(the frames that instant-ngp would read, in their order; sentences about the others).

    It takes the first n_frames by name, and of those leaves out the ones less sharp than sharpness_discard_threshold times the mean
    sharpness of their neighbours. An empty file_path is that of the frame's number. Raises SnergError when these are not numbers.
    """
    part = file.stem.rpartition("_")[2] if "_" in file.stem else ""
    frames = [
        {**frame, "file_path": f"{part}_{i:03d}/rgba.png"} if frame.get("file_path") == "" else frame for i, frame in enumerate(frames)
    ]
    most, threshold = _number(file, value, "n_frames", 0), _number(file, value, "sharpness_discard_threshold", 0)
    order = sorted(range(len(frames)), key=lambda i: _natural(str(frames[i].get("file_path"))))
    notes, first = [], order[: int(most)] if 1 <= most < len(frames) else order
    if len(first) < len(frames):
        notes.append(f"{file.name}: n_frames is {most:g}, so that the last {len(frames) - len(first)} of its frames are left out.")
    sharp = first
    if threshold > 0 and "sharpness" in frames[first[0]]:
        values = np.array([_number(file, frames[i], "sharpness", 1) for i in first])
        means = [values[max(0, n - NEIGHBOURS) : max(min(n + NEIGHBOURS, len(values) - 1), 1)].mean() for n in range(len(values))]
        sharp = [i for n, i in enumerate(first) if values[n] > threshold * means[n]]
    if len(sharp) < len(first):
        notes.append(f"{file.name}: {len(first) - len(sharp)} frames are less sharp than sharpness_discard_threshold allows; left out.")
    return [frames[i] for i in sorted(sharp)], tuple(notes)


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """A key that sorts numbers in names by their value."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"([0-9]+)", name.replace("\\", "/"))]


def _number(where: Path, value: dict[str, Any], key: str, default: float) -> float:
    try:
        found = float(value.get(key, default))
    except (TypeError, ValueError) as error:
        raise SnergError(f"{where} has a {key} that is not a number ({error}).") from error
    return found if math.isfinite(found) else default


def stated_up(file: Path, value: dict[str, Any]) -> NDArray[Any] | None:
    """The up direction [3] of the poses' world that a file states, a unit vector; None where it states none.

    instant-ngp's up; z with nerfstudio's orientation_override 'none', which leaves the poses as they are. Its other values are ways to
    find an up direction, as is done here. Raises SnergError when up is no direction.
    """
    if "up" in value:
        try:
            up = np.array(value["up"], np.float64).reshape(3)
        except (TypeError, ValueError) as error:
            raise SnergError(f"{file} has an up that is not three numbers ({error}).") from error
        length = float(np.linalg.norm(up))
        if not (math.isfinite(length) and length > 1e-9):
            raise SnergError(f"{file} has an up of {value['up']}, which is no direction; correct it or take it out.")
        return np.asarray(up / length)
    return np.array(UPRIGHT) if value.get("orientation_override") == "none" else None


def crop_radius(merged: dict[str, Any], scale: float, where: str) -> float | None:
    """The radius in pixels of the circle around an image's middle outside of which it shows nothing, nerfstudio's fisheye_crop_radius.

    merged: a frame with the keys of its file; scale: pixels of the image a pixel of its intrinsics. None without the key.
    Raises SnergError, which begins with `where`, when it is not a number above 0.
    """
    stated = merged.get("fisheye_crop_radius")
    if stated is None:
        return None
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0 < stated < math.inf:
        raise SnergError(f"{where} has a fisheye_crop_radius of {stated}; it must be a number of pixels above 0.")
    return float(stated) * scale


def opacity_of(value: dict[str, Any], image: Path) -> Opacity | None:
    """How instant-ngp makes an image's pixels transparent; None where its alpha channel alone does.

    white_transparent and black_transparent are pure colours that mean nothing there, except in OpenEXR; <image>.alpha.<suffix> beside
    the image, with or without the image's own suffix, is an image of the opacity in linear light.
    """
    if image.suffix.lower() in LINEAR:
        return None
    levels = tuple(level for key, level in (("white_transparent", 255), ("black_transparent", 0)) if value.get(key))
    beside = [image.with_name(f"{name}.alpha{image.suffix}") for name in (image.name, image.stem)]
    alpha = next((inside(image.parent, path.name, str(image)) for path in beside if path.is_file()), None)
    return Opacity(levels, alpha) if levels or alpha else None


def check_rays(value: dict[str, Any], image: Path, where: str) -> None:
    """Raise UnsupportedLens where instant-ngp would read a ray for each pixel, from rays_<name>.dat beside the image."""
    rays = image.with_name(f"rays_{image.stem}.dat")
    if rays.is_file() and value.get("enable_ray_loading", True):
        raise UnsupportedLens(f"{where} has rays of its own in {rays.name}, which are not read; undistort the image and take them away.")
