"""`snerg study`: measures the trade-off between quality, time and bytes of a field, a dataset or a baked scene, within a time limit."""

from __future__ import annotations

import hashlib
import shutil
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifact import Result, kind_of, open_field, open_scene
from ..baking.bake import BakeSettings
from ..data.dataset import Dataset, DatasetOptions
from ..data.load import read_dataset, read_split
from ..errors import SnergError
from ..export.codecs import SUFFIXES
from ..export.scene_files import write_scene
from ..geometry.box import Box
from ..io.files import MARK, check_replaceable, json_bytes, read_json, write_bytes
from ..io.images import read_image, write_png
from ..io.lock import writes_out
from ..nerf.checkpoint import is_field
from ..nerf.field import Field
from ..progress import Progress, silent, within
from ..scene.scene import Scene
from ..training.config import PRESETS
from ..training.provenance import background_of, options_of
from ..training.validation import some_views
from .contact_sheet import contact_sheet, error_picture
from .evaluate import COLUMNS, held_out, provenance_of
from .machine import describe_machine
from .packages import needs_package
from .paper_tables import BAKED, PAPER, VARIANTS
from .pareto import StudyTarget, choose
from .parts import elsewhere, no_parts, note_part, part_writer
from .plan import Configuration, Part, PlanStep, StudySettings, available, plan_steps
from .report import StudyResults, html, write_plots
from .summary import accuracy, csv_of
from .sweep import StudySubject, Sweep, field_key

VERSION = 1
DEFAULT_SETTINGS, NO_TARGET = StudySettings(), StudyTarget()
TRAINING_SHARE = 0.25  # of the time limit of a dataset's study, for its longest training
TRAININGS = (0.25, 0.5, 1.0)  # lengths of trainings over that of the longest
LONG_MINUTES = 5.0  # time limit from which all are trained; in shorter ones set-up would take most of the short trainings
HOLDOUT = 8  # every 8th view is held out where the dataset holds none out, as in LLFF (Mildenhall et al. 2019)
SHEET_ROWS = 5  # configurations on the contact sheet


@writes_out("a study")
def study(
    source: Path,
    out: Path,
    dataset: Path | None = None,
    settings: StudySettings = DEFAULT_SETTINGS,
    target: StudyTarget = NO_TARGET,
    progress: Progress = silent,
) -> Result:
    """Measure configurations of a field, a dataset or a baked scene, the coarse ones first, and write study.json, study.csv, report.html,
    contact.png and plots to `out`.

    source: a field, a checkpoint, a dataset (fields of different lengths are trained first) or a baked scene (which is only stored and
    rendered with other settings). dataset: to measure on, where the source does not name it. A study in `out` is continued: no row is
    measured twice. target: the cheapest measured configuration that meets it is written to out/scene.

    Raises SnergError on bad input, where the time limit allows no measurement, where earlier results belong to another study or
    cannot be read, and where no configuration meets the target (after the report is written); Cancelled when `progress` does.
    """
    check_packages()
    with no_parts(out):
        return _study(source, out, dataset, settings, target, progress)


def _study(source: Path, out: Path, dataset: Path | None, settings: StudySettings, target: StudyTarget, progress: Progress) -> Result:
    deadline = time.monotonic() + 60 * settings.minutes
    inputs = _inputs(source, dataset, settings)
    begin(out, inputs.about)
    begun = 0.3 if inputs.opened is None else 0.02  # fraction of the progress until the first configuration
    sweep, plan, baseline = _sweep(inputs, out, settings, within(progress, 0, begun))
    left_out = measure(sweep, plan, baseline, deadline, settings.minutes, within(progress, begun, 0.95))
    if settings.paper and sweep.subject.scene is None:
        left_out += variants(sweep, plan, baseline, deadline, settings, within(progress, 0.95, 0.95))
    inputs.about["notes"] += elsewhere(out)
    results = study_results(sweep, plan, baseline, inputs.about, left_out)
    write_results(results, out)
    result = _result(results, out)
    if target:
        result |= _chosen(sweep, results, target, out, within(progress, 0.95, 1))
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
    inputs = _inputs(source, dataset, settings)
    with part_writer(out, part, lambda: begin(out, inputs.about)):
        sweep, plan, baseline = _sweep(inputs, out, settings, within(progress, 0, 0.02), f"stored-{part.name}")
        share = part.share(plan)
        with_fields = any(step.config == baseline for step in share)
        left_out = measure(sweep, share, baseline, deadline, settings.minutes, within(progress, 0.02, 1), with_fields)
        note_part(out, part)
    measured = sum(step.config.key in sweep.rows for step in share)
    return {"out": str(out), "part": str(part), "configurations": measured, "left_out": len(left_out), "notes": inputs.about["notes"]}


