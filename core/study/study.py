"""`snerg study`: what accuracy costs, measured on a field, a dataset or a baked scene within a time that the user gives."""

from __future__ import annotations

import hashlib
import shutil
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
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
from ..training.provenance import background_of, options_of, trained
from ..training.validation import some_views
from .contact_sheet import contact_sheet, error_picture
from .evaluate import COLUMNS, held_out
from .machine import describe_machine
from .paper_tables import BAKED, PAPER, VARIANTS
from .pareto import Target, choose
from .plan import Config, Step, StudySettings, available, steps
from .plots import needs_matplotlib
from .report import Findings, html, write_plots
from .summary import accuracy, csv_of
from .sweep import Subject, Sweep, field_key

VERSION = 1
USUAL, ANY = StudySettings(), Target()
TRAINING_SHARE = 0.25  # of a dataset's study goes into its longest training
TRAININGS = (0.25, 0.5, 1.0)  # of that, the lengths that are tried, where the study is so long (minutes) that set-up is little of it:
LONG = 5.0
HOLDOUT = 8
SHOWN = 5  # configurations on the sheet of pictures


@writes_out("a study")
def study(
    source: Path,
    out: Path,
    dataset: Path | None = None,
    settings: StudySettings = USUAL,
    target: Target = ANY,
    progress: Progress = silent,
) -> Result:
    """Sweep what trades accuracy for time and bytes, coarse first, and write study.json, study.csv, report.html and plots to `out`.

    source: a field, a checkpoint, a dataset (fields of some lengths are trained first) or a baked scene (which is only stored and
    marched otherwise). dataset: what to measure on, where the source does not say. Started again with the same `out` it goes on and
    repeats nothing. target: the cheapest measured configuration that has it is written to out/scene.

    Raises SnergError on bad input, where nothing could be measured in the time, where earlier results are another study's or
    cannot be read, and where no configuration has the target (the report is written all the same); Cancelled when `progress` does.
    """
    with needs_matplotlib():  # now, and not when all is measured
        import matplotlib  # noqa: F401
    deadline = time.monotonic() + 60 * settings.minutes
    kind = kind_of(source)
    notes: list[str] = []
    opened = open_field(source) if kind in ("field", "checkpoint") else open_scene(source) if kind != "dataset" else None
    views, training = _views(source, opened, dataset, settings, notes)
    about = {
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
    begin(out, about)
    begun = 0.3 if kind == "dataset" else 0.02
    subject, usual = _subject(source, opened, views, training, out, settings, within(progress, 0, begun))
    sweep = Sweep(subject, out)
    usual = replace(usual, refine=usual.refine and sweep.refinable(usual.field))
    plan = _plan(sweep, usual, subject)
    left_out = measure(sweep, plan, usual, deadline, settings.minutes, within(progress, begun, 0.95))
    if settings.paper and subject.scene is None:
        left_out += variants(sweep, plan, usual, deadline, settings, within(progress, 0.95, 0.95))
    found = findings(sweep, plan, usual, about, left_out)
    write(found, out)
    result: Result = {"out": str(out), "report": str(out / "report.html"), "configurations": len(found.rows), "left_out": len(left_out)}
    result |= {"front": [row["key"] for row in found.front], "notes": notes}
    if target:
        result |= _chosen(sweep, found, target, out, within(progress, 0.95, 1))
    if not left_out:
        shutil.rmtree(out / "work", ignore_errors=True)
    return result


def _known(opened: Field | Scene | None) -> dict[str, Any]:
    """What a field or a scene knows of its training, as `trained`."""
    if opened is None:
        return {}
    return trained(opened.about) if isinstance(opened, Field) else opened.about.get("trained", {})


def _views(
    source: Path, opened: Field | Scene | None, dataset: Path | None, settings: StudySettings, notes: list[str]
) -> tuple[Dataset, Dataset]:
    """The views to measure on, and the images to refine on; where none were held out, some are, and a note says so."""
    if opened is None:
        path, options = source, DatasetOptions(HOLDOUT)
    else:
        name = opened.dataset if isinstance(opened, Field) else ""
        if dataset is None and not name:
            raise SnergError(f"{source} does not say what it was trained on; give the dataset to measure it on with --dataset.")
        path, options = Path(dataset or name), options_of(_known(opened))
    try:
        views = held_out(path, options)
    except SnergError:
        if "train" not in read_dataset(path, "train", options).splits():
            raise
        options = replace(options, holdout=HOLDOUT)
        views = held_out(path, options)
        seen = "" if opened is None else " The field has seen them, so that its figures flatter it."
        notes.append(f"{path} holds no views out; every {HOLDOUT}th is held out here.{seen}")
    return some_views(views, settings.views), read_split(views, "train")


def digest(path: Path) -> str:
    """Of the bytes of a file, or of all files of a folder but the log of a training."""
    found = hashlib.sha256()
    for part in sorted(path.rglob("*")) if path.is_dir() else [path]:
        hidden = any(name.startswith(".") for name in part.relative_to(path).parts)  # our mark, and what kills left half-written
        if part.is_file() and not hidden and part.name != "log.jsonl":
            found.update(part.name.encode())
            with open(part, "rb") as file:
                found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()[:16]


def begin(out: Path, about: dict[str, Any]) -> None:
    """A folder to put rows in. Raises SnergError when it holds another study or other files, or an earlier study that cannot be read."""
    check_replaceable(out.absolute())
    old = out / "about.json"
    if old.exists():
        known = read_json(old)
        if not isinstance(known, dict) or known.get("version") != VERSION:
            raise SnergError(f"{old} is no study's that this version reads; choose another folder, or delete this one.")
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
) -> tuple[Subject, Config]:
    """What is studied, and the usual configuration of it."""
    box = Box.read(settings.box) if settings.box is not None else None
    baked, behind = BakeSettings(resolution=settings.resolution, seed=settings.seed), background_of(_known(opened))
    if isinstance(opened, Scene):
        usual = Config(replace(baked, resolution=max(opened.shape)), refine=False)
        return Subject({}, opened, views, None, box, behind, settings.repeats), usual
    fields = {"": source} if opened is not None else _trained(source, settings, out, progress)
    return Subject(fields, None, views, training, box, behind, settings.repeats), Config(baked, field=list(fields)[-1])


