"""Reads poses_bounds.npy of LLFF (Mildenhall et al. 2019), which lies beside the folders images and images_<n>."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...io.guard import check_file, reading
from ...io.paths import inside
from ..dataset import DatasetOptions, Source, View
from ..image_resolver import check_distinct, find_image, image_folder, images_in, scaled_to, size_for
from ..left_out import LeftOut, about_one_view
from .colmap import largest_model
from .colmap_model import read_model

FILE = "poses_bounds.npy"
MAX_BYTES = 2**26  # 490,000 views
TO_OPENGL = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # columns (down, right, back) to (right, up, back)


def is_llff(path: Path) -> bool:
    """Whether the path is a file poses_bounds.npy, or a folder that holds one."""
    return path.name == FILE if path.is_file() else (path / FILE).is_file()


def read_llff(path: Path, options: DatasetOptions) -> Source:
    """Read poses_bounds.npy and find its images: a pose, a focal length (pixels) and the nearest and farthest depth of each view.

    The images, sorted by name, belong to the poses in order. Raises SnergError when there are not as many images as poses, or when the
    table is damaged.
    """
    root = path.parent if path.is_file() else path
    table = read_table(inside(root, FILE, str(root)))
    folder, factor = image_folder(root, options.downscale, str(root / FILE))
    images = images_in(folder, str(root))
    notes: tuple[str, ...] = ()
    if len(images) != len(table):
        posed = registered(root, folder, len(table))
        if posed:
            unposed = len(set(images) - set(posed))
            notes = (f"{unposed} photographs in {folder} have no pose, since the COLMAP model does not have them; they are left out.",)
            images = posed
    if len(images) != len(table):
        raise SnergError(f"{root / FILE} has {len(table)} poses, but {folder} has {len(images)} images; they must be as many.")
    views, kept, left_out = [], [], LeftOut()
    for index, (row, image) in enumerate(zip(table, images, strict=True)):
        with left_out.reading(), about_one_view():
            views.append(_view(row, image, f"{root / FILE}, pose {index}"))
            kept.append(index)
    left_out.check(views)
    notes += left_out.notes()
    return Source(root, "llff", tuple(views), photographs=True, bounds=table[kept, 15:], factor=factor, notes=notes)


def _view(row: NDArray[Any], image: Path, where: str) -> View:
    """The view of one row of the table. Raises SnergError when the row is not finite, or not 0 < near < far, or the image is damaged."""
    if not np.isfinite(row).all():
        raise SnergError(f"{where} ({image.name}) holds numbers that are not finite; run LLFF's imgs2poses again.")
    near, far = row[15:]
    if not 0 < near < far:
        raise SnergError(f"{where} ({image.name}) sees from {near:g} to {far:g}; near must be above 0 and far beyond it.")
    pose, (height, width, focal) = row[:15].reshape(3, 5)[:, :4], row[:15].reshape(3, 5)[:, 4]
    size, upright = size_for(image, (float(width), float(height)))
    camera = scaled_to(
        size,
        (float(width), float(height)),
        where,
        focal=(float(focal), float(focal)),
        centre=(float(width) / 2, float(height) / 2),
        camera_to_world=np.concatenate([pose[:, :3] @ TO_OPENGL, pose[:, 3:]], axis=1),
        name=image.stem,
    )
    return View(camera, image, upright=upright)


def registered(root: Path, folder: Path, count: int) -> list[Path]:
    """The images of the COLMAP model beside the table, sorted by name as LLFF sorts them; none unless the model has `count` images."""
    model, _ = largest_model(root)
    if model is None:
        return []
    names = sorted(shot.name for shot in read_model(model)[1])
    found = [find_image(folder, name, str(model)) for name in names]
    check_distinct(zip(names, found, strict=True), str(model))
    return [path for path in found if path is not None] if len(names) == count else []


def read_table(path: Path) -> NDArray[Any]:
    """The table [V, 17] float64 in a .npy file. A row is a 3 x 5 matrix, row by row, and the nearest and farthest depth.

    The matrix's columns are the camera's three axes, its position, and (height, width, focal length) in pixels.
    Raises SnergError when the file holds anything else. Pickled data is refused, because unpickling can run code (hard case 62).
    """
    check_file(path, MAX_BYTES)
    with reading(path, "run LLFF's imgs2poses again", f"The array of numbers {path}"):
        format: Any = np.lib.format  # NumPy gives its reader no types
        table = format.open_memmap(path, mode="r")  # takes memory for no more than there is, and no pickles
    if table.ndim != 2 or table.shape[1] != 17 or not np.issubdtype(table.dtype, np.number):
        raise SnergError(f"{path} holds {table.dtype} {table.shape} instead of 17 numbers for each view; run LLFF's imgs2poses again.")
    if np.iscomplexobj(table):
        raise SnergError(f"{path} holds complex numbers; run LLFF's imgs2poses again.")
    table = np.array(table, np.float64)
    if not len(table):
        raise SnergError(f"{path} has no poses; a dataset needs images with their cameras.")
    return table
