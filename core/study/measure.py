"""Measures the configurations of a study's plan before a deadline, the fields themselves, and the fields of the paper's tables."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import replace

from ..errors import SnergError
from ..nerf.checkpoint import is_field
from ..progress import Progress, within
from ..training.config import PRESETS
from ..units import duration
from .paper_tables import BAKED, PAPER, VARIANTS
from .plan import Configuration, PlanStep, StudySettings
from .prepare import is_trained
from .sweep import Sweep, field_key


def measure(
    sweep: Sweep,
    plan: Sequence[PlanStep],
    baseline: Configuration,
    deadline: float,
    minutes: float,
    progress: Progress,
    with_fields: bool = True,
) -> list[str]:
    """Measure the configurations without a row, until the deadline (of time.monotonic); returns the texts of those that were left out.

    with_fields: whether the fields themselves are measured, too. A configuration that is predicted to exceed the deadline is skipped.
    Raises SnergError where the time is too short for the first.
    """
    left_out, ratios = [], [1.0]
    for index, step in enumerate(plan):
        if step.config.key in sweep.rows:
            continue
        begun, expected = time.monotonic(), sweep.needs(step.config)
        needed, left = statistics.median(ratios) * expected, deadline - begun
        if needed > left:
            if not any(row["config"] for row in sweep.rows.values()):
                raise SnergError(
                    f"The coarsest configuration takes about {duration(needed)}, and of the {minutes:g} minutes {duration(max(left, 0))} "
                    "are left; give more minutes, fewer views or a lower resolution."
                )
            left_out.append(step.text)
            continue
        sweep.row(step, _named(within(progress, index / len(plan), (index + 1) / len(plan)), step))
        ratios.append(min(max((time.monotonic() - begun) / max(expected, 1e-3), 0.3), 3.0))
        if step.config == baseline:
            fields(sweep, deadline, within(progress, (index + 1) / len(plan), (index + 1) / len(plan)))
    return left_out + (fields(sweep, deadline, within(progress, 1, 1)) if with_fields else [])


def _named(progress: Progress, step: PlanStep) -> Progress:
    """Progress whose texts name the configuration."""
    what = "; ".join(f"{parameter}: {value}" for parameter, value in step.parameters[:2])
    return lambda fraction, message: progress(fraction, f"{what}: {message}")


def fields(sweep: Sweep, deadline: float, progress: Progress) -> list[str]:
    """Measure the fields themselves before the deadline; returns the texts of those that were left out."""
    left_out = []
    for name in sweep.subject.fields:
        if field_key(name) in sweep.rows:
            continue
        if sweep.field_seconds(name) > deadline - time.monotonic():
            left_out.append(f"the field itself ({name})" if name else "the field itself")
        else:
            sweep.field_row(name, progress)
    return left_out


def variants(
    sweep: Sweep, plan: list[PlanStep], baseline: Configuration, deadline: float, settings: StudySettings, progress: Progress
) -> list[str]:
    """Train the fields of the paper's tables, each as long as the baseline's, before the deadline, and measure them and their bakes.

    Adds their steps to the plan. Returns the texts of what was left out.
    """
    from ..training.trainer import train

    subject, left_out = sweep.subject, []
    about = sweep.field(baseline.field).about
    seconds = about.get("seconds")
    if subject.training is None or not seconds:
        return ["the paper's other fields (this one does not say how long it was trained)"]
    for turn, (name, changes) in enumerate(VARIANTS.items()):
        folder, part = sweep.out / "fields" / name.replace(" ", "-"), within(progress, turn / len(VARIANTS), (turn + 1) / len(VARIANTS))
        if not is_trained(folder, seconds):
            if seconds > deadline - time.monotonic():
                left_out.append(f"the paper's field {name!r}")
                continue
            background = about.get("settings", {}).get("background", "white")
            training = replace(PRESETS["fast"], seconds=float(seconds), seed=settings.seed, background=background, **changes)
            train(subject.training, training, folder, part, is_field(folder))
        subject.fields[name] = folder
    some = [name for name in BAKED if name in subject.fields]
    extra = [PlanStep(replace(baseline, field=name, refine=sweep.refinable(name)), ((PAPER, name),)) for name in some]
    plan += extra
    return left_out + measure(sweep, extra, baseline, deadline, settings.minutes, within(progress, 1, 1))