def _trained(source: Path, settings: StudySettings, out: Path, progress: Progress) -> dict[str, Path]:
    """Fields of some lengths of training by name, the shortest first; those that are there are not trained again."""
    from ..training.trainer import train

    views, folder, fields = read_dataset(source, "train", DatasetOptions(HOLDOUT)), out / "fields", {}
    longest, shares = 60 * settings.minutes * TRAINING_SHARE, TRAININGS if settings.minutes >= LONG else TRAININGS[-1:]
    for turn, share in enumerate(shares):
        seconds = max(round(share * longest), 5)
        name = f"{seconds} s of training"
        fields[name] = folder / str(seconds)
        if not _done(fields[name], seconds):
            part = within(progress, turn / len(shares), (turn + 1) / len(shares))
            told = replace(PRESETS["fast"], seconds=float(seconds), seed=settings.seed)
            train(views, told, fields[name], part, is_field(fields[name]))
    return fields


def _done(folder: Path, seconds: float) -> bool:
    """Whether a field was trained for so long."""
    return is_field(folder) and open_field(folder).about.get("seconds", 0) >= seconds


def _plan(sweep: Sweep, usual: Config, subject: Subject) -> list[Step]:
    codecs = available([name for name in SUFFIXES if name != "png"])
    if subject.scene is not None:
        plan = steps(usual, subject.scene.network is not None, False, False, codecs)
        return [step for step in plan if step.config.baked == usual.baked and not step.config.refine]
    field = sweep.field(usual.field)
    others = [name for name in subject.fields if name != usual.field]
    return steps(usual, field.network is not None, bool(field.cameras), usual.refine, codecs, others)


