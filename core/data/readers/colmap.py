"""Reads sparse models of COLMAP, in its text or binary format, and the images that they were made from.

Formats: https://colmap.github.io/format.html. COLMAP's cameras look along +z with y down (OpenCV's axes).
"""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...io.guard import reading
from ...io.paths import inside
from ..dataset import DatasetOptions, Source, View
from ..image_resolver import check_distinct, find_image, has_image_folder, image_folder, scaled_to, size_for
from ..left_out import LeftOut, UnsupportedLens, about_one_view
from ..masks import mask_of
from .colmap_model import Lens, Lenses, Points, Shot, read_model, shot_lines
from .lists import listed

# Where models may lie in a dataset's folder, by the scripts of COLMAP, nerfstudio, instant-ngp and Gaussian splatting. Those of the
# first of these folders that holds any are read; numbered models lie in folders 0, 1 ... of it.
FOLDERS = ("sparse", "colmap/sparse", "dense/sparse", "dense/0/sparse", "colmap_text", "colmap_sparse", "distorted/sparse", "colmap", "")
MAX_LEVELS = 2  # folders above a model's own in which its images are looked for when the path names the model itself
DEPTHS = "depth_params.json"  # Gaussian splatting's scales of inverse depths
DEPTH_PERCENTILES = (0.1, 99.9)  # of the points in a view: its nearest and farthest depth, as in LLFF


def is_colmap(path: Path) -> bool:
    """Whether the path is a folder that holds a COLMAP model, in one of FOLDERS."""
    return path.is_dir() and bool(find_models(path))


def read_colmap(path: Path, options: DatasetOptions) -> Source:
    """Read a COLMAP model and find its images. The result has views sorted by name and, where the model has 3D points, the points
    [N, 3], their colours [N, 3] uint8 and the depth bounds [V, 2] of the views, all in units of the model.

    path: the dataset's folder, with the model in one of FOLDERS and the images in images, images_<n> or input; or the model's own
    folder, with the images beside it or up to two folders above. Of several models the one with the most images is read, and said.
    Masks are masks/<image name>.png, as COLMAP reads them, or named as other tools do (see `mask_of`). Splits are those that files list
    (see `listed`).
    Raises SnergError when a file is damaged, a lens model is not supported or an image is missing.
    """
    folder, said = largest_model(path)
    if folder is None:
        raise SnergError(f"{path} has no COLMAP model (cameras.bin and images.bin, or .txt); check the path.")
    root = _root(path, folder)
    found_lenses, shots, points = read_model(folder)
    if not shots:
        raise SnergError(f"The COLMAP model {folder} has no images; a dataset needs images with their cameras.")
    all_names = [shot.name for shot in shots]
    shots, lenses, notes = _with_lenses(sorted(shots, key=lambda shot: shot.name), found_lenses)
    pictures, factor = image_folder(root, options.downscale, f"The COLMAP model {folder}")
    found = [find_image(pictures, shot.name, str(folder)) for shot in shots]
    check_distinct(((shot.name, image) for shot, image in zip(shots, found, strict=True)), str(folder))
    missing = [shot.name for shot, image in zip(shots, found, strict=True) if image is None]
    if missing:
        raise SnergError(
            f"{pictures} lacks {len(missing)} of the {len(shots)} images of the COLMAP model, such as {missing[0]}; put it there."
        )
    views, kept, left_out = [], [], LeftOut()
    for shot, image in zip(shots, found, strict=True):
        if image is not None:
            with left_out.reading():
                views.append(_view(root, folder, shot, lenses, image))
                kept.append(shot)
    left_out.check(views)
    notes = ((said,) if said else ()) + notes + left_out.notes() + _passed_over(folder)
    splits = listed(root, folder, [shot.name for shot in kept], all_names)
    source = Source(root, "colmap", tuple(views), splits, photographs=True, factor=factor, notes=notes)
    if not len(points.points):
        return source
    return replace(source, points=points.points, colours=points.colours, bounds=_bounds(kept, points))


def _passed_over(folder: Path) -> tuple[str, ...]:
    """Sentences about files beside a model that are not read."""
    if not (folder / DEPTHS).is_file():
        return ()
    return (f"{folder / DEPTHS} is of depths as a network estimates them, for Gaussian splatting; they are not used.",)


