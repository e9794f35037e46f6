"""transforms.json as NeRF-synthetic writes it, with the intrinsics that other tools add."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SnergError
from ...files import inside, json_bytes, read_json, write_bytes
from ...grid.box import Box
from ..camera import Camera, focal_from_angle
from ..dataset import Dataset, View
from ..images import read_size

SUFFIXES = ("", ".png", ".jpg", ".jpeg")


def read_transforms(path: Path, split: str) -> Dataset:
    """Cameras and image paths of transforms_<split>.json, or of a transforms file given by name.

    Intrinsics come from camera_angle_x, or from fl_x, fl_y, cx, cy, w, h where the file or a frame has them.
    Raises SnergError when a file, frame, image or pose is missing or makes no sense.
    """
    file = find_file(path, split)
    value = read_json(file)
    frames = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(frames, list) or not frames:
        raise SnergError(f"{file} has no frames; a dataset needs at least one image with its camera.")
    box = Box.from_json(value["snerg_box"], f"{file}: snerg_box") if "snerg_box" in value else None
    views = tuple(read_frame(file, value, frame, index) for index, frame in enumerate(frames))
    return Dataset(file.parent, split, views, box)


def find_file(path: Path, split: str) -> Path:
    """The file that holds a split. Raises SnergError that lists the splits there are."""
    if path.is_file():
        return path
    if not path.is_dir():
        raise SnergError(f"The dataset {path} does not exist; check the path.")
    file = path / f"transforms_{split}.json"
    if file.is_file():
        return file
    whole = path / "transforms.json"
    if whole.is_file() and split == "train":
        return whole
    there = sorted(p.stem.removeprefix("transforms_") for p in path.glob("transforms_*.json"))
    has = f"it has the splits {', '.join(there)}" if there else "it has no transforms_*.json"
    raise SnergError(f"The dataset {path} has no split {split!r}; {has}.")


def read_frame(file: Path, value: dict[str, Any], frame: Any, index: int) -> View:
    """One frame's camera and image path."""
    where = f"{file}, frame {index}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise SnergError(f"{where} has no file_path; every frame needs an image.")
    image = find_image(file.parent, frame["file_path"], where)
    try:
        pose = np.array(frame["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{where} has no transform_matrix of 4 x 4 numbers; every frame needs a pose.") from error
    camera = read_intrinsics({**value, **frame}, read_size(image), pose, where, name=image.stem)
    return View(camera, image)


def find_image(root: Path, name: str, where: str) -> Path:
    """The image a frame names, with or without its suffix, inside the dataset's folder (hard case 62)."""
    for suffix in SUFFIXES:
        candidate = inside(root, name + suffix, where)
        if candidate.is_file():
            return candidate
    raise SnergError(f"{where} names the image {name}, which does not exist in {root}; put it there or take the frame out.")


def read_intrinsics(value: dict[str, Any], size: tuple[int, int], pose: np.ndarray, where: str, name: str) -> Camera:
    """The camera of a frame whose image is `size` (width, height) pixels; intrinsics given for `w` x `h` are scaled to it."""
    try:
        width, height = float(value.get("w", size[0])), float(value.get("h", size[1]))
        if "fl_x" in value:
            focal_x = float(value["fl_x"])
        elif "camera_angle_x" in value:
            focal_x = focal_from_angle(float(value["camera_angle_x"]), 1, where) * width
        else:
            raise SnergError(f"{where} has neither camera_angle_x nor fl_x; a camera needs a field of view or a focal length.")
        focal_y = float(value.get("fl_y", focal_x))
        centre = float(value.get("cx", width / 2)), float(value.get("cy", height / 2))
        near = float(value.get("near", 0))
        if not (width > 0 and height > 0):
            raise SnergError(f"{where} says its images are {width} x {height}; both must be above 0.")
    except (TypeError, ValueError) as error:
        raise SnergError(f"{where} has intrinsics that are not numbers ({error}).") from error
    sx, sy = size[0] / width, size[1] / height
    return Camera(
        width=size[0],
        height=size[1],
        focal=(focal_x * sx, focal_y * sy),
        centre=(centre[0] * sx, centre[1] * sy),
        camera_to_world=pose,
        projection=str(value.get("projection", "perspective")),
        name=name,
        near=near,
    )


def write_transforms(
    path: Path,
    cameras: Sequence[Camera],
    image_names: Sequence[str],
    box: Box | None = None,
    extra: dict[str, Any] | None = None,
) -> None:
    """Write cameras as a transforms file that any NeRF tool reads, whole or not at all.

    image_names: a path a camera, relative to the file. `box` and `extra` are further keys of our own at the top.
    """
    first = cameras[0]
    frames = [
        {"file_path": name, "transform_matrix": camera.camera_to_world.tolist(), **intrinsics_json(camera)}
        for camera, name in zip(cameras, image_names, strict=True)
    ]
    value: dict[str, Any] = {"camera_angle_x": 2 * float(np.arctan2(first.width / 2, first.focal[0])), **(extra or {})}
    if box is not None:
        value["snerg_box"] = box.to_json()
    write_bytes(path, json_bytes({**value, "frames": frames}))


def intrinsics_json(camera: Camera) -> dict[str, Any]:
    """fl_x, fl_y, cx, cy, w, h as instant-ngp names them, and the projection where it is not perspective."""
    value: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.focal[0]),
        "fl_y": float(camera.focal[1]),
        "cx": float(camera.centre[0]),
        "cy": float(camera.centre[1]),
    }
    if camera.projection != "perspective":
        value["projection"] = camera.projection
    if camera.near:
        value["near"] = float(camera.near)
    return value


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Only the cameras of a transforms file, for rendering: its images need not exist where it gives sizes.

    Raises SnergError when the file has no frames, or gives no size for a camera.
    """
    value = read_json(path)
    frames = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(frames, list) or not frames:
        raise SnergError(f"{path} has no frames; there is no camera to render from.")
    cameras = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        merged = {**value, **frame} if isinstance(frame, dict) else {}
        try:
            pose = np.array(merged["transform_matrix"], np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise SnergError(f"{where} has no transform_matrix of 4 x 4 numbers; every frame needs a pose.") from error
        name = str(merged.get("file_path", f"{index:03d}"))
        if "w" in merged and "h" in merged:
            size = int(merged["w"]), int(merged["h"])
        else:
            size = read_size(find_image(path.parent, name, where))
        cameras.append(read_intrinsics(merged, size, pose, where, name=Path(name).stem))
    return tuple(cameras)
