"""The quality of a field or a baked scene, measured on held-out views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifact import Result, kind_of, open_field, open_scene
from ..data.dataset import Dataset, DatasetOptions
from ..data.load import read_dataset, read_split
from ..errors import SnergError, needs_jax
from ..geometry.camera import Camera
from ..io.files import check_replaceable, new_folder
from ..io.images import over, png_bytes, to_uint8
from ..io.json_files import json_bytes
from ..io.lock import writes_out
from ..nerf.field import Field
from ..nerf.frame import Frame
from ..progress import Progress, silent, within
from ..rendering.acceleration import acceleration_of
from ..rendering.render import MarchSettings, render_scene
from ..scene.scene import Scene
from ..training.provenance import background_of, options_of, trained
from .contact_sheet import contact_sheet, error_picture
from .metrics import flip, mean_psnr, mse, pooled_psnr, psnr_of, ssim

SHEET_VIEWS = 12  # views on the contact sheet, at most; each view has a file of its own
SHEET_PIXELS = 480  # width of an image on the contact sheet, at most
DEFAULT_MARCH = MarchSettings()
COLUMNS = ("truth", "rendered", "error x 10")


@writes_out("an evaluation")
def evaluate(
    target: Path,
    dataset: Path | None = None,
    split: str | None = None,
    holdout: int | None = None,
    downscale: int | None = None,
    out: Path | None = None,
    progress: Progress = silent,
    settings: MarchSettings = DEFAULT_MARCH,
) -> Result:
    """Measure a field or a scene on views of a dataset: mean PSNR of the views, PSNR of their pooled error, mean SSIM, seconds a view.

    dataset: that of the field's training when None. split: 'test' where there is one, else 'val', when None. holdout, downscale: as in
    training when None. out: a folder for each rendered view, views.json and a contact sheet beside the truth. settings: of a scene's
    march. Images are composited over the background of the training; pixels that a mask of the dataset hides do not count.

    Returns the names of what was measured and `Score.result`. Raises SnergError when `target` is neither a field nor a scene, when the
    dataset cannot be read, and for settings of the march with a field.
    """
    subject = open_target(target, settings)
    if dataset is None and not subject.dataset:
        raise SnergError(f"{target} does not say what it was trained on; give the dataset to measure it on.")
    source = Path(dataset or subject.dataset)
    if out is not None:
        check_replaceable(out.absolute())
    options = DatasetOptions(
        subject.options.holdout if holdout is None else holdout, subject.options.downscale if downscale is None else downscale
    )
    views = read_dataset(source, split, options) if split else held_out(source, options)
    found = measure_into(subject, views, out, progress)
    where = {"out": str(out)} if out is not None else {}
    measured = {"split": views.split, "holdout": options.holdout, "downscale": options.downscale}
    return {"kind": subject.kind, "target": str(target), "dataset": str(source), **measured, **found, **where}


def measure_into(subject: EvaluationTarget, views: Dataset, out: Path | None, progress: Progress) -> Result:
    """Measure a target on all views of a dataset, and return `Score.result`. out: as for `evaluate`."""
    score = Score()
    if out is None:
        _measure(subject, views, score, None, progress)
    else:
        with new_folder(out) as folder:
            sheet = _measure(subject, views, score, folder, progress)
            (folder / "contact.png").write_bytes(png_bytes(sheet))
            (folder / "views.json").write_bytes(json_bytes(score.views()))
    return score.result()


def held_out(path: Path, options: DatasetOptions) -> Dataset:
    """The held-out views of a dataset: the 'test' split, else 'val'. Raises SnergError where there is neither."""
    train = read_dataset(path, "train", options)
    for split in ("test", "val"):
        if split in train.splits():
            return read_split(train, split)
    raise SnergError(f"{path} has no views that training did not see; hold some out, or measure on --split train.")


@dataclass(frozen=True)
class EvaluationTarget:
    """A field or a scene to measure."""

    kind: str  # 'field' or 'scene'
    render: Callable[[Camera, Progress], Frame]
    background: tuple[float, float, float]  # of the training, RGB in [0, 1]
    dataset: str  # folder that the field was trained on, '' where it is not known
    options: DatasetOptions  # with which the training read it


def open_target(path: Path, settings: MarchSettings = DEFAULT_MARCH) -> EvaluationTarget:
    """Read a field, a checkpoint or a scene. Raises SnergError for other paths, and for settings of the march with a field."""
    kind = kind_of(path)
    if kind in ("field", "checkpoint"):
        if settings != DEFAULT_MARCH:
            raise SnergError(f"{path} is a {kind}, which is not marched; bake it first to measure with such settings of the march.")
        with needs_jax():
            import jax  # noqa: F401  # evaluating a field compiles it
        return target_of(open_field(path))
    if kind in ("scene", "reference scene", "page"):
        return target_of(ready_scene(path, settings), settings)
    raise SnergError(f"{path} is a {kind}; give a field or a baked scene.")


def target_of(source: Field | Scene, settings: MarchSettings = DEFAULT_MARCH) -> EvaluationTarget:
    """A field or a scene to measure. settings: of a scene's march. Raises SnergError where a field is to be rendered without JAX."""
    known = provenance_of(source)
    if isinstance(source, Scene):
        render, dataset = partial(_march, source, settings), ""
    else:
        with needs_jax():
            from ..nerf.render import render_field
        render, dataset = partial(render_field, source), source.dataset
    kind = "scene" if isinstance(source, Scene) else "field"
    return EvaluationTarget(kind, render, background_of(known), dataset, options_of(known))


