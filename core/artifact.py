"""Opens a path as a dataset, a field or a scene. What lies at a path is decided here and nowhere else."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from .data.dataset import Dataset
from .data.load import is_capture, read_dataset
from .data.readers.others import check_supported
from .errors import SnergError
from .export.reference import is_reference, read_reference
from .export.scene_files import is_scene, read_scene
from .io.files import MARK
from .io.generation import one_generation
from .nerf.checkpoint import is_field, read_field
from .nerf.field import Field
from .nerf.reference_checkpoint import field_of, find_checkpoint, is_orbax, read_reference_checkpoint
from .progress import Progress, silent
from .scene.scene import Scene

Result = dict[str, Any]
FIELDS = ("field", "checkpoint")
SCENES = ("scene", "reference scene", "page")
NAMES = {
    "checkpoint": "a checkpoint of the published code",
    "reference scene": "a baked scene",
    "scene": "a baked scene",
    "page": "a web page of a baked scene",
}
OWN_FILES = re.compile(r".*\.npz|transforms.*\.json|poses_bounds\.npy|checkpoint_\d+", re.IGNORECASE)  # files that need no folder


def artifact_at(path: Path) -> Path:
    """The folder of the scene, the web page, the field or the dataset that the file `path` is a part of.

    `path` itself where it is a folder, does not exist or may not be looked at, or where the file is a field, a checkpoint or a dataset on
    its own.
    """
    if not os.path.isfile(path) or OWN_FILES.fullmatch(path.name):
        return path
    folder = path.absolute().parent
    if is_scene(folder) or is_reference(folder) or is_field(folder) or (path.name == "index.html" and _is_page(folder)):
        return folder
    if is_dataset(path):
        return path
    return next((part for part in (folder, *folder.parents[:2]) if is_dataset(part)), path)  # two levels: the model folder sparse/0


def _is_page(folder: Path) -> bool:
    return (folder / "index.html").is_file() and (folder / MARK).is_file()


def kind_of(path: Path) -> str:
    """What lies at a path: 'dataset', 'field', 'checkpoint' (a field of the reference implementation), 'scene', 'reference scene' (in
    the published layout) or 'page' (a web page with a scene). A file that is a part of one stands for it (see `artifact_at`).

    Raises SnergError when it is none of these.
    """
    path = artifact_at(path)
    if not path.exists():
        raise SnergError(f"{path} does not exist; check the path.")
    if path.is_dir() and is_scene(path):
        return "scene"
    if (path.is_dir() and is_field(path)) or path.suffix == ".npz":
        return "field"
    if path.is_dir() and is_reference(path):
        return "reference scene"
    if _is_page(path):
        return "page"
    if is_dataset(path):
        return "dataset"
    if path.is_dir() and (find_checkpoint(path) is not None or is_orbax(path)):
        return "checkpoint"
    check_supported(path)
    if find_checkpoint(path) is not None:
        return "checkpoint"
    raise SnergError(f"{path} is no dataset, field, checkpoint or baked scene.")


def check_kind(path: Path, wanted: tuple[str, ...], noun: str) -> Path:
    """The artifact at `path` (see `artifact_at`), whose kind is one of `wanted`, which a message calls `noun`. No data is read.

    Raises SnergError, which says what is there instead and how to open it, where it is of another kind.
    """
    if not path.exists():
        raise SnergError(f"{path} does not exist; choose the folder of a {noun}, or a file in it.")
    place, kind = artifact_at(path), kind_of(path)
    if kind in wanted:
        return place
    if kind == "checkpoint" and not is_orbax(place) and not OWN_FILES.fullmatch((find_checkpoint(place) or place).name):
        raise SnergError(f"{path} is not a {noun}; choose the folder of one.")  # any other file
    way = "Import Dataset" if kind == "dataset" else "Import Field" if kind in FIELDS else "Import Scene"
    raise SnergError(f"{path} is {NAMES.get(kind, f'a {kind}')}, not a {noun}; use {way} for it.")


def is_dataset(path: Path) -> bool:
    """Whether one of the readers knows the format of a capture at `path`. Of its files no more than the first bytes are read."""
    try:
        return is_capture(path)
    except OSError:
        return False  # no permission to list the folder or open a file


def open_artifact(path: str | os.PathLike[str], progress: Progress = silent) -> Dataset | Field | Scene:
    """The dataset (its train split), field or scene at a path; for each kind of `kind_of` one of these types.

    If the path is replaced meanwhile, all of the result is of one generation of it. Raises SnergError when it is none of these kinds,
    or damaged.
    """
    place = artifact_at(Path(path))

    def opened() -> Dataset | Field | Scene:
        kind = kind_of(place)
        if kind == "dataset":
            return read_dataset(place)
        return _open_field(place, kind) if kind in FIELDS else _open_scene(place, kind, progress)

    return one_generation(place, opened)


def open_field(path: Path) -> Field:
    """The field at a path, ours or a reference checkpoint's. Raises SnergError where something else is there."""
    path, kind = artifact_at(path), kind_of(path)
    if kind not in FIELDS:
        raise SnergError(f"{path} is a {kind}, not a field; train a field or import one first.")
    return _open_field(path, kind)


def open_scene(path: Path, progress: Progress = silent) -> Scene:
    """The baked scene at a path, in our layout, the published one's, or in a web page. Raises SnergError where something else is there."""
    path, kind = artifact_at(path), kind_of(path)
    if kind not in SCENES or (kind == "page" and not is_scene(path / "scene")):
        raise SnergError(f"{path} is a {kind}, not a baked scene; bake or import one first.")
    return _open_scene(path, kind, progress)


def _open_field(path: Path, kind: str) -> Field:
    return field_of(read_reference_checkpoint(path), str(path)) if kind == "checkpoint" else read_field(path)


def _open_scene(path: Path, kind: str, progress: Progress) -> Scene:
    return read_reference(path, progress) if kind == "reference scene" else read_scene(path / "scene" if kind == "page" else path)
