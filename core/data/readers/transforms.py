"""Reads and writes transforms.json, the format of NeRF-synthetic, instant-ngp and nerfstudio.

transform_matrix is camera-to-world, with OpenGL's axes (x right, y up, looking along -z).
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.box import Box
from ...geometry.camera import Camera, focal_from_angle
from ...geometry.distortion import MODELS, Distortion
from ...io.files import write_bytes
from ...io.guard import reading
from ...io.images import read_size
from ...io.json_files import json_bytes, read_edited_json
from ...io.paths import inside
from ..dataset import DatasetOptions, Source, UnsupportedLens, View
from ..depth import depth_of_frame, passes_of_frame
from ..image_resolver import check_distinct, find_image, fits, plain, scaled_to, size_for
from .ply import read_ply

LENSES = {
    **dict.fromkeys(("", "PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"), "opencv"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
}
OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")  # instant-ngp's keys for lenses that are not supported here
POSES = ("transform_matrix_start", "transform_matrix")  # the first: instant-ngp's, where a camera moves during the exposure
OURS = ("snerg_box", "snerg_render")  # keys of files that SNeRG's renders have: their world is Blender's
SPLITS = {"train": "train_filenames", "val": "val_filenames", "test": "test_filenames"}  # splits and nerfstudio's keys for them
NGP_SCALE = 0.33  # instant-ngp's default scale from the poses' units to its unit cube


def is_transforms(path: Path) -> bool:
    """Whether the path is a JSON file, or a folder with transforms.json or transforms_<split>.json."""
    if path.is_file():
        return path.suffix.lower() == ".json"
    return (path / "transforms.json").is_file() or any(path.glob("transforms_*.json"))


def read_transforms(path: Path, split: str, options: DatasetOptions) -> Source:
    """Read a transforms file and find its images. path: the file, or the folder with transforms_<split>.json or transforms.json.

    Intrinsics come from camera_angle_x (radians), or from fl_x, fl_y, cx, cy, w, h (pixels) and the distortion k1.., p1.. of the file
    or of a frame. `photographs` of the result, which makes `orient` move the world, is False for renders: transforms_<split>.json, files
    of our own, and files without fl_x and camera_model.
    A frame whose image does not exist is an error, except with aabb_scale (instant-ngp): that tool also lists photographs that it
    deleted because they were blurred. Raises SnergError when a file, frame, image, mask, lens or pose is missing or invalid.
    """
    file, names = find_file(path, split)
    with reading(file, "write it again"):
        return _read_transforms(file, names, split, options)


def _read_transforms(file: Path, names: tuple[str, ...], split: str, options: DatasetOptions) -> Source:
    value, frames = read_frames(file)
    views, notes = read_frames_with_lenses(file, value, frames)
    there = tuple(view for view in views if view is not None)
    if not there:
        raise SnergError(f"{file} lists {len(frames)} images, of which none exists; put them where the file says, or correct it.")
    splits: dict[str, list[int]] | None
    splits = {split: list(range(len(there)))} if names else listed_splits(file, value, frames, views)
    points, colours = read_points(file, value)
    photographs = (
        not names and not any(key in value for key in OURS) and any("fl_x" in v or "camera_model" in v for v in (value, frames[0]))
    )
    return Source(
        root=file.parent,
        kind="transforms",
        views=there,
        splits=splits,
        names=names,
        box=Box.from_json(value["snerg_box"], f"{file}: snerg_box") if "snerg_box" in value else None,
        photographs=photographs,
        points=points,
        colours=colours,
        half_extent=read_half_extent(file, value),
        factor=options.downscale,
        skipped_frames=len(views) - len(there) - len(notes),
        notes=notes,
    )


def read_frames_with_lenses(file: Path, value: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[list[View | None], tuple[str, ...]]:
    """The view of each frame, None where it has none (see `read_frame`), and a note for each that is left out for its lens.

    Raises SnergError as `read_frame` does, and for the lens when no frame has another.
    """
    views: list[View | None] = []
    refused: list[UnsupportedLens] = []
    for index, frame in enumerate(frames):
        try:
            views.append(read_frame(file, value, frame, index, "aabb_scale" in value))
        except UnsupportedLens as error:
            refused.append(error)
            views.append(None)
    if refused and not any(views):
        raise refused[0]
    check_distinct(((f["file_path"], v.image) for f, v in zip(frames, views, strict=True) if v is not None), str(file))
    return views, tuple(f"{str(error).removesuffix('.')}; this image is left out." for error in refused)


def find_file(path: Path, split: str) -> tuple[Path, tuple[str, ...]]:
    """(the file that holds a split, names of all splits that have a file of their own). A `path` that is a file is returned as it is.

    Raises SnergError, which lists the splits, when no file holds the split.
    """
    if path.is_file():
        return path, (split,) if path.name.startswith("transforms_") else ()
    files = sorted(p.stem.removeprefix("transforms_") for p in path.glob("transforms_*.json"))
    there = tuple(name for name in files if name == "train" or has_pictures(path / f"transforms_{name}.json"))
    if split in files and split not in there:
        raise SnergError(f"{path / f'transforms_{split}.json'} has no pictures, only cameras; render from them, or render its pictures.")
    if split in there:
        return path / f"transforms_{split}.json", there
    if (path / "transforms.json").is_file():
        return path / "transforms.json", ()
    raise SnergError(f"The dataset {path} has no split {split!r}; it has the splits {', '.join(there)}.")


def has_pictures(file: Path) -> bool:
    """Whether a picture of any frame of a transforms file exists; True for a damaged file, whose reader says so.

    BlenderNeRF writes test cameras without pictures by default.
    """
    try:
        value = read_edited_json(file)
    except SnergError:
        return True
    frames = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(frames, list):
        return True
    names = [frame.get("file_path") if isinstance(frame, dict) else None for frame in frames]
    return any(not isinstance(name, str) or not name or find_image(file.parent, name, str(file)) for name in names)


def read_frames(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """(the JSON object in a transforms file, its frames). Raises SnergError when it has no frames or one is not an object."""
    value = read_edited_json(file)
    frames = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(frames, list) or not frames:
        raise SnergError(f"{file} has no frames; a dataset needs at least one image with its camera.")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise SnergError(f"{file}, frame {index} is not an object with file_path and transform_matrix.")
    return value, frames


def read_frame(file: Path, value: dict[str, Any], frame: dict[str, Any], index: int, skips_missing: bool) -> View | None:
    """The view of one frame: its camera, image and mask. value: the whole file; index: the frame's number, for errors.

    None when the image does not exist and `skips_missing` is set. Raises SnergError when it is not set, and for invalid frames.
    """
    where = f"{file}, frame {index}"
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise SnergError(f"{where} has no file_path; every frame needs an image.")
    image = find_image(file.parent, name, where)
    if image is None:
        if skips_missing:
            return None
        raise SnergError(f"{where} names the image {name}, which does not exist in {file.parent}; put it there or take the frame out.")
    merged = {**value, **frame}
    stored = read_size(image)
    try:
        given = float(merged.get("w", stored[0])), float(merged.get("h", stored[1]))
    except (TypeError, ValueError, OverflowError):
        given = float(stored[0]), float(stored[1])  # read_camera says what is wrong
    size, upright = (stored, False) if fits(stored, given) else size_for(image, given)
    camera = read_camera(value, frame, size, where, name=image.stem)
    mask, hides = find_mask(file.parent, value, frame, image, where)
    depth, passes = depth_of_frame(file.parent, value, frame), passes_of_frame(file.parent, frame)
    return View(camera, image, mask, hides, depth=depth, passes=passes, upright=upright)


def find_mask(root: Path, value: dict[str, Any], frame: dict[str, Any], image: Path, where: str) -> tuple[Path | None, bool]:
    """(the path of a frame's mask or None, whether its white pixels are the excluded ones).

    It is nerfstudio's mask_path, whose black pixels are excluded from training, or instant-ngp's dynamic_mask_<name>.png beside the
    image, whose white pixels are. Raises SnergError when the file of mask_path does not exist.
    """
    name = frame.get("mask_path", value.get("mask_path"))
    if name is not None:
        mask = find_image(root, name, where) if isinstance(name, str) else None
        if mask is None:
            raise SnergError(f"{where} names the mask {name}, which does not exist in {root}; put it there or take mask_path out.")
        return mask, False
    dynamic = inside(root, str(image.with_name(f"dynamic_mask_{image.stem}.png")), where)
    return (dynamic, True) if dynamic.is_file() else (None, False)


def read_camera(value: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str, name: str) -> Camera:
    """The camera of a frame whose image is `size` (width, height) pixels. Intrinsics for another size `w` x `h` are scaled to it.

    Raises SnergError, which begins with `where`, when the pose or the intrinsics are missing or invalid.
    """
    try:
        pose = np.array(frame[next(key for key in POSES if key in frame or key == POSES[-1])], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{where} has no transform_matrix of 4 x 4 numbers; every frame needs a pose.") from error
    merged = {**value, **frame}
    for axis in "xy":  # a frame's own field of view comes before the file's focal length
        if any(key in frame for key in (f"camera_angle_{axis}", f"{axis}_fov")) and f"fl_{axis}" not in frame:
            merged.pop(f"fl_{axis}", None)
    try:
        return _camera(merged, size, pose, where, name)
    except (TypeError, ValueError, OverflowError) as error:
        raise SnergError(f"{where} has intrinsics that are not numbers ({error}).") from error


def _camera(value: dict[str, Any], size: tuple[int, int], pose: NDArray[Any], where: str, name: str) -> Camera:
    width, height = float(value.get("w", size[0])), float(value.get("h", size[1]))
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
        camera_to_world=pose,
        projection=str(value.get("projection", "perspective")),
        name=name,
        near=float(value.get("near", 0)),
        far=float(value.get("far", math.inf)),
        distortion=read_lens(value, where),
    )


def _focal(value: dict[str, Any], axis: str, pixels: float, where: str) -> float | None:
    """The focal length in pixels along 'x' or 'y': fl_<axis>, <axis>_fov (degrees) or camera_angle_<axis> (radians), else None."""
    if f"fl_{axis}" in value:
        return float(value[f"fl_{axis}"]) or -1.0  # 0 is not 'not given': Camera refuses both
    if f"{axis}_fov" in value:
        return focal_from_angle(math.radians(float(value[f"{axis}_fov"])), 1, where) * pixels
    if f"camera_angle_{axis}" in value and (axis == "x" or "camera_angle_x" not in value):
        return focal_from_angle(float(value[f"camera_angle_{axis}"]), 1, where) * pixels
    return None


def read_lens(value: dict[str, Any], where: str) -> Distortion | None:
    """The distortion that a file or frame describes; None for a pinhole camera. Raises SnergError when the lens is not supported."""
    named = str(value.get("camera_model", "")).upper()
    other = [key for key in OTHER_LENSES if value.get(key)]
    if named not in LENSES or other:
        lens = other[0] if other else named
        raise UnsupportedLens(f"{where} has the lens {lens}, which is not supported; undistort the images first.")
    if value.get("from_mitsuba"):
        raise SnergError(f"{where} has from_mitsuba, whose axes are not supported; turn its poses to OpenGL's axes and take the key out.")
    if any(float(x) for x in value.get("rolling_shutter", ()) or ()):
        raise SnergError(f"{where} has a rolling_shutter, which is not supported; take the key out to read the images as still ones.")
    model = "fisheye" if value.get("is_fisheye") else LENSES[named]
    if model == "opencv" and named != "FULL_OPENCV" and value.get("k4") and not any(key in value for key in ("k5", "k6")):
        model = "nerfstudio"  # whose k4 is the factor of r^8; OpenCV's is of the denominator and comes with k5 and k6
    coefficients = tuple(float(value.get(key, 0)) for key in MODELS[model])
    return Distortion(model, coefficients) if model == "fisheye" or any(coefficients) else None


def listed_splits(file: Path, value: dict[str, Any], frames: list[dict[str, Any]], views: list[View | None]) -> dict[str, list[int]] | None:
    """nerfstudio's train_filenames and the like, as numbers of the views there are; None where the file lists none."""
    keys = [split for split, key in SPLITS.items() if key in value]
    if not keys:
        return None
    number: dict[str, int] = {}
    there = 0
    for frame, view in zip(frames, views, strict=True):
        if view is not None:
            number[plain(frame["file_path"])] = there
            there += 1
    splits = {}
    for split in keys:
        names = value[SPLITS[split]]
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise SnergError(f"{file}: {SPLITS[split]} is not a list of file names.")
        unknown = [n for n in names if plain(n) not in number]
        if unknown:
            raise SnergError(f"{file}: {SPLITS[split]} names {unknown[0]} and {len(unknown) - 1} more that are no frame's file_path.")
        splits[split] = [number[plain(n)] for n in names]
    return splits


def read_points(file: Path, value: dict[str, Any]) -> tuple[NDArray[Any] | None, NDArray[Any] | None]:
    """(points [N, 3] float64, colours [N, 3] uint8 or None) of the file ply_file_path; (None, None) without such a file.

    The points are in the same world as the poses: nerfstudio applies its applied_transform to both.
    """
    name = value.get("ply_file_path")
    if not isinstance(name, str):
        return None, None
    path = inside(file.parent, name, str(file))
    return read_ply(path) if path.is_file() else (None, None)


def read_half_extent(file: Path, value: dict[str, Any]) -> float | None:
    """Half the edge length of instant-ngp's cube, which is centred on the origin, in units of the poses; None without aabb_scale."""
    if "aabb_scale" not in value:
        return None
    try:
        half = 0.5 * float(value["aabb_scale"]) / float(value.get("scale", NGP_SCALE))
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise SnergError(f"{file} has an aabb_scale that is not a number ({error}).") from error
    if not (math.isfinite(half) and half > 0):
        raise SnergError(f"{file} has an aabb_scale of {value['aabb_scale']}; it must be above 0.")
    return half


def write_transforms(
    path: Path,
    cameras: Sequence[Camera],
    image_names: Sequence[str],
    box: Box | None = None,
    extra: dict[str, Any] | None = None,
    frame_extras: Sequence[dict[str, Any]] = (),
) -> None:
    """Write cameras as a transforms file that other NeRF tools read, whole or not at all.

    image_names: for each camera the path of its image, relative to the file. box: written as snerg_box. extra: further keys of the
    file's object. frame_extras: further keys of each frame, if any.
    """
    first = cameras[0]
    frames = [
        {"file_path": name, "transform_matrix": camera.camera_to_world.tolist(), **intrinsics_json(camera), **more}
        for camera, name, more in zip(cameras, image_names, frame_extras or [{}] * len(cameras), strict=True)
    ]
    value: dict[str, Any] = {"camera_angle_x": 2 * float(np.arctan2(first.width / 2, first.focal[0])), **(extra or {})}
    if box is not None:
        value["snerg_box"] = box.to_json()
    write_bytes(path, json_bytes({**value, "frames": frames}))


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
    if camera.projection != "perspective":
        value["projection"] = camera.projection
    if camera.near:
        value["near"] = float(camera.near)
    if math.isfinite(camera.far):
        value["far"] = float(camera.far)
    return value


def read_cameras(path: str | os.PathLike[str], size: tuple[int | None, int | None] = (None, None)) -> tuple[Camera, ...]:
    """Read only the cameras of a transforms file or of nerfstudio's camera path, or Gaussian splatting's cameras.json,
    to render from them.

    Where the file gives w and h, the images need not exist. size: (width, height) in pixels of a camera that has neither a size nor an
    image, None where not known; ignored for others. Raises SnergError when the file has no frames, or a camera has no size at all.
    """
    with reading(Path(path), "write it again"):
        value = read_edited_json(Path(path))
        if isinstance(value, dict) and "camera_path" in value:
            return read_camera_path(value, str(path))
        if isinstance(value, list):
            return read_splat_cameras(value, str(path))
        return _read_cameras(Path(path), size)


def _read_cameras(path: Path, wanted: tuple[int | None, int | None]) -> tuple[Camera, ...]:
    value, frames = read_frames(path)
    cameras = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        name = str(frame.get("file_path", f"{index:03d}"))
        merged = {**value, **frame}
        if "w" in merged and "h" in merged:
            size = _whole(merged["w"], where), _whole(merged["h"], where)
        elif (image := find_image(path.parent, name, where)) is not None:
            size = read_size(image)
        elif wanted[0] is not None and wanted[1] is not None:
            size = wanted[0], wanted[1]
        else:
            raise SnergError(f"{where} gives no w and h, and its image {name} does not exist; give --width and --height.")
        cameras.append(read_camera(value, frame, size, where, name=Path(name).stem))
    return tuple(cameras)


def _whole(value: Any, where: str) -> int:
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SnergError(f"{where} has a size that is not a number ({error}).") from error


def read_camera_path(value: dict[str, Any], where: str) -> tuple[Camera, ...]:
    """The cameras of nerfstudio's camera path, in its own world: camera_to_world row by row, and the vertical field of view in degrees.

    Raises SnergError for a camera_type other than 'perspective', and for missing or invalid values.
    """
    kind = str(value.get("camera_type", "perspective")).lower()
    if kind != "perspective":
        raise SnergError(f"{where} is a camera path of camera_type {kind}, which is not supported; export it as perspective.")
    steps = value["camera_path"]
    if not isinstance(steps, list) or not steps:
        raise SnergError(f"{where} has a camera_path without cameras; export it again.")
    width, height = _whole(value.get("render_width"), where), _whole(value.get("render_height"), where)
    cameras = []
    for index, step in enumerate(steps):
        here = f"{where}, camera {index}"
        try:
            pose = np.array(step["camera_to_world"], np.float64).reshape(4, 4)
            focal = focal_from_angle(math.radians(float(step["fov"])), height, here)
        except (KeyError, TypeError, ValueError) as error:
            raise SnergError(f"{here} lacks camera_to_world (16 numbers) or fov (degrees); export the path again.") from error
        cameras.append(Camera(width, height, (focal, focal), (width / 2, height / 2), pose, name=f"{index:05d}"))
    return tuple(cameras)


def read_splat_cameras(value: list[Any], where: str) -> tuple[Camera, ...]:
    """The cameras of Gaussian splatting's cameras.json, in the world of its capture: OpenCV's axes, rotation to the world by rows.

    Raises SnergError, which begins with `where`, when there is none or one is incomplete.
    """
    cameras = []
    for index, item in enumerate(value):
        here = f"{where}, camera {index}"
        try:
            pose = np.eye(4)
            pose[:3, :3] = np.array(item["rotation"], np.float64).reshape(3, 3) * [1, -1, -1]
            pose[:3, 3] = np.array(item["position"], np.float64)
            width, height, focal = int(item["width"]), int(item["height"]), (float(item["fx"]), float(item["fy"]))
            name = Path(str(item.get("img_name", f"{index:05d}"))).stem
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise SnergError(f"{here} lacks position, rotation, width, height, fx or fy as numbers; export it again.") from error
        cameras.append(Camera(width, height, focal, (width / 2, height / 2), pose, name=name))
    if not cameras:
        raise SnergError(f"{where} has no cameras; export it again.")
    return tuple(cameras)
