"""Surveys as files, so that one look at a field serves every estimate of it; read and asked without JAX."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from ..errors import SnergError
from ..field.checkpoint import FILE
from ..field.field import Field
from ..field.reference_checkpoint import find_checkpoint
from ..files import write_arrays
from .survey import Rates, Survey, coarse

VERSION = 1
ARRAYS = ("points", "inside", "voxels", "held", "kept", "samples")
UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile)


def stamp(source: Path) -> str:
    """Of a field's or a checkpoint's file, and of this machine: another when the file was written again. Raises OSError."""
    file = source / FILE if (source / FILE).is_file() else find_checkpoint(source) or source
    known = file.stat()
    return f"{known.st_mtime_ns} {known.st_size} {platform.node()} {os.cpu_count()}"


def write_survey(path: Path, survey: Survey, mark: str) -> None:
    """Keep what was found of the field with this stamp, whole or not at all. Raises SnergError where it cannot be written."""
    about = {"survey": VERSION, "field": mark, "rates": asdict(survey.rates), "share": survey.share}
    about |= {"pilot": survey.pilot, "seconds": survey.seconds, "size": survey.filled[1]}
    arrays = {name: np.asarray(getattr(survey, name)) for name in ARRAYS} | {"filled": survey.filled[0]}
    write_arrays(path, arrays | {"about": np.array(json.dumps(about))})


def check_survey(path: Path) -> None:
    """Raises SnergError when something else than a survey is at `path`, which `write_survey` would replace."""
    try:
        if not path.exists() or "survey" in _opened(path)[0]:
            return
    except UNREADABLE:
        pass
    raise SnergError(f"{path} is there already, and is no look at a field; name another file to keep one in, or delete it.")


def _opened(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
        return json.loads(str(kept["about"])), {name: kept[name] for name in (*ARRAYS, "filled")}


def read_survey(path: Path, mark: str, field: Callable[[], Field]) -> Survey | None:
    """What `write_survey` kept of the field with this stamp, which is then read; None where nothing is kept, it is of another field or
    machine or cannot be read: it is soon made again. Raises SnergError as `field` does."""
    try:
        about, found = _opened(path)
        if about["survey"] != VERSION or about["field"] != mark:
            return None
        rates = Rates(**{one.name: float(about["rates"][one.name]) for one in fields(Rates)})
        share, pilot, seconds, size = (float(about[name]) for name in ("share", "pilot", "seconds", "size"))
        samples = tuple(int(count) for count in found["samples"])
    except UNREADABLE:
        return None
    read = field()
    return Survey(
        field=read,
        coarse=coarse(read),
        points=found["points"],
        share=share,
        inside=found["inside"],
        voxels=found["voxels"],
        held=found["held"],
        kept=found["kept"],
        samples=samples,
        filled=(found["filled"], size),
        pilot=pilot,
        rates=rates,
        seconds=seconds,
    )