def measure(sweep: Sweep, plan: Sequence[Step], usual: Config, deadline: float, minutes: float, progress: Progress) -> list[str]:
    """Measure what is not measured yet, until the time is up; returns what was left out, for people.

    A configuration that would not end in time is passed over for quicker ones. Raises SnergError where the time is too short for one.
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
        if step.config == usual:
            fields(sweep, deadline, within(progress, (index + 1) / len(plan), (index + 1) / len(plan)))
    return left_out + fields(sweep, deadline, within(progress, 1, 1))


def _named(progress: Progress, step: Step) -> Progress:
    """Progress that says which configuration it is about."""
    what = "; ".join(f"{knob}: {value}" for knob, value in step.knobs[:2])
    return lambda fraction, message: progress(fraction, f"{what}: {message}")


def fields(sweep: Sweep, deadline: float, progress: Progress) -> list[str]:
    """Measure the fields themselves where there is time for it; returns what was left out."""
    left_out = []
    for name in sweep.subject.fields:
        if field_key(name) in sweep.rows:
            continue
        if sweep.field_seconds(name) > deadline - time.monotonic():
            left_out.append(f"the field itself ({name})" if name else "the field itself")
        else:
            sweep.field_row(name, progress)
    return left_out


def variants(sweep: Sweep, plan: list[Step], usual: Config, deadline: float, settings: StudySettings, progress: Progress) -> list[str]:
    """Train the fields of the paper's tables, each as long as the usual one, where there is time for it, and measure them and what is
    baked of them; their steps are added to the plan. Returns what was left out."""
    from ..training.trainer import train

    subject, left_out = sweep.subject, []
    about = sweep.field(usual.field).about
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
            told = replace(PRESETS["fast"], seconds=float(seconds), seed=settings.seed, background=background, **changes)
            train(subject.training, told, folder, part, is_field(folder))
        subject.fields[name] = folder
    some = [name for name in BAKED if name in subject.fields]
    extra = [Step(replace(usual, field=name, refine=sweep.refinable(name)), ((PAPER, name),)) for name in some]
    plan += extra
    return left_out + measure(sweep, extra, usual, deadline, settings.minutes, within(progress, 1, 1))


def findings(sweep: Sweep, plan: Sequence[Step], usual: Config, about: dict[str, Any], left_out: list[str]) -> Findings:
    """What the rows tell; where the usual configuration is not measured, the best one takes its place."""
    rows = {step.config.key: sweep.rows[step.config.key] for step in plan if step.config.key in sweep.rows}
    if not rows:
        raise SnergError("No configuration was measured, so that there is nothing to report; give more minutes.")
    alone = sorted((row for row in sweep.rows.values() if row["config"] is None), key=lambda row: row.get("trained_seconds") or 0)
    taken = rows.get(usual.key) or max(rows.values(), key=lambda row: row["psnr"])
    title = f"What accuracy costs: {Path(about['path']).name}"
    return Findings(title, about, rows, alone, plan, left_out, taken)


def write(found: Findings, out: Path) -> None:
    """study.json, study.csv, the plots and the report, each whole or not at all."""
    (out / "plots").mkdir(exist_ok=True)
    plots = write_plots(found, out / "plots")
    rows = [*found.fields, *found.rows.values()]
    told = accuracy(found.predictions)
    value = {**found.about, "usual": found.usual["key"], "left_out": found.left_out, "rows": rows}
    value["front"] = [row["key"] for row in found.front]
    value["predictions_within_a_quarter"] = {name: list(pair) for name, pair in told.items()}
    write_bytes(out / "study.json", json_bytes(value))
    write_bytes(out / "study.csv", csv_of(rows, found.plan).encode())
    write_png(out / "contact.png", beside_the_truth(found, out / "pictures"))
    write_bytes(out / "report.html", html(found, plots, out / "pictures").encode())


def beside_the_truth(found: Findings, pictures: Path) -> NDArray[Any]:
    """uint8 [H, W, 3]: one view of some configurations of the front, from the best on, beside the truth."""
    truth = read_image(pictures / "truth.png")[..., :3].astype(np.float32) / 255
    marked = sorted(found.front, key=lambda row: -row["psnr"])
    some = [marked[index] for index in np.unique(np.linspace(0, len(marked) - 1, SHOWN).round().astype(int))]
    rows = []
    for row in some:
        picture = read_image(pictures / f"{row['key']}.png")[..., :3].astype(np.float32) / 255
        name = f"{row['psnr']:.2f} dB, {row['ms']:.0f} ms, {row['megabytes']:.1f} MB"
        rows.append((name, [truth, picture, error_picture(truth, picture)]))
    return contact_sheet(rows, COLUMNS, 480)


def _chosen(sweep: Sweep, found: Findings, target: Target, out: Path, progress: Progress) -> Result:
    """Write the scene of the row that has the target. Raises SnergError where none has."""
    row, closest = choose(list(found.rows.values()), target)
    if row is None:
        assert closest is not None  # there are rows
        told = f"{closest['psnr']:.2f} dB, {closest['megabytes']:.1f} MB and {closest['ms']:.0f} ms a frame"
        where = f"({closest['key']} in {out / 'study.csv'})"
        raise SnergError(f"No configuration that was measured has {target.text()}. The closest has {told} {where}.")
    config = Config.from_json(row["config"])
    snerg, _ = sweep.scene_of(config, progress)
    write_scene(snerg, out / "scene", codec=config.codec)
    return {"chosen": row["key"], "scene": str(out / "scene"), "psnr": row["psnr"], "ms": row["ms"], "megabytes": row["megabytes"]}
