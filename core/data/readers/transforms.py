"""Reads and writes transforms.json, the format of NeRF-synthetic, instant-ngp and nerfstudio.

transform_matrix is camera-to-world, with OpenGL's axes (x right, y up, looking along -z).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.box import Box
from ...io.guard import reading
from ...io.images import read_size
from ...io.json_files import read_edited_json
from ...io.paths import inside
from ..dataset import DatasetOptions, Source, StatedBox, View
from ..depth import depth_of_frame, passes_of_frame
from ..image_resolver import check_distinct, find_image, fits, plain, size_for
from ..left_out import LeftOut, about_one_view
from .dialects import UPRIGHT, check_keys, check_rays, crop_radius, kept_frames, opacity_of, remarks, stated_up
from .others import check_json
from .ply import read_ply
from .transforms_camera import read_camera

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
