"""Saves a training while it runs: the field, the state from which it can be resumed, and the log. Needs JAX."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ..io.files import SAVING
from ..nerf.checkpoint import write_field
from ..nerf.field import Field
from ..nerf.model import ViewNetwork, init_field
from .log import Log
from .prepare import Prepared
from .state import TrainState

SAVE_SHARE = 0.02  # of the time, at most, goes into saving
LOG_EVERY = 2.0  # seconds of training between two lines of the log
PREVIEW_SHARE = 0.04  # of the whole training's time, at most, goes into previews
PREVIEW_EVERY = 10.0  # seconds between two previews, at least
FIRST_PREVIEW = 2.0  # seconds that the first preview is taken to need; later ones are measured


@dataclass(frozen=True)
class TrainProgress:
    """The progress of a training after a step."""

    fraction: float  # of the whole training, in [0, 1]
    step: int
    loss: float  # running mean
    psnr: float  # dB, of the training rays, from a running mean
    seconds: float  # trained so far
    rays: int  # of the last step
    samples: int  # of the last step
    rate: float  # learning rate of the last step
    held_out: float | None = None  # mean PSNR in dB of views that are not trained on; None where none were scored yet

    def text(self) -> str:
        """The progress as one line of text."""
        held = "" if self.held_out is None else f", {self.held_out:.2f} dB on held-out views"
        return f"Step {self.step}: {self.psnr:.2f} dB on training rays{held}"


def trained_field(prepared: Prepared, state: TrainState, params: Any, held_out_psnr: float | None) -> Field:
    """The field of a training in its present state. params: the parameters to use (see `TrainState.best`).

    A diffuse field has no features.
    """
    settings, dataset = prepared.settings, prepared.dataset
    params = jax.tree.map(np.array, params)  # copies: the next step reuses the device's memory
    network = ViewNetwork(*params["view"]) if "view" in params and state.view != "diffuse" else None
    if settings.view_dependence == "auto" and state.view == "diffuse":
        shapes = init_field(settings.family, "diffuse", np.random.default_rng(0))["field"]
        params["field"] = jax.tree.map(lambda a, like: a[..., : like.shape[-1]], params["field"], shapes)
    return Field(
        family=settings.family,
        params=params["field"],
        network=network,
        domain=prepared.domain,
        occupancy=prepared.sampler.occupied,
        spacing=settings.spacing,
        cameras=dataset.cameras,
        dataset=str(dataset.root.resolve()),
        about={
            "settings": asdict(settings),
            "dataset_options": asdict(dataset.options),
            "decisions": [d.to_json() for d in state.decisions],
            "steps": state.step,
            "seconds": round(state.elapsed, 2),
            "psnr_training_rays": round(state.psnr, 3) if state.step else None,
            "psnr_held_out_rays": None if held_out_psnr is None else round(held_out_psnr, 3),
        },
        ndc=prepared.ndc,
        view=state.view,
    )


class Saver:
    """Logs a training every LOG_EVERY seconds and saves it every `save_every` seconds.

    It saves less often where saving would take more than SAVE_SHARE of the time.

    checkpoint: a function that returns the present field and the arrays from which training resumes. step, held_out_psnr: those of the
    training when it begins or is resumed. preview: called now and then with the field that was just saved, and the fraction done.
    Raises SnergError when the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        checkpoint: Callable[[], tuple[Field, dict[str, NDArray[Any]]]],
        save_every: float,
        step: int = 0,
        held_out_psnr: float | None = None,
        preview: Callable[[Field, float], None] | None = None,
    ) -> None:
        self._folder, self._checkpoint, self._save_every = folder, checkpoint, save_every
        self._preview, self._preview_cost = preview, FIRST_PREVIEW
        self._previewed: TrainProgress | None = None  # the progress at the last preview, or at the beginning
        self._log = Log(folder, step)
        self._saved_at, self._cost = time.perf_counter(), 0.0
        self._logged_at = -math.inf
        self._held_out_psnr = held_out_psnr

    def after(self, report: TrainProgress) -> None:
        """Log and save what is due after a step."""
        at = {"step": report.step, "seconds": round(report.seconds, 2)}
        if report.seconds - self._logged_at > LOG_EVERY or report.fraction >= 1:
            self._logged_at = report.seconds
            line = {"fraction": round(report.fraction, 5), "loss": report.loss, "psnr": round(report.psnr, 3), "rate": report.rate}
            self._log.add(**at, **line, samples=report.samples, rays=report.rays)
        if report.held_out is not None and report.held_out != self._held_out_psnr:
            self._held_out_psnr = report.held_out
            self._log.add(**at, held_out_psnr=round(report.held_out, 3))
        if time.perf_counter() - self._saved_at > max(self._save_every, self._cost / SAVE_SHARE):
            self.save()
        if self._preview is not None and self._preview_is_due(report):
            began = time.perf_counter()
            self._preview(self.save(), report.fraction)
            self._preview_cost, self._previewed = time.perf_counter() - began, report

    def _preview_is_due(self, report: TrainProgress) -> bool:
        """Whether there is time for a preview: of PREVIEW_SHARE of the whole training's time, the part sqrt(fraction) may be spent after
        a fraction of it, so that previews are frequent at first, when the field changes most."""
        if self._previewed is None:
            self._previewed = report
        last, allowed = self._previewed, PREVIEW_SHARE * report.seconds / max(report.fraction, 1e-6)
        earned = allowed * (math.sqrt(report.fraction) - math.sqrt(last.fraction))
        return report.fraction < 1 and report.seconds - last.seconds >= PREVIEW_EVERY and earned >= self._preview_cost

    def save(self) -> Field:
        """Replace the field on disk, whole or not at all, and return it; Ctrl-C waits until it is done."""
        began = time.perf_counter()
        with SAVING:
            field, state = self._checkpoint()
            write_field(field, self._folder, state)
        self._saved_at = time.perf_counter()
        self._cost = self._saved_at - began
        return field
