"""`snerg study`: measures the trade-off between quality, time and bytes of a field, a dataset or a baked scene, within a time limit."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from ..artifact import Result, kind_of
from ..errors import SnergError
from ..io.lock import writes_out
from ..progress import Progress, silent, within
from .benchmarks import add_benchmarks, benchmarks_of
from .inputs import begin, study_inputs
from .measure import measure, variants
from .packages import needs_package
from .pareto import StudyTarget
from .parts import elsewhere, no_parts, note_part, part_writer
from .plan import Part, StudySettings
from .prepare import prepare
from .results import study_results, summary_of, write_chosen, write_results

DEFAULT_SETTINGS, NO_TARGET = StudySettings(), StudyTarget()


@writes_out("a study")
def study(
    source: Path,
    out: Path,
    dataset: Path | None = None,
    settings: StudySettings = DEFAULT_SETTINGS,
    target: StudyTarget = NO_TARGET,
    progress: Progress = silent,
    benchmarks: Sequence[Path] = (),
) -> Result:
    """Measure configurations of a field, a dataset or a baked scene, the coarse ones first, and write study.json, study.csv, report.html,
    contact.png and plots to `out`.

    source: a field, a checkpoint, a dataset (fields of different lengths are trained first) or a baked scene (which is only stored and
    rendered with other settings). dataset: to measure on, where the source does not name it. A study in `out` is continued: no row is
    measured twice. target: the cheapest measured configuration that meets it is written to out/scene. benchmarks: files that web pages
    saved (their #benchmark), for the report; earlier ones stay in it.

    Raises SnergError on bad input, where the time limit allows no measurement, where earlier results belong to another study or
    cannot be read, and where no configuration meets the target (after the report is written); Cancelled when `progress` does.
    """
    check_packages()
    with no_parts(out):
        return _study(source, out, dataset, settings, target, progress, benchmarks)


def _study(
    source: Path,
    out: Path,
    dataset: Path | None,
    settings: StudySettings,
    target: StudyTarget,
    progress: Progress,
    benchmarks: Sequence[Path],
) -> Result:
    deadline = time.monotonic() + 60 * settings.minutes
    inputs = study_inputs(source, dataset, settings)
    begin(out, inputs.about)
    add_benchmarks(benchmarks, out)
    begun = 0.3 if inputs.opened is None else 0.02  # fraction of the progress until the first configuration
    sweep, plan, baseline = prepare(inputs, out, settings, within(progress, 0, begun))
    left_out = measure(sweep, plan, baseline, deadline, settings.minutes, within(progress, begun, 0.95))
    if settings.paper and sweep.subject.scene is None:
        left_out += variants(sweep, plan, baseline, deadline, settings, within(progress, 0.95, 0.95))
    inputs.about["notes"] += elsewhere(out)
    results = study_results(sweep, plan, baseline, inputs.about, left_out, benchmarks_of(out))
    write_results(results, out)
    result = summary_of(results, out)
    if target:
        result |= write_chosen(sweep, results, target, out, within(progress, 0.95, 1))
    if not left_out:
        shutil.rmtree(out / "work", ignore_errors=True)
    return result


def study_part(
    source: Path,
    out: Path,
    part: Part,
    dataset: Path | None = None,
    settings: StudySettings = DEFAULT_SETTINGS,
    progress: Progress = silent,
) -> Result:
    """Measure the configurations of one part of a study, and write their rows to `out`; `study` then writes the report of all.

    Several parts may be measured at the same time, in processes or on machines that share `out`. A part that is started again measures
    what has no row. source: a field, a checkpoint or a baked scene. Raises SnergError as `study` does, for a dataset, and when the same
    part or the whole study is being measured; Cancelled when `progress` does.
    """
    if kind_of(source) == "dataset":
        raise SnergError(f"{source} is a dataset, whose study trains fields first; train a field, and measure that in parts.")
    deadline = time.monotonic() + 60 * settings.minutes
    inputs = study_inputs(source, dataset, settings)
    with part_writer(out, part, lambda: begin(out, inputs.about)):
        sweep, plan, baseline = prepare(inputs, out, settings, within(progress, 0, 0.02), f"stored-{part.name}")
        share = part.share(plan)
        with_fields = any(step.config == baseline for step in share)
        left_out = measure(sweep, share, baseline, deadline, settings.minutes, within(progress, 0.02, 1), with_fields)
        note_part(out, part)
    measured = sum(step.config.key in sweep.rows for step in share)
    return {"out": str(out), "part": str(part), "configurations": measured, "left_out": len(left_out), "notes": inputs.about["notes"]}


def check_packages() -> None:
    """Raise SnergError where a package that the report needs is missing: before the measurements, not after them."""
    with needs_package("matplotlib", "A study's plots"):
        import matplotlib  # noqa: F401
    with needs_package("jinja2", "A study's reports"):
        import jinja2  # noqa: F401
