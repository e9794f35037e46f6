"""Masks that lie beside the pictures of a capture, by the names that tools give them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ..io.paths import inside
from .dataset import View
from .image_resolver import SUFFIXES, find_below, folders_in

FOLDERS = ("masks", "mask")
# Names by the picture's path {name}, of COLMAP, RealityCapture, nerfstudio and Metashape; {stem} is the path without its suffix.
NAMES = ("{name}.png", "{name}.mask.png", "{name}", "{stem}_mask.png", "{stem}.mask.png")
BESIDE = ("{name}.mask.png", "{stem}_mask.png", "{stem}.mask.png")  # names beside the picture itself


def mask_of(root: Path, name: str, image: Path, where: str) -> Path | None:
    """The mask of the picture `name`, which was found at `image`: in one of FOLDERS in `root`, or beside it; None without one.

    Raises SnergError, which begins with `where`, when it leads out of `root`.
    """
    stem = str(PurePosixPath(name).with_suffix(""))
    for folder in folders_in(root, FOLDERS):
        for pattern in NAMES:
            if (found := find_below(root, f"{folder.name}/{pattern.format(name=name, stem=stem)}", where)) is not None:
                return found
    beside = (image.with_name(pattern.format(name=image.name, stem=image.stem)) for pattern in BESIDE)
    return next((inside(image.parent, path.name, where) for path in beside if path.is_file()), None)


def unused_masks(root: Path, views: Sequence[View]) -> str:
    """A sentence about the masks in FOLDERS of `root` that no view has; '' where there are none."""
    used = {view.mask for view in views}
    for folder in folders_in(root, FOLDERS):
        there = [path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
        left = sorted(path for path in there if path.resolve() not in used)
        if left:
            return f"{len(left)} of the {len(there)} masks in {folder} belong to no picture, such as {left[0].name}; not used."
    return ""