def _with_lenses(shots: list[Shot], lenses: Lenses) -> tuple[list[Shot], dict[int, Lens], tuple[str, ...]]:
    """(the images whose lens is supported, the supported lenses, a note for each other lens that images have).

    Raises UnsupportedLens when no image is left.
    """
    supported = {number: lens for number, lens in lenses.items() if isinstance(lens, Lens)}
    kept = [shot for shot in shots if shot.lens in supported]
    refused = {shot.lens for shot in shots} - set(supported)
    notes = []
    for number in sorted(refused):
        error = lenses[number]
        if isinstance(error, UnsupportedLens):
            if not kept:
                raise error
            count = sum(shot.lens == number for shot in shots)
            notes.append(f"{str(error).removesuffix('.')}; its {count} images are left out.")
    return kept, supported, tuple(notes)


def _view(root: Path, folder: Path, shot: Shot, lenses: dict[int, Lens], image: Path) -> View:
    """The view of one image of a model. Raises UnusableView when its picture, pose or lens is invalid."""
    lens = lenses[shot.lens]
    mask = mask_of(root, shot.name, image, str(folder))
    with about_one_view():
        rotation, translation = shot.world_to_camera[:, :3], shot.world_to_camera[:, 3]
        pose = np.eye(4)
        pose[:3, :3] = rotation.T * [1, -1, -1]  # from OpenCV's axes (right, down, ahead) to (right, up, back)
        pose[:3, 3] = -rotation.T @ translation
        given = float(lens.width), float(lens.height)
        size, upright = size_for(image, given)
        camera = scaled_to(
            size,
            given,
            f"{folder}, image {shot.name},",
            focal=lens.focal,
            centre=lens.centre,
            camera_to_world=pose,
            name=Path(shot.name).stem,
            distortion=lens.distortion,
        )
        return View(camera, image, mask, upright=upright)


def _bounds(shots: list[Shot], points: Points) -> NDArray[Any] | None:
    """The depths [V, 2] of the nearest and farthest points in each view, at DEPTH_PERCENTILES; None where a view has no points."""
    bounds = []
    for shot in shots:
        place = np.searchsorted(points.numbers, shot.seen).clip(max=len(points.numbers) - 1)
        known = place[points.numbers[place] == shot.seen]
        depth = points.points[known] @ shot.world_to_camera[2, :3] + shot.world_to_camera[2, 3]
        depth = depth[depth > 0]
        if not len(depth):
            return None
        bounds.append(np.percentile(depth, DEPTH_PERCENTILES))
    return np.array(bounds)


def find_models(path: Path) -> list[Path]:
    """The folders of all models in the first of FOLDERS in `path` that holds any; sorted by number."""
    for name in FOLDERS:
        parent = path / name
        if not parent.is_dir():
            continue
        numbered = sorted((p for p in parent.iterdir() if p.name.isdecimal()), key=lambda p: int(p.name))
        found = [inside(path, str(p.relative_to(path)), str(path)) for p in (parent, *numbered) if _holds_model(p)]
        if found:
            return found
    return []


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def largest_model(path: Path) -> tuple[Path | None, str]:
    """(the folder of the model with the most images, None without one; a sentence that names the other models, '' without others).

    COLMAP numbers its models in the order in which it began them, so that 0 may be a false start.
    """
    models = find_models(path)
    if len(models) < 2:
        return (models[0] if models else None), ""
    counts = [_image_count(folder) for folder in models]
    chosen = int(np.argmax(counts))
    others = ", ".join(f"{models[i].relative_to(path.resolve())} ({counts[i]})" for i in range(len(models)) if i != chosen)
    name = models[chosen].relative_to(path.resolve())
    return models[
        chosen
    ], f"There are {len(models)} COLMAP models: {name}, which has the most images ({counts[chosen]}), is read, not {others}."


def _image_count(folder: Path) -> int:
    """How many images a model has; 0 where its file is missing."""
    binary, text = folder / "images.bin", folder / "images.txt"
    if (folder / "cameras.bin").is_file():
        if not binary.is_file():
            return 0
        with reading(binary, "export the model again"), open(binary, "rb") as file:
            return int(struct.unpack("<Q", file.read(8))[0])
    with reading(text, "export the model again"):
        return sum(1 for _ in shot_lines(text)) if text.is_file() else 0


def _root(path: Path, model: Path) -> Path:
    """The dataset's folder, which contains the images: the nearest to the model that has any, from the model's own up to `path`.

    Where `path` is the model's own folder or the one that holds its number, up to MAX_LEVELS folders above it as well; `path` without any.
    """
    path = path.resolve()
    roots = [folder for folder in (model, *model.parents) if folder.is_relative_to(path)]
    if model == path or model.parent == path:
        roots += path.parents[:MAX_LEVELS]
    return next((root for root in roots if has_image_folder(root)), path)
