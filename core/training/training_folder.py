"""The folder of a training: the field's own folder, or a hidden one beside it while a previous field stays in place until the end."""

from __future__ import annotations

import glob
import hashlib
import json
import os
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..data.dataset import Dataset
from ..errors import SnergError
from ..io.files import put_in_place
from ..io.json_files import json_bytes
from ..nerf.checkpoint import FILE, is_field, read_field, read_field_and_state
from ..nerf.field import Field
from .config import TrainSettings

# Settings that earlier versions had not, at the values with which training does as those did.
ADDED = {"depth": "off", "diffuse": 0.0, "packing": "auto"}
NEW, UNFINISHED, FINISHED = "new", "unfinished", "finished"


def training_folder(out: Path, settings: TrainSettings, dataset: Dataset) -> tuple[Path, str]:
    """(the folder in which to train the field `out`, the state of the training there: NEW, UNFINISHED or FINISHED).

    The folder is `out` itself when it holds no field, or an unfinished training with the same settings and images. Otherwise the
    field in `out` stays, and the folder is the hidden .NAME.training-KEY beside it until `finish` moves it. KEY depends on the settings
    and images, so that different trainings have different folders. FINISHED: only `finish` is left to do.
    """
    asked = _plain(asdict(settings), dataset.root.resolve(), asdict(dataset.options), len(dataset.cameras))
    real = Path(os.path.realpath(out))
    beside = _beside(real, asked)
    state = _state(beside, asked)
    if state == FINISHED and is_field(real) and (beside / FILE).stat().st_mtime_ns < (real / FILE).stat().st_mtime_ns:
        state = NEW  # the field before: a kill left it here after the new one had taken its place
    if state != NEW or (is_field(real) and _state(real, asked) != UNFINISHED):
        return beside, state
    return out, UNFINISHED if is_field(real) else NEW


def finish(folder: Path, out: Path) -> None:
    """Move a training's folder beside `out` to `out`. An unfinished training in `out` is moved to a hidden folder, from which it can be
    resumed; a finished field in `out` is deleted. Raises SnergError when `out` cannot be replaced; both are unchanged then."""
    real, keep = Path(os.path.realpath(out)), None
    if is_field(real):
        with suppress(SnergError):  # a damaged one is deleted
            field, state = read_field_and_state(real)
            keep = _beside(real, _identity(field)) if state else None
    put_in_place(folder, real, keep)


def trainings_beside(out: Path) -> list[dict[str, Any]]:
    """{"folder", "steps", "seconds"} of each unfinished training that is to take the place of the field `out`."""
    real, found = Path(os.path.realpath(out)), []
    for folder in sorted(real.parent.glob(f".{glob.escape(real.name)}.training-????????")):
        with suppress(SnergError):  # nothing is saved there yet, or it is damaged: the training begins anew
            about = read_field(folder).about
            found.append({"folder": str(folder), "steps": about.get("steps"), "seconds": about.get("seconds")})
    return found


def _plain(settings: Any, dataset: Path | str, options: Any, views: int) -> dict[str, Any]:
    """The values by which two trainings count as the same, as JSON values. A training of an earlier version has those of this one."""
    if isinstance(settings, dict):
        settings = {name: value for name, value in settings.items() if name not in ADDED or value != ADDED[name]}
    return dict(json.loads(json_bytes({"settings": settings, "dataset": str(dataset), "options": options, "views": views})))


def _identity(field: Field) -> dict[str, Any]:
    return _plain(field.about.get("settings"), field.dataset, field.about.get("dataset_options", {}), len(field.cameras))


def _beside(real: Path, identity: dict[str, Any]) -> Path:
    key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:8]
    return real.with_name(f".{real.name}.training-{key}")


def _state(folder: Path, asked: dict[str, Any]) -> str:
    """How far a folder has got with just what is asked; NEW where it holds something else, or a damaged field."""
    if not is_field(folder):
        return NEW
    try:
        field, state = read_field_and_state(folder)
        if _identity(field) != asked:
            return NEW
    except SnergError:
        return NEW
    return UNFINISHED if state else FINISHED  # a finished one is written without what it takes to go on
