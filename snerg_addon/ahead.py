"""What a bake will take, for the panel: from a survey that was kept, a few milliseconds each time the box or a setting changes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from ..core.baking.bake import BakeSettings
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.nerf.checkpoint import read_field
from ..core.study.cost_model import estimate
from ..core.study.field_probe import FieldProbe
from ..core.study.field_probe_file import read_survey, stamp
from .bridge import box_from_blender, box_of, resolution
from .project import Project, project_of

KEPT = 16  # answers: more than there are windows
_surveys: dict[Path, tuple[tuple[int, int], FieldProbe | None]] = {}
_told: dict[str, list[str]] = {}


def survey_of(project: Project) -> FieldProbe | None:
    """What is known of the project's field; None where it was not looked at since it was written. Read again when a file changed."""
    try:
        written = (project.survey.stat().st_mtime_ns, (project.field / "field.npz").stat().st_mtime_ns)
    except OSError:
        return None
    known = _surveys.get(project.survey)
    if known is None or known[0] != written:
        try:
            found = read_survey(project.survey, stamp(project.field), lambda: read_field(project.field))
        except (SnergError, OSError):
            found = None
        _told.clear()
        known = _surveys[project.survey] = (written, found)
    return known[1]


def texts(context: bpy.types.Context) -> list[str]:
    """What the bake that the panel describes will take, in a few short lines; none where the field was not looked at yet."""
    survey = survey_of(project_of(context.scene))
    if survey is None:
        return []
    settings, box = context.scene.snerg, box_of(context.scene)
    try:
        volume = box_from_blender(box) if box and survey.field.ndc is None else survey.field.domain.world_box()
        wanted = BakeSettings(resolution=settings.resolution, voxel_size=settings.voxel_size or None, supersampling=settings.samples)
        return _lines(survey, volume, wanted, settings.refine, resolution(context.scene))
    except SnergError as error:
        return [str(error)]


def _lines(survey: FieldProbe, box: Box, settings: BakeSettings, refine: bool, size: tuple[int, int]) -> list[str]:
    """Remembered as long as nothing changes: a panel is drawn far more often than that."""
    key = json.dumps([id(survey), box.to_json(), str(settings), refine, size])
    if key not in _told:
        found = estimate(survey, box, settings, refine, size)
        if len(_told) > KEPT:
            _told.clear()
        _told[key] = told(found.to_json())
    return _told[key]


def told(value: dict[str, Any]) -> list[str]:
    """An estimate (`Estimate.to_json`) for people, rounded to what it is worth."""
    seconds = value["bake_seconds"] + value["seconds"].get("refine", 0.0)
    time = f"{seconds / 60:.0f} minutes" if seconds >= 120 else f"{seconds:.0f} seconds"
    memory = f"{value['peak_megabytes'] / 1000:.1f} GB of memory"
    return [f"about {time}, {memory}", f"{value['megabytes']:.0f} MB as PNG, {value['preview']:.2g} s a preview"]