def provenance_of(source: Field | Scene) -> dict[str, Any]:
    """What a field, or a scene baked from it, keeps of its training (see training.provenance)."""
    return dict(source.about.get("trained", {})) if isinstance(source, Scene) else trained(source.about)


def _march(scene: Scene, settings: MarchSettings, camera: Camera, progress: Progress) -> Frame:
    return render_scene(scene, camera, settings, progress)


def ready_scene(path: Path, settings: MarchSettings) -> Scene:
    """Read a scene and build its acceleration structure, once for all views. Raises SnergError where `path` is not a scene, and for
    per-sample settings of a diffuse one."""
    scene = open_scene(path)
    if settings.per_sample_network and scene.network is None:
        raise SnergError(f"{path} is diffuse: it has no network to run at every sample; leave out --per-sample-network.")
    acceleration_of(scene)
    return scene


def _measure(subject: EvaluationTarget, views: Dataset, score: Score, folder: Path | None, progress: Progress) -> NDArray[Any]:
    """Render and score every view, and write each to the folder, if given. Returns the contact sheet uint8 [H, W, 3]."""
    count, rows = len(views.views), []
    shown = set(np.linspace(0, count - 1, min(count, SHEET_VIEWS)).round().astype(int).tolist())
    for index, camera in enumerate(views.cameras):
        began = time.perf_counter()
        frame = subject.render(camera, within(progress, index / count, (index + 1) / count))
        seconds = time.perf_counter() - began
        picture, truth = frame.over(subject.background), over(views.read(index), subject.background)
        score.add(picture, truth, seconds, views.mask(index), camera.name)
        if folder is not None:
            (folder / f"{index:03d}.png").write_bytes(png_bytes(to_uint8(picture)))
            if index in shown:
                rows.append((f"{index:03d} {camera.name}  {score.last()}", [truth, picture, error_picture(truth, picture)]))
        progress((index + 1) / count, f"View {index + 1} of {count}: {score.text()}")
    return contact_sheet(rows, COLUMNS, SHEET_PIXELS) if rows else np.zeros((1, 1, 3), np.uint8)


class Score:
    """The errors of the views that were added."""

    def __init__(self) -> None:
        self.errors: list[float] = []
        self.likeness: list[float] = []
        self.flips: list[float] = []  # empty where FLIP is not installed
        self.seconds: list[float] = []
        self.names: list[str] = []

    def add(
        self, picture: NDArray[Any], truth: NDArray[Any], seconds: float = 0.0, mask: NDArray[Any] | None = None, name: str = ""
    ) -> None:
        """Add a rendered view [H, W, 3] and its true image [H, W, 3], in [0, 1]. mask: [H, W] bool, the pixels that count."""
        self.errors.append(mse(picture, truth, mask))
        self.likeness.append(ssim(picture, truth, mask))
        if (difference := flip(picture, truth, mask)) is not None:
            self.flips.append(difference)
        self.seconds.append(seconds)
        self.names.append(name)

    def result(self) -> Result:
        """{"psnr", "psnr_pooled", "ssim", "seconds_per_view", "views"}, and "flip" where it is installed.

        psnr is the mean of the views' decibels, psnr_pooled that of the mean of their squared errors; both are None where they are
        infinite (hard case 30).
        """
        return {
            "psnr": _finite(mean_psnr(self.errors)),
            "psnr_pooled": _finite(pooled_psnr(self.errors)),
            "ssim": round(float(np.mean(self.likeness)), 5),
            **({"flip": round(float(np.mean(self.flips)), 5)} if self.flips else {}),
            "seconds_per_view": round(float(np.mean(self.seconds)), 4),
            "views": len(self.errors),
        }

    def views(self) -> list[Result]:
        """{"name", "psnr", "ssim"} of each view."""
        rows = zip(self.names, self.errors, self.likeness, strict=True)
        return [{"name": n, "psnr": round(psnr_of(e), 3) if e else None, "ssim": round(s, 5)} for n, e, s in rows]

    def text(self) -> str:
        """Mean PSNR of all views in words, for a line of progress."""
        return _decibels(mean_psnr(self.errors))

    def last(self) -> str:
        """PSNR and SSIM of the view that was added last, in words."""
        return f"{_decibels(mean_psnr(self.errors[-1:]))}, SSIM {self.likeness[-1]:.3f}"


def _finite(decibels: float) -> float | None:
    return round(decibels, 4) if math.isfinite(decibels) else None


def _decibels(value: float) -> str:
    return f"{value:.2f} dB" if math.isfinite(value) else "identical"
