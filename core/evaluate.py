"""How good a field or a baked scene is, measured on photographs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .capture.camera import Camera
from .capture.dataset import read_dataset
from .capture.images import over_white
from .describe import any_field, any_scene, kind_of
from .errors import SnergError, needs_jax
from .grid.march import Frame, MarchSettings, march, tables_of
from .progress import Progress, silent, within
from .study.metrics import mean_psnr, mse, ssim

Result = dict[str, Any]
WHITE = (1.0, 1.0, 1.0)


def evaluate(target: Path, dataset: Path, split: str = "test", progress: Progress = silent) -> Result:
    """Quality of a field or a scene on a dataset's split, over white: PSNR of the mean error, mean SSIM, seconds a view.

    PSNR is None when every pixel agrees. Raises SnergError when `target` is neither, or the dataset is unusable.
    """
    views = read_dataset(dataset, split)
    kind, render = renderer_of(target)
    score = Score()
    count = len(views.views)
    for index, camera in enumerate(views.cameras):
        began = time.perf_counter()
        frame = render(camera, within(progress, index / count, (index + 1) / count))
        score.add(frame.over(WHITE), over_white(views.read(index)), time.perf_counter() - began)
        progress((index + 1) / count, f"View {index + 1} of {count}: {score.text()}")
    return {"kind": kind, "target": str(target), "dataset": str(dataset), "split": split, **score.result()}


class Score:
    """Errors of the views seen so far."""

    def __init__(self) -> None:
        self.errors: list[float] = []
        self.likeness: list[float] = []
        self.seconds: list[float] = []

    def add(self, picture: np.ndarray, truth: np.ndarray, seconds: float = 0.0) -> None:
        """A view [H, W, 3] and what it should be."""
        self.errors.append(mse(picture, truth))
        self.likeness.append(ssim(picture, truth))
        self.seconds.append(seconds)

    def result(self) -> Result:
        """{"psnr", "ssim", "seconds_per_view", "views"}; psnr is None where it is infinite (hard case 30)."""
        decibels = mean_psnr(self.errors)
        return {
            "psnr": round(decibels, 4) if math.isfinite(decibels) else None,
            "ssim": round(float(np.mean(self.likeness)), 5),
            "seconds_per_view": round(float(np.mean(self.seconds)), 4),
            "views": len(self.errors),
        }

    def text(self) -> str:
        """For a progress line."""
        decibels = mean_psnr(self.errors)
        return f"{decibels:.2f} dB" if math.isfinite(decibels) else "identical"


def renderer_of(target: Path) -> tuple[str, Callable[[Camera, Progress], Frame]]:
    """("field" or "scene", a function from a camera to its picture). Raises SnergError when `target` is neither."""
    kind = kind_of(target)
    if kind in ("field", "checkpoint"):
        with needs_jax():
            import jax  # noqa: F401  # evaluating a field compiles it

            from .field.render import render_field
        field = any_field(target)
        return "field", lambda camera, progress: render_field(field, camera, progress)
    if kind in ("scene", "reference scene", "page"):
        snerg = any_scene(target)
        tables_of(snerg)  # once a scene, not a view
        return "scene", lambda camera, progress: march(snerg, camera, MarchSettings(), progress)
    raise SnergError(f"{target} is a {kind}; give a field or a baked scene.")