@dataclass(frozen=True)
class _Inputs:
    """What a study reads: its source, opened (None for a dataset), views to measure on, training images, and the value of about.json."""

    source: Path
    opened: Field | Scene | None
    views: Dataset
    training: Dataset
    about: dict[str, Any]


def _inputs(source: Path, dataset: Path | None, settings: StudySettings) -> _Inputs:
    kind = kind_of(source)
    notes: list[str] = []
    opened = open_field(source) if kind in ("field", "checkpoint") else open_scene(source) if kind != "dataset" else None
    views, training = _views(source, opened, dataset, settings, notes)
    return _Inputs(source, opened, views, training, _about(source, kind, views, settings, notes))


def _sweep(
    inputs: _Inputs, out: Path, settings: StudySettings, progress: Progress, stored: str = "stored"
) -> tuple[Sweep, list[PlanStep], Configuration]:
    """The sweep, the plan and the baseline of a study. stored: see Sweep."""
    subject, baseline = _subject(inputs.source, inputs.opened, inputs.views, inputs.training, out, settings, progress)
    sweep = Sweep(subject, out, stored)
    baseline = replace(baseline, refine=baseline.refine and sweep.refinable(baseline.field))
    return sweep, _plan(sweep, baseline, subject), baseline


def _result(results: StudyResults, out: Path) -> Result:
    """What `study` returns of its results."""
    counts = {"configurations": len(results.rows), "left_out": len(results.left_out)}
    front = [row["key"] for row in results.pareto_front]
    return {"out": str(out), "report": str(out / "report.html"), **counts, "front": front, "notes": results.about["notes"]}


def check_packages() -> None:
    """Raise SnergError where a package that the report needs is missing: before the measurements, not after them."""
    with needs_package("matplotlib", "A study's plots"):
        import matplotlib  # noqa: F401
    with needs_package("jinja2", "A study's reports"):
        import jinja2  # noqa: F401


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


def _subject(
    source: Path, opened: Field | Scene | None, views: Dataset, training: Dataset, out: Path, settings: StudySettings, progress: Progress
) -> tuple[StudySubject, Configuration]:
    """The subject of the study, and its baseline."""
    box = Box.read(settings.box) if settings.box is not None else None
    baked, behind = (
        BakeSettings(resolution=settings.resolution, seed=settings.seed),
        background_of({} if opened is None else provenance_of(opened)),
    )
    if isinstance(opened, Scene):
        baseline = Configuration(replace(baked, resolution=max(opened.shape)), refine=False)
        return StudySubject({}, opened, views, None, box, behind, settings.repeats), baseline
    fields = {"": source} if opened is not None else _trained(source, settings, out, progress)
    return StudySubject(fields, None, views, training, box, behind, settings.repeats), Configuration(baked, field=list(fields)[-1])


def _trained(source: Path, settings: StudySettings, out: Path, progress: Progress) -> dict[str, Path]:
    """Train fields of different lengths of training, the shortest first: {name: folder}. Fields of an earlier run are kept."""
    from ..training.trainer import train

    views, folder, fields = read_dataset(source, "train", DatasetOptions(HOLDOUT)), out / "fields", {}
    longest, shares = 60 * settings.minutes * TRAINING_SHARE, TRAININGS if settings.minutes >= LONG_MINUTES else TRAININGS[-1:]
    for turn, share in enumerate(shares):
        seconds = max(round(share * longest), 5)
        name = f"{seconds} s of training"
        fields[name] = folder / str(seconds)
        if not _done(fields[name], seconds):
            part = within(progress, turn / len(shares), (turn + 1) / len(shares))
            training = replace(PRESETS["fast"], seconds=float(seconds), seed=settings.seed)
            train(views, training, fields[name], part, is_field(fields[name]))
    return fields


