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
from ...geometry import wide
from ...geometry.box import Box
from ...geometry.camera import Camera, focal_from_angle, panorama_focal
from ...geometry.distortion import MODELS, Distortion
from ...io.files import write_bytes
from ...io.guard import reading
from ...io.images import read_size
from ...io.json_files import json_bytes, read_edited_json
from ...io.paths import inside
from ..dataset import DatasetOptions, Source, StatedBox, View
from ..depth import depth_of_frame, passes_of_frame
from ..image_resolver import check_distinct, find_image, fits, plain, scaled_to, size_for
from ..left_out import LeftOut, UnsupportedLens, about_one_view
from .dialects import UPRIGHT, check_keys, check_rays, crop_radius, kept_frames, opacity_of, remarks, stated_up
from .others import check_json
from .ply import read_ply

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
OURS = ("snerg_box", "snerg_render")  # keys of files that SNeRG's renders have: their world is Blender's
LENS_KEYS = ("fl_x", "camera_model")  # keys of files of photographs
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
    return source_of(file, *read_frames(file), names, split, options)


def source_of(
    file: Path, value: dict[str, Any], frames: list[dict[str, Any]], names: tuple[str, ...], split: str, options: DatasetOptions
) -> Source:
    """What a transforms file describes. value: the whole file; names: of all splits, where each has a file of its own.

    Raises SnergError as `read_transforms`.
    """
    check_keys(file, value, [str(frame.get("file_path")) for frame in frames])
    frames, said = kept_frames(file, value, frames)
    views, left_out = read_views(file, value, frames)
    there = tuple(view for view in views if view is not None)
    if not there:
        raise SnergError(f"{file} lists {len(frames)} images, of which none exists; put them where the file says, or correct it.")
    splits: dict[str, list[int]] | None
    splits = {split: list(range(len(there)))} if names else listed_splits(file, value, frames, views)
    points, colours = read_points(file, value)
    up = stated_up(file, value)
    lens = any(key in v for key in LENS_KEYS for v in (value, frames[0]))
    photographs = not names and not any(key in value for key in OURS) and (lens or (up is not None and not np.allclose(up, UPRIGHT)))
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
        stated=read_stated_box(file, value),
        factor=options.downscale,
        skipped_frames=len(views) - len(there) - len(left_out.errors),
        notes=said + remarks(file, value, frames) + left_out.notes(),
        up=up,
    )


