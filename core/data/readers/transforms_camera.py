"""The cameras of transforms files: poses, lenses, fields of view and projections, as their JSON objects state them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.camera import Camera, focal_from_angle, panorama_focal
from ...geometry.distortion import MODELS, Distortion
from ..image_resolver import scaled_to
from ..left_out import UnsupportedLens

LENSES = {
    **dict.fromkeys(("", "PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"), "opencv"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
}
PANORAMA = "EQUIRECTANGULAR"  # nerfstudio's camera_model of a panorama; instant-ngp's is the key latlong
OURS_PANORAMA = "equirectangular"  # our own key 'projection' of panoramas, whose fl_x, fl_y, cx, cy are to be believed
OTHER_LENSES = {  # instant-ngp's keys for lenses that are not supported here, by what they are
    "ftheta_p0": "an f-theta lens",
    "equirectangular": "a cylindrical equal-area picture in instant-ngp, not a panorama of 360 x 180 degrees, whose key is latlong",
}
POSES = ("transform_matrix_start", "transform_matrix")  # the first: instant-ngp's, where a camera moves during the exposure


def read_camera(value: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str, name: str) -> Camera:
    """The camera of a frame whose image is `size` (width, height) pixels. Intrinsics for another size `w` x `h` are scaled to it.

    Raises SnergError, which begins with `where`, when the pose or the intrinsics are missing or invalid.
    """
    try:
        pose = np.array(frame[next(key for key in POSES if key in frame or key == POSES[-1])], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{where} has no transform_matrix of 4 x 4 numbers; every frame needs a pose.") from error
    merged = {**value, **frame}
    for axis in "xy":  # what the frame gives comes before what the file gives, by whichever key
        if any(key in frame for key in _focal_keys(axis)):
            merged = {key: given for key, given in merged.items() if key in frame or key not in _focal_keys(axis)}
    try:
        return _camera(merged, size, pose, where, name)
    except (TypeError, ValueError, OverflowError) as error:
        raise SnergError(f"{where} has intrinsics that are not numbers ({error}).") from error


def _camera(value: dict[str, Any], size: tuple[int, int], pose: NDArray[Any], where: str, name: str) -> Camera:
    width, height = float(value.get("w", size[0])), float(value.get("h", size[1]))
    lens = read_lens(value, where)
    if is_panorama(value):
        whole = _panorama(value, width, height, where)
        return scaled_to(size, (width, height), where, **whole, **_common(value, pose, name))
    focal_x, focal_y = _focal(value, "x", width, where), _focal(value, "y", height, where)
    if focal_x is None and focal_y is None:
        raise SnergError(f"{where} has neither camera_angle_x nor fl_x; a camera needs a field of view or a focal length.")
    focal_x, focal_y = focal_x or focal_y or 0.0, focal_y or focal_x or 0.0
    return scaled_to(
        size,
        (width, height),
        where,
        focal=(focal_x, focal_y),
        centre=(float(value.get("cx", width / 2)), float(value.get("cy", height / 2))),
        projection=str(value.get("projection", "perspective")),
        distortion=lens,
        widest=float(value.get("widest", math.pi)),
        **_common(value, pose, name),
    )


def _common(value: dict[str, Any], pose: NDArray[Any], name: str) -> dict[str, Any]:
    """The arguments of Camera that do not depend on the projection."""
    return {"camera_to_world": pose, "name": name, "near": float(value.get("near", 0)), "far": float(value.get("far", math.inf))}


def is_panorama(value: dict[str, Any]) -> bool:
    """Whether a file or frame describes a panorama."""
    return str(value.get("camera_model", "")).upper() == PANORAMA or bool(value.get("latlong")) or value.get("projection") == OURS_PANORAMA


def _panorama(value: dict[str, Any], width: float, height: float, where: str) -> dict[str, Any]:
    """The arguments of Camera for a panorama of `width` x `height` pixels.

    One of twice its height shows 360 x 180 degrees, whatever its fl_x is: tools disagree about that. Ours may be parts of one, and have
    fl_x and fl_y in pixels per half turn, as nerfstudio has. Raises UnsupportedLens, which begins with `where`, for parts of others.
    """
    if value.get("projection") == OURS_PANORAMA and all(key in value for key in ("fl_x", "fl_y", "cx", "cy")):
        focal, centre = (float(value["fl_x"]) / math.pi, float(value["fl_y"]) / math.pi), (float(value["cx"]), float(value["cy"]))
    elif abs(width - 2 * height) <= 0.02 * width:
        focal, centre = panorama_focal(width, height), (width / 2, height / 2)
    else:
        lens = "latlong" if value.get("latlong") else PANORAMA
        raise UnsupportedLens(
            f"{where} has the lens {lens} and {width:g} x {height:g} pixels; only whole panoramas, twice as wide as high, are supported."
        )
    return {"focal": focal, "centre": centre, "projection": "equirectangular"}


def _focal_keys(axis: str) -> tuple[str, str, str]:
    return f"{axis}_fov", f"fl_{axis}", f"camera_angle_{axis}"


def _focal(value: dict[str, Any], axis: str, pixels: float, where: str) -> float | None:
    """The focal length in pixels along 'x' or 'y': <axis>_fov (degrees), fl_<axis> or camera_angle_<axis> (radians), else None.

    The first of these that is there counts, as in instant-ngp, which is the tool that has them all.
    """
    degrees, focal, radians = _focal_keys(axis)
    if degrees in value:
        return focal_from_angle(math.radians(float(value[degrees])), 1, where) * pixels
    if focal in value:
        return float(value[focal]) or -1.0  # 0 is not 'not given': Camera refuses both
    if radians in value:
        return focal_from_angle(float(value[radians]), 1, where) * pixels
    return None


def read_lens(value: dict[str, Any], where: str) -> Distortion | None:
    """The distortion that a file or frame describes; None for a pinhole camera. Raises SnergError when the lens is not supported."""
    named = str(value.get("camera_model", "")).upper()
    other = [key for key in OTHER_LENSES if value.get(key)]
    if other:
        raise UnsupportedLens(
            f"{where} has the key {other[0]}, {OTHER_LENSES[other[0]]}, which is not supported; undistort the images first."
        )
    if is_panorama(value):
        return None
    if named not in LENSES:
        raise UnsupportedLens(f"{where} has the lens {named}, which is not supported; undistort the images first.")
    ends = value.get("transform_matrix_end")  # without it the camera stands still while the shutter rolls
    moves = ends is not None and ends != next((value[key] for key in POSES if key in value), None)
    if moves and any(float(x) for x in value.get("rolling_shutter", ()) or ()):
        raise SnergError(f"{where} has a rolling_shutter, which is not supported; take the key out to read the images as still ones.")
    model = "fisheye" if value.get("is_fisheye") else LENSES[named]
    value = {**value, **listed_distortion(value, where)}
    if model == "opencv" and named != "FULL_OPENCV" and value.get("k4") and not any(key in value for key in ("k5", "k6")):
        model = "nerfstudio"  # whose k4 is the factor of r^8; OpenCV's is of the denominator and comes with k5 and k6
    coefficients = tuple(float(value.get(key, 0)) for key in MODELS[model])
    return Distortion(model, coefficients) if model == "fisheye" or any(coefficients) else None


def listed_distortion(value: dict[str, Any], where: str) -> dict[str, float]:
    """The coefficients of nerfstudio's distortion_params by their names, which come before single ones; nothing without the key.

    Raises SnergError, which begins with `where`, when there are more than MODELS["nerfstudio"] has, as of its lens FISHEYE624.
    """
    listed, names = value.get("distortion_params"), MODELS["nerfstudio"]
    if listed is None:
        return {}
    if not isinstance(listed, list) or len(listed) > len(names):
        raise SnergError(f"{where} has distortion_params other than {', '.join(names)}; undistort the images first.")
    return dict(zip(names, [*map(float, listed), *[0.0] * len(names)], strict=False))


def intrinsics_json(camera: Camera) -> dict[str, Any]:
    """A camera's intrinsics under instant-ngp's names: w, h, fl_x, fl_y, cx, cy in pixels, the distortion, and the projection where it
    is not perspective."""
    value: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.focal[0]),
        "fl_y": float(camera.focal[1]),
        "cx": float(camera.centre[0]),
        "cy": float(camera.centre[1]),
    }
    if camera.distortion is not None:
        value["camera_model"] = "OPENCV_FISHEYE" if camera.distortion.model == "fisheye" else "OPENCV"  # 'nerfstudio' has no k5, k6
        value |= dict(zip(MODELS[camera.distortion.model], camera.distortion.coefficients, strict=True))
    if camera.projection == "equirectangular":
        value |= {"camera_model": PANORAMA, "fl_x": camera.focal[0] * math.pi, "fl_y": camera.focal[1] * math.pi}
    if camera.projection != "perspective":
        value["projection"] = camera.projection
    if camera.projection == "fisheye":
        value["camera_model"] = "OPENCV_FISHEYE"
        if camera.widest < math.pi:
            value["widest"] = float(camera.widest)
    if camera.near:
        value["near"] = float(camera.near)
    if math.isfinite(camera.far):
        value["far"] = float(camera.far)
    return value
