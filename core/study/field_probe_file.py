"""Surveys as files, so that one look at a field serves every estimate of it; read and asked without JAX."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.files import write_arrays
from ..io.guard import read_arrays, reading
from ..io.schema import number, numbers, record
from ..nerf.checkpoint import FILE
from ..nerf.field import Field
from ..nerf.reference_checkpoint import find_checkpoint
from .field_probe import FieldProbe, Rates, coarse

VERSION = 1
ARRAYS = ("points", "inside", "voxels", "held", "kept", "samples")
MAX_BYTES = 2**28


def stamp(source: Path) -> str:
    """Of a field's or a checkpoint's file, and of this machine: another when the file was written again. Raises OSError."""
    file = source / FILE if (source / FILE).is_file() else find_checkpoint(source) or source
    known = file.stat()
    return f"{known.st_mtime_ns} {known.st_size} {platform.node()} {os.cpu_count()}"


def write_survey(path: Path, survey: FieldProbe, mark: str) -> None:
    """Keep what was found of the field with this stamp, whole or not at all. Raises SnergError where it cannot be written."""
    about = {"survey": VERSION, "field": mark, "rates": asdict(survey.rates), "share": survey.share}
    about |= {"pilot": survey.pilot, "seconds": survey.seconds, "size": survey.filled[1]}
    arrays = {name: np.asarray(getattr(survey, name)) for name in ARRAYS} | {"filled": survey.filled[0]}
    write_arrays(path, arrays | {"about": np.array(json.dumps(about))})


def check_survey(path: Path) -> None:
    """Raises SnergError when something else than a survey is at `path`, which `write_survey` would replace."""
    try:
        if not path.exists() or "survey" in opened(path)[0]:
            return
    except SnergError:
        pass
    raise SnergError(f"{path} is there already, and is no look at a field; name another file to keep one in, or delete it.")


def opened(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """A survey's JSON value and arrays. Raises SnergError where it cannot be read."""
    with reading(path, "delete it"):
        kept = read_arrays(path, MAX_BYTES)
        return record(json.loads(str(kept.pop("about"))), "about"), kept


def check(about: dict[str, Any], found: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """What a survey holds beside its fields, by its names. Raises ValueError, or anything else, on what `write_survey` does not write."""
    m, s, n = len(found["points"]), len(found["voxels"]), len(found["filled"])
    shapes = {"points": (m, 3), "inside": (m,), "voxels": (s,), "held": (s, m), "kept": (s, m), "samples": (s,), "filled": (n, 3)}
    for name, shape in shapes.items():
        numbers(found[name].astype(np.uint8) if found[name].dtype == bool else found[name], name, shape)
        if (found[name].dtype == bool) != (name in ("inside", "held", "kept")):
            raise ValueError(f"{name} is {found[name].dtype}")
    if not s or not (found["voxels"] > 0).all() or not (found["samples"] >= 1).all():
        raise ValueError("it looked at no sizes of voxels")
    values: dict[str, Any] = {name: number(about[name], name, 0) for name in ("share", "pilot", "seconds")}
    given = record(about["rates"], "rates")
    values["rates"] = Rates(**{one.name: number(given[one.name], one.name) for one in fields(Rates)})
    values["samples"] = tuple(int(count) for count in found["samples"])
    values["filled"] = found["filled"], number(about["size"], "size", 0)
    return {name: found[name] for name in ARRAYS} | values


def read_survey(path: Path, mark: str, field: Callable[[], Field]) -> FieldProbe | None:
    """What `write_survey` kept of the field with this stamp, which is then read; None where nothing is kept, it is of another field or
    machine or cannot be read: it is soon made again. Raises SnergError as `field` does."""
    try:
        about, found = opened(path)
        if about.get("survey") != VERSION or about.get("field") != mark:
            return None
        with reading(path, "delete it"):
            values = check(about, found)
    except SnergError:
        return None
    read = field()
    return FieldProbe(field=read, coarse=coarse(read), **values)
