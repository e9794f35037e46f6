"""What a study measures: its fields, which are trained first where the source is a dataset, its baseline, and its plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..artifact import open_field
from ..baking.bake import BakeSettings
from ..data.dataset import DatasetOptions
from ..data.load import read_dataset
from ..export.codecs import SUFFIXES
from ..geometry.box import Box
from ..nerf.checkpoint import is_field
from ..progress import Progress, within
from ..scene.scene import Scene
from ..training.config import PRESETS
from ..training.provenance import background_of
from .evaluate import provenance_of
from .inputs import HOLDOUT, StudyInputs
from .plan import Configuration, PlanStep, StudySettings, available, plan_steps
from .sweep import StudySubject, Sweep

TRAINING_SHARE = 0.25  # of the time limit of a dataset's study, for its longest training
TRAININGS = (0.25, 0.5, 1.0)  # lengths of trainings over that of the longest
LONG_MINUTES = 5.0  # time limit from which all are trained; in shorter ones set-up would take most of the short trainings


def prepare(
    inputs: StudyInputs, out: Path, settings: StudySettings, progress: Progress, stored: str = "stored"
) -> tuple[Sweep, list[PlanStep], Configuration]:
    """The sweep, the plan and the baseline of a study. stored: see Sweep."""
    subject, baseline = _subject(inputs, out, settings, progress)
    sweep = Sweep(subject, out, stored)
    baseline = replace(baseline, refine=baseline.refine and sweep.refinable(baseline.field))
    return sweep, _plan(sweep, baseline, subject), baseline


def _subject(inputs: StudyInputs, out: Path, settings: StudySettings, progress: Progress) -> tuple[StudySubject, Configuration]:
    """The subject of the study, and its baseline."""
    opened, views = inputs.opened, inputs.views
    box = Box.read(settings.box) if settings.box is not None else None
    baked = BakeSettings(resolution=settings.resolution, seed=settings.seed)
    behind = background_of({} if opened is None else provenance_of(opened))
    if isinstance(opened, Scene):
        baseline = Configuration(replace(baked, resolution=max(opened.shape)), refine=False)
        return StudySubject({}, opened, views, None, box, behind, settings.repeats), baseline
    fields = {"": inputs.source} if opened is not None else _trained(inputs.source, settings, out, progress)
    return StudySubject(fields, None, views, inputs.training, box, behind, settings.repeats), Configuration(baked, field=list(fields)[-1])


def _trained(source: Path, settings: StudySettings, out: Path, progress: Progress) -> dict[str, Path]:
    """Train fields of different lengths of training, the shortest first: {name: folder}. Fields of an earlier run are kept."""
    from ..training.trainer import train

    views, folder, fields = read_dataset(source, "train", DatasetOptions(HOLDOUT)), out / "fields", {}
    longest, shares = 60 * settings.minutes * TRAINING_SHARE, TRAININGS if settings.minutes >= LONG_MINUTES else TRAININGS[-1:]
    for turn, share in enumerate(shares):
        seconds = max(round(share * longest), 5)
        name = f"{seconds} s of training"
        fields[name] = folder / str(seconds)
        if not is_trained(fields[name], seconds):
            part = within(progress, turn / len(shares), (turn + 1) / len(shares))
            training = replace(PRESETS["fast"], seconds=float(seconds), seed=settings.seed)
            train(views, training, fields[name], part, is_field(fields[name]))
    return fields


def is_trained(folder: Path, seconds: float) -> bool:
    """Whether the folder has a field that was trained for `seconds` or longer."""
    return is_field(folder) and open_field(folder).about.get("seconds", 0) >= seconds


def _plan(sweep: Sweep, baseline: Configuration, subject: StudySubject) -> list[PlanStep]:
    codecs = available([name for name in SUFFIXES if name != "png"])
    if subject.scene is not None:
        plan = plan_steps(baseline, subject.scene.network is not None, False, False, codecs)
        return [step for step in plan if step.config.baked == baseline.baked and not step.config.refine]
    field = sweep.field(baseline.field)
    others = [name for name in subject.fields if name != baseline.field]
    images = subject.training is not None
    return plan_steps(baseline, field.network is not None, bool(field.cameras), baseline.refine, codecs, others, images)
