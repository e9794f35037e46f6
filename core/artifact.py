"""What lies at a path: a dataset, a field or a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .data.readers import colmap, llff, transforms
from .errors import SnergError
from .export.reference import is_reference, read_reference
from .export.scene_files import is_scene, read_scene
from .io.files import MARK
from .nerf.checkpoint import is_field, read_field
from .nerf.field import Field
from .nerf.reference_checkpoint import field_of, find_checkpoint, read_reference_checkpoint
from .progress import Progress, silent
from .scene.scene import Scene

Result = dict[str, Any]


def kind_of(path: Path) -> str:
    """'scene', 'field', 'reference scene', 'page', 'dataset' or 'checkpoint'. Raises SnergError when it is none of these."""
    if not path.exists():
        raise SnergError(f"{path} does not exist; check the path.")
    if path.is_dir() and is_scene(path):
        return "scene"
    if (path.is_dir() and is_field(path)) or path.suffix == ".npz":
        return "field"
    if path.is_dir() and is_reference(path):
        return "reference scene"
    if (path / "index.html").is_file() and (path / MARK).is_file():
        return "page"
    if is_dataset(path):
        return "dataset"
    if find_checkpoint(path) is not None:
        return "checkpoint"
    raise SnergError(f"{path} is no dataset, field, checkpoint or baked scene.")


def is_dataset(path: Path) -> bool:
    """Whether a folder or file looks like a capture that one of the readers knows."""
    try:
        return transforms.is_transforms(path) or llff.is_llff(path) or colmap.is_colmap(path)
    except OSError:
        return False  # a folder that may not be looked into


def any_scene(path: Path, progress: Progress = silent) -> Scene:
    """A baked scene of ours, in a folder or in a web page's, or one in the reference layout."""
    kind = kind_of(path)
    if kind == "page" and is_scene(path / "scene"):
        return read_scene(path / "scene")
    if kind == "scene":
        return read_scene(path)
    if kind == "reference scene":
        return read_reference(path, progress)
    raise SnergError(f"{path} is a {kind}, not a baked scene; bake or import one first.")


def any_field(path: Path) -> Field:
    """A field of ours, or the one of a reference checkpoint. Raises SnergError when `path` holds neither."""
    if kind_of(path) == "checkpoint":
        return field_of(read_reference_checkpoint(path), str(path))
    return read_field(path)