def _done(folder: Path, seconds: float) -> bool:
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
                    f"The coarsest configuration takes about {needed:.0f} seconds, and of the {minutes:g} minutes {max(left, 0):.0f} s "
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
        if not _done(folder, seconds):
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


def study_results(
    sweep: Sweep, plan: Sequence[PlanStep], baseline: Configuration, about: dict[str, Any], left_out: list[str]
) -> StudyResults:
    """The results of all rows; the best row takes the place of a baseline that is not measured. Raises SnergError without rows."""
    rows = {step.config.key: sweep.rows[step.config.key] for step in plan if step.config.key in sweep.rows}
    if not rows:
        raise SnergError("No configuration was measured, so that there is nothing to report; give more minutes.")
    alone = sorted((row for row in sweep.rows.values() if row["config"] is None), key=lambda row: row.get("trained_seconds") or 0)
    taken = rows.get(baseline.key) or max(rows.values(), key=lambda row: row["psnr"])
    title = f"What accuracy costs: {Path(about['path']).name}"
    return StudyResults(title, about, rows, alone, plan, left_out, taken)


def write_results(results: StudyResults, out: Path) -> None:
    """Write study.json, study.csv, the plots, the contact sheet and the report, each whole or not at all."""
    (out / "plots").mkdir(exist_ok=True)
    plots = write_plots(results, out / "plots")
    rows = [*results.fields, *results.rows.values()]
    value = {**results.about, "usual": results.baseline["key"], "left_out": results.left_out, "rows": rows}
    value["front"] = [row["key"] for row in results.pareto_front]
    value["predictions_within_a_quarter"] = {name: list(pair) for name, pair in accuracy(results.predictions).items()}
    write_bytes(out / "study.json", json_bytes(value))
    write_bytes(out / "study.csv", csv_of(rows, results.plan).encode())
    write_png(out / "contact.png", results_sheet(results, out / "pictures"))
    write_bytes(out / "report.html", html(results, plots, out / "pictures").encode())


def results_sheet(results: StudyResults, pictures: Path) -> NDArray[Any]:
    """One view of up to SHEET_ROWS rows of the Pareto front, the best first, beside the true image: uint8 [H, W, 3]."""
    truth = read_image(pictures / "truth.png")[..., :3].astype(np.float32) / 255
    front = sorted(results.pareto_front, key=lambda row: -row["psnr"])
    some = [front[index] for index in np.unique(np.linspace(0, len(front) - 1, SHEET_ROWS).round().astype(int))]
    rows = []
    for row in some:
        picture = read_image(pictures / f"{row['key']}.png")[..., :3].astype(np.float32) / 255
        name = f"{row['psnr']:.2f} dB, {row['ms']:.0f} ms, {row['megabytes']:.1f} MB"
        rows.append((name, [truth, picture, error_picture(truth, picture)]))
    return contact_sheet(rows, COLUMNS, 480)


def _chosen(sweep: Sweep, results: StudyResults, target: StudyTarget, out: Path, progress: Progress) -> Result:
    """Write the scene of the row that meets the target. Raises SnergError where none does."""
    row, closest = choose(list(results.rows.values()), target)
    if row is None:
        assert closest is not None  # because there are rows
        reached = f"{closest['psnr']:.2f} dB, {closest['megabytes']:.1f} MB and {closest['ms']:.0f} ms a frame"
        where = f"({closest['key']} in {out / 'study.csv'})"
        raise SnergError(f"No configuration that was measured has {target.text()}. The closest has {reached} {where}.")
    config = Configuration.from_json(row["config"])
    scene, _ = sweep.scene_of(config, progress)
    write_scene(scene, out / "scene", codec=config.codec)
    return {"chosen": row["key"], "scene": str(out / "scene"), "psnr": row["psnr"], "ms": row["ms"], "megabytes": row["megabytes"]}
