"""Surveys as files, so that one look at a field serves every estimate of it; read and asked without JAX."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from ..errors import SnergError
from ..field.checkpoint import FILE
from ..field.field import Field
from ..files import write_arrays
from .survey import Rates, Survey, coarse

VERSION = 1
ARRAYS = ("points", "inside", "voxels", "held", "kept", "samples")


def stamp(field: Path) -> str:
    """Of a field's file: another when it was written again."""
    known = (field / FILE if field.is_dir() else field).stat()
    return f"{known.st_mtime_ns}-{known.st_size}"


def write_survey(path: Path, survey: Survey, field: Path) -> None:
    """Keep what was found of the field at `field`, whole or not at all. Raises SnergError where it cannot be written."""
    about = {"version": VERSION, "field": stamp(field), "rates": asdict(survey.rates), "share": survey.share}
    about |= {"pilot": survey.pilot, "seconds": survey.seconds, "size": survey.filled[1]}
    arrays = {name: np.asarray(getattr(survey, name)) for name in ARRAYS} | {"filled": survey.filled[0]}
    write_arrays(path, arrays | {"about": np.array(json.dumps(about))})


def read_survey(path: Path, source: Path, field: Field) -> Survey | None:
    """What `write_survey` kept of a field, read from `source`; None where nothing is kept, it is of an earlier field or cannot be read:
    it is soon made again."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            about = json.loads(str(kept["about"]))
            if about["version"] != VERSION or about["field"] != stamp(source):
                return None
            found = {name: kept[name] for name in ARRAYS}
            rates = Rates(**{one.name: float(about["rates"][one.name]) for one in fields(Rates)})
            samples = tuple(int(count) for count in found.pop("samples"))
            filled = kept["filled"], float(about["size"])
            share, pilot, seconds = (float(about[name]) for name in ("share", "pilot", "seconds"))
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, SnergError):
        return None
    return Survey(
        field=field,
        coarse=coarse(field),
        points=found["points"],
        share=share,
        inside=found["inside"],
        voxels=found["voxels"],
        held=found["held"],
        kept=found["kept"],
        samples=samples,
        filled=filled,
        pilot=pilot,
        rates=rates,
        seconds=seconds,
    )