def read_views(file: Path, value: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[list[View | None], LeftOut]:
    """(the view of each frame, None where it has none or it cannot be used (see `read_frame`); those that cannot be used).

    Raises SnergError as `read_frame` does, and UnusableView when no frame can be used.
    """
    views: list[View | None] = []
    left_out = LeftOut()
    for index, frame in enumerate(frames):
        view = None
        with left_out.reading():
            view = read_frame(file, value, frame, index, "aabb_scale" in value)
        views.append(view)
    left_out.check([view for view in views if view is not None])
    check_distinct(((f["file_path"], v.image) for f, v in zip(frames, views, strict=True) if v is not None), str(file))
    return views, left_out


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
        check_json(file, value)
        raise SnergError(f"{file} has no frames; a dataset needs at least one image with its camera.")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise SnergError(f"{file}, frame {index} is not an object with file_path and transform_matrix.")
    return value, frames


def read_frame(file: Path, value: dict[str, Any], frame: dict[str, Any], index: int, skips_missing: bool) -> View | None:
    """The view of one frame: its camera, image and mask. value: the whole file; index: the frame's number, for errors.

    None when the image does not exist and `skips_missing` is set. Raises SnergError when it is not set, and UnusableView when the
    image, pose or lens is invalid.
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
    with about_one_view():
        stored = read_size(image)
        try:
            given = float(merged.get("w", stored[0])), float(merged.get("h", stored[1]))
        except (TypeError, ValueError, OverflowError):
            given = float(stored[0]), float(stored[1])  # read_camera says what is wrong
        size, upright = (stored, False) if fits(stored, given) else size_for(image, given)
        camera = read_camera(value, frame, size, where, name=image.stem)
        check_rays(value, image, where)
    mask, hides = find_mask(file.parent, value, frame, image, where)
    crop = crop_radius(merged, size[0] / given[0], where)
    opacity = opacity_of(value, image)
    depth = depth_of_frame(file.parent, value, frame) if value.get("enable_depth_loading", True) else None
    passes = passes_of_frame(file.parent, frame)
    return View(camera, image, mask, hides, depth=depth, passes=passes, upright=upright, crop_radius=crop, opacity=opacity)


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


def listed_splits(file: Path, value: dict[str, Any], frames: list[dict[str, Any]], views: list[View | None]) -> dict[str, list[int]] | None:
    """nerfstudio's train_filenames and the like, as numbers of the views there are; None where the file lists none."""
    keys = [split for split, key in SPLITS.items() if key in value]
    if not keys:
        return None
    number: dict[str, int | None] = {}
    there = 0
    for frame, view in zip(frames, views, strict=True):
        number[plain(frame["file_path"])] = there if view is not None else None
        there += view is not None
    splits = {}
    for split in keys:
        names = value[SPLITS[split]]
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise SnergError(f"{file}: {SPLITS[split]} is not a list of file names.")
        unknown = [n for n in names if plain(n) not in number]
        if unknown:
            raise SnergError(f"{file}: {SPLITS[split]} names {unknown[0]} and {len(unknown) - 1} more that are no frame's file_path.")
        splits[split] = [index for n in names if (index := number[plain(n)]) is not None]
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


def read_stated_box(file: Path, value: dict[str, Any]) -> StatedBox | None:
    """The cube that a file of instant-ngp or sdfstudio states, in units of the poses; None where it states none.

    instant-ngp trains in the cube of `aabb_scale` around (0.5, 0.5, 0.5), where a position p of the file lies at p * scale + offset;
    `aabb`, two corners, gives scale and offset (NVlabs/instant-ngp:src/nerf_loader.cu). sdfstudio has scene_box.aabb.
    Raises SnergError when a value is not finite, or the cube has no size.
    """
    key = next((k for k in ("aabb", "scene_box", "aabb_scale", "offset") if k in value), None)
    if key is None:
        return None
    try:
        centre, half = _stated_cube(value, key)
    except (TypeError, ValueError, KeyError, IndexError, ZeroDivisionError) as error:
        raise SnergError(f"{file} has an {key} that is not a number, or not a box of numbers ({error}).") from error
    if not (np.isfinite(centre).all() and math.isfinite(half) and half > 0):
        raise SnergError(f"{file} has an {key} of {value[key]}; it must be above 0.")
    return StatedBox(Box.axis_aligned(centre - half, centre + half), key)


def _stated_cube(value: dict[str, Any], key: str) -> tuple[NDArray[Any], float]:
    """(centre [3], half side) of `read_stated_box`, which may be anything that is not finite or not above 0."""
    enlarged = float(value.get("aabb_scale", 1))
    if key in ("aabb", "scene_box"):
        corners = np.array(value[key] if key == "aabb" else value[key]["aabb"], np.float64).reshape(2, 3)
        enlarged = enlarged if key == "aabb" else 1.0
        return corners.mean(axis=0), float(np.abs(corners[1] - corners[0]).max()) / 2 * enlarged
    scale = float(value.get("scale", NGP_SCALE))
    offset = np.broadcast_to(np.array(value.get("offset", 0.5), np.float64), 3)
    return np.array([(0.5 - float(along)) / scale for along in offset]), 0.5 * enlarged / scale


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
    check_keys(path, value, [])
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

    Raises SnergError for a camera_type other than 'perspective', 'fisheye' and 'equirectangular', and for missing or invalid values.
    """
    kind = str(value.get("camera_type", "perspective")).lower()
    if kind not in ("perspective", *wide.PROJECTIONS):
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
            one = focal_from_angle(math.radians(float(step["fov"])), height, here)
            focal = panorama_focal(width, height) if kind == "equirectangular" else (one, one)
        except (KeyError, TypeError, ValueError) as error:
            raise SnergError(f"{here} lacks camera_to_world (16 numbers) or fov (degrees); export the path again.") from error
        cameras.append(Camera(width, height, focal, (width / 2, height / 2), pose, kind, f"{index:05d}"))
    return tuple(cameras)


def read_splat_cameras(value: list[Any], where: str) -> tuple[Camera, ...]:
    """The cameras of Gaussian splatting's cameras.json (see `read_splat_camera`). Raises SnergError also when there is none."""
    if not value:
        raise SnergError(f"{where} has no cameras; export it again.")
    return tuple(read_splat_camera(item, f"{where}, camera {index}", f"{index:05d}") for index, item in enumerate(value))


def read_splat_camera(item: Any, where: str, name: str = "") -> Camera:
    """One camera of Gaussian splatting's cameras.json, in the world of its capture: OpenCV's axes, rotation to the world by rows.

    name: of a camera without img_name. Raises SnergError, which begins with `where`, when a value is missing or no number.
    """
    try:
        pose = np.eye(4)
        pose[:3, :3] = np.array(item["rotation"], np.float64).reshape(3, 3) * [1, -1, -1]
        pose[:3, 3] = np.array(item["position"], np.float64)
        width, height, focal = int(item["width"]), int(item["height"]), (float(item["fx"]), float(item["fy"]))
        name = Path(str(item.get("img_name", name))).stem
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise SnergError(f"{where} lacks position, rotation, width, height, fx or fy as numbers; export it again.") from error
    return Camera(width, height, focal, (width / 2, height / 2), pose, name=name)
