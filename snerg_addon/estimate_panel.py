"""The bake panel's estimate of time, memory and size, from the field probe that the operator saved: a few milliseconds an update."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from ..core.baking.bake import BakeSettings
from ..core.baking.finish import Finishing
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.nerf.checkpoint import read_field
from ..core.study.cost_model import estimate
from ..core.study.field_probe import FieldProbe
from ..core.study.field_probe_file import read_field_probe, stamp
from ..core.units import duration, file_size
from .bridge import box_from_blender, box_of, resolution
from .project import Project, project_of

MAX_CACHED = 16  # estimates: more than there are windows
_probes: dict[Path, tuple[tuple[int, int], FieldProbe | None]] = {}
_estimates: dict[str, dict[str, Any]] = {}


def probe_of(project: Project) -> FieldProbe | None:
    """The probe of the project's field; None where there is none of its latest version. Cached until a file changes."""
    try:
        written = (project.survey.stat().st_mtime_ns, (project.field / "field.npz").stat().st_mtime_ns)
    except OSError:
        return None
    known = _probes.get(project.survey)
    if known is None or known[0] != written:
        try:
            found = read_field_probe(project.survey, stamp(project.field), lambda: read_field(project.field))
        except (SnergError, OSError):
            found = None
        _estimates.clear()
        known = _probes[project.survey] = (written, found)
    return known[1]


def bake_settings(scene: bpy.types.Scene) -> BakeSettings:
    """The bake of the panel's settings. Raises SnergError when it is not possible."""
    settings = scene.snerg
    return BakeSettings(resolution=settings.resolution, voxel_size=settings.voxel_size or None, supersampling=settings.samples)


def finishing_of(scene: bpy.types.Scene) -> Finishing:
    """What the panel's settings do after a bake."""
    settings = scene.snerg
    return Finishing(settings.refine, settings.fit, settings.prune)


def lines(context: bpy.types.Context) -> list[str]:
    """The estimate for the panel's settings and the box, in a few short lines; none where the field has no probe yet."""
    try:
        found = _estimated(context, bake_settings(context.scene))
    except SnergError as error:
        return [str(error)]
    return [] if found is None else summary(found)


def estimated(context: bpy.types.Context, settings: BakeSettings) -> dict[str, Any] | None:
    """The estimate (`Estimate.to_json`) of a bake of the project's field in the box; None without a probe, or where it cannot be baked."""
    try:
        return _estimated(context, settings)
    except SnergError:
        return None


def _estimated(context: bpy.types.Context, settings: BakeSettings) -> dict[str, Any] | None:
    probe = probe_of(project_of(context.scene))
    if probe is None:
        return None
    box = box_of(context.scene)
    volume = box_from_blender(box) if box and probe.field.ndc is None else probe.field.domain.world_box()
    return _cached(probe, volume, settings, finishing_of(context.scene), resolution(context.scene))


def _cached(probe: FieldProbe, box: Box, settings: BakeSettings, finishing: Finishing, size: tuple[int, int]) -> dict[str, Any]:
    """The estimate, cached because a panel is drawn far more often than its settings change."""
    key = json.dumps([id(probe), box.to_json(), str(settings), str(finishing), size])
    if key not in _estimates:
        found = estimate(probe, box, settings, finishing, size)
        if len(_estimates) > MAX_CACHED:
            _estimates.clear()
        _estimates[key] = found.to_json()
    return _estimates[key]


def summary(value: dict[str, Any]) -> list[str]:
    """Two lines for an estimate (`Estimate.to_json`)."""
    seconds = value["bake_seconds"] + value["finishing_seconds"]
    memory, files = (file_size(1e6 * value[name]) for name in ("peak_megabytes", "megabytes"))
    return [f"about {duration(seconds)}, {memory} of memory", f"{files} as PNG, {duration(value['preview'])} per preview"]
