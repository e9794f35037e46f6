"""What a study reads (its source, the views to measure on, the training images), and the folder that it begins."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..artifact import kind_of, open_field, open_scene
from ..data.dataset import Dataset, DatasetOptions
from ..data.load import read_dataset, read_split
from ..errors import SnergError
from ..io.files import MARK, check_replaceable, write_bytes
from ..io.json_files import json_bytes, read_json
from ..nerf.field import Field
from ..scene.scene import Scene
from ..training.provenance import options_of
from ..training.validation import some_views
from .evaluate import held_out, provenance_of
from .machine import describe_machine
from .plan import StudySettings

VERSION = 1
HOLDOUT = 8  # every 8th view is held out where the dataset holds none out, as in LLFF (Mildenhall et al. 2019)


@dataclass(frozen=True)
class StudyInputs:
    """What a study reads: its source, opened (None for a dataset), views to measure on, training images, and the value of about.json."""

    source: Path
    opened: Field | Scene | None
    views: Dataset
    training: Dataset
    about: dict[str, Any]


def study_inputs(source: Path, dataset: Path | None, settings: StudySettings) -> StudyInputs:
    """What a study of `source` reads. Raises SnergError on bad input, and where the dataset of a field or a scene is not known."""
    kind = kind_of(source)
    notes: list[str] = []
    opened = open_field(source) if kind in ("field", "checkpoint") else open_scene(source) if kind != "dataset" else None
    views, training = _views(source, opened, dataset, settings, notes)
    return StudyInputs(source, opened, views, training, _about(source, kind, views, settings, notes))


def _about(source: Path, kind: str, views: Dataset, settings: StudySettings, notes: list[str]) -> dict[str, Any]:
    """The JSON value of about.json: what is measured, with which settings, and on which machine."""
    return {
        "version": VERSION,
        "kind": kind,
        "path": str(source),
        "dataset": str(views.root),
        "digest": digest(source) if kind != "dataset" else str(source.resolve()),
        "asked": {"views": settings.views, "repeats": settings.repeats, "box": None if settings.box is None else str(settings.box)}
        | {"resolution": settings.resolution, "seed": settings.seed},
        "machine": describe_machine(),
        "notes": notes,
    }


def _views(
    source: Path, opened: Field | Scene | None, dataset: Path | None, settings: StudySettings, notes: list[str]
) -> tuple[Dataset, Dataset]:
    """The views to measure on, and the training images. Where none are held out, every HOLDOUT-th is, with a note added to `notes`."""
    if opened is None:
        path, options = source, DatasetOptions(HOLDOUT)
    else:
        name = opened.dataset if isinstance(opened, Field) else ""
        if dataset is None and not name:
            raise SnergError(f"{source} does not say what it was trained on; give the dataset to measure it on with --dataset.")
        path, options = Path(dataset or name), options_of(provenance_of(opened))
    try:
        views = held_out(path, options)
    except SnergError:
        if "train" not in read_dataset(path, "train", options).splits():
            raise
        options = replace(options, holdout=HOLDOUT)
        views = held_out(path, options)
        seen = "" if opened is None else " The field was trained on them, so that its quality is overestimated."
        notes.append(f"{path} has no held-out views; every {HOLDOUT}th view is held out here.{seen}")
    return some_views(views, settings.views), read_split(views, "train")


def digest(path: Path) -> str:
    """A hash of the bytes of a file, or of all files of a folder apart from hidden ones and the log of a training."""
    found = hashlib.sha256()
    for part in sorted(path.rglob("*")) if path.is_dir() else [path]:
        hidden = any(name.startswith(".") for name in part.relative_to(path).parts)  # MARK, and partial files
        if part.is_file() and not hidden and part.name != "log.jsonl":
            found.update(part.name.encode())
            with open(part, "rb") as file:
                found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()[:16]


def begin(out: Path, about: dict[str, Any]) -> None:
    """Make the study's folder and write about.json. Raises SnergError when the folder holds another study or other files."""
    check_replaceable(out.absolute())
    old = out / "about.json"
    if old.exists():
        known = read_json(old)
        if not isinstance(known, dict) or known.get("version") != VERSION:
            raise SnergError(f"{old} is of another version of studies; choose another folder, or delete this one.")
        for name, what in (("digest", f"of another source ({known.get('path')})"), ("asked", "with other settings")):
            if known.get(name) != about[name]:
                raise SnergError(f"The folder {out} holds a study {what}; choose another folder for this one.")
    elif out.is_dir() and any(path.name != MARK for path in out.iterdir()):
        raise SnergError(f"The folder {out} holds other results; choose a new folder for the study.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARK).touch()
    except OSError as error:
        raise SnergError(f"Cannot write {out} ({error.strerror or error}); choose a folder that you can write to.") from error
    write_bytes(old, json_bytes(about))
