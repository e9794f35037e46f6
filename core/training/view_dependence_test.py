"""The view-dependence test: whether a scene needs a deferred field or a diffuse one, measured during training (needs JAX).

Training begins with a deferred field (section 4.2). After AT of the training, the error of rays of validation views is measured twice:
with the network's residual as it is, and with the residual averaged over the directions from which the training cameras see the same
point. The average is about the best that a diffuse field of the same geometry can show. Where view dependence gains more, the field stays
deferred. Where it does not, training goes on with a diffuse field on trial: the network also decodes composited features, which an
average over directions keeps, and a diffuse field may bend the geometry to imitate highlights. After TRIAL of the training the rays must
be shown at least as well as before it; otherwise training takes up the deferred field where it left it. Measured: on a still life with
gloss the network gained 0.06 dB over its average, but a diffuse field ended 0.9 dB lower after 5000 steps. On a matte scene a diffuse field
was 1 dB better. Training both from the start instead takes twice as long. Method of our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..nerf.field import Field
from ..nerf.render import integrate
from ..nerf.shading import ray_colour
from ..nerf.volume_rendering import mean_distance
from .config import TrainSettings
from .decisions import Decision
from .losses import mse_to_psnr
from .ray_dataset import RayDataset
from .validation import ValidationRays

AT = 0.3  # fraction of the training after which the test runs: the network has learned highlights by then
TRIAL = 0.1  # fraction of the training that a diffuse field has to show the rays as well as before
RECOVERY = 200  # steps in which the colours take over the average of what the network added; there is no trial where TRIAL is shorter
LEAST = 100  # steps before the test; after fewer the field is too rough to measure, and stays deferred
SILENT = -100.0  # the network's last bias where it is switched off: its residual is 1e-13 and its gradient exactly 0
VIEWS = 12  # views from which on some are kept as validation views; fewer are all needed for training
RAYS = 16384  # rays that the test measures
EYES = 24  # bound on the cameras over which the residual is averaged
GAIN = 0.05  # dB that view dependence must gain, in addition to twice the standard error
EFFECT = "View dependence"


@dataclass(frozen=True, eq=False)
class Trial:
    """A diffuse field on trial, from the test to `ends`, a fraction of the training."""

    ends: float
    rays: ValidationRays  # that judge it
    before: float  # their mean squared error with the deferred field
    found: Decision  # of the test
    checkpoint: tuple[Field, dict[str, NDArray[Any]]]  # the training before it, arrays of any shape; a save writes it

    def judged(self, after: float) -> Decision:
        """The decision, from the mean squared error of the same rays after the trial."""
        gain = mse_to_psnr(self.before) - mse_to_psnr(after)
        chosen, how = ("deferred", "worse") if gain > 0 else ("diffuse", "better")
        evidence = f"{self.found.evidence} After a trial without it these rays are shown {abs(gain):.2f} dB {how} than before."
        return replace(self.found, chosen=chosen, evidence=evidence, measured=gain, threshold=0.0)


def silenced(params: dict[str, Any]) -> dict[str, Any]:
    """The parameters with the view-dependence networks switched off: their residual and their gradient are 0."""
    changed = dict(params)
    if "view" in params:
        *rest, last = params["view"]
        changed["view"] = (*rest, jnp.full_like(last, SILENT))
    if "coarse" in params:
        changed["coarse"] = silenced(params["coarse"])
    return changed


def set_aside(views: int) -> NDArray[Any]:
    """The validation views, bool [views]: 2 to 4 of them, spread evenly; none where there are fewer than VIEWS."""
    aside = np.zeros(views, bool)
    if views >= VIEWS:
        count = min(max(views // 12, 2), 4)
        aside[np.linspace(0, views - 1, count + 2).round().astype(int)[1:-1]] = True
    return aside


def tested_rays(rays: RayDataset, validation_views: NDArray[Any], settings: TrainSettings) -> ValidationRays:
    """The RAYS rays by which view dependence is judged, of the views that are not trained on, bool [views]; of all where there are none."""
    return ValidationRays(rays, validation_views if validation_views.any() else None, RAYS, settings)


def too_short() -> Decision:
    """The decision of a training with fewer than LEAST steps before the test."""
    return Decision(EFFECT, "deferred", "The training is too short to tell; a longer one measures it.")


def run(field: Field, rays: ValidationRays, validation_views: NDArray[Any]) -> Decision:
    """Compare the deferred field trained so far with its own average over directions.

    validation_views: bool [views], the views that were not trained on, from which the rays are; of all views where there are none.
    """
    cameras = [camera for camera, left_out in zip(field.cameras, validation_views, strict=True) if not left_out]
    return judged(*errors(field, rays, cameras), int(validation_views.sum()))


def errors(field: Field, rays: ValidationRays, cameras: Sequence[Camera]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The squared colour errors of a deferred field's rays: ([R] with the residual averaged over the cameras that see the point, [R] with
    the ray's own residual)."""
    gathered, transmittance = integrate(field, rays.origins, rays.directions, rays.near, rays.view_directions, rays.far)
    along = mean_distance(np, gathered[:, -1], 1 - transmittance, 0.0)
    points = field.domain.to_world(rays.origins + rays.directions * along[:, None])
    points = points if field.ndc is None else field.ndc.to_world(points)

    def shown(directions: NDArray[Any]) -> NDArray[Any]:
        params, towards = {"view": field.network}, directions.astype(np.float32)
        return np.asarray(ray_colour(np, "deferred", params, gathered[:, :-1], transmittance, towards, rays.background))

    own = shown(rays.view_directions)
    total, count = np.zeros_like(own), np.zeros(len(own), np.float32)
    for camera in cameras[:: -(-len(cameras) // EYES)]:
        directions = camera.toward(points)
        sees = camera.shows(points) & ((directions * rays.view_directions).sum(axis=-1) > 0)  # not from behind: that is another surface
        total += np.where(sees[:, None], shown(directions), 0)
        count += sees
    averaged = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], own)
    return rays.errors(averaged), rays.errors(own)


def judged(without: NDArray[Any], gained: NDArray[Any], views: int) -> Decision:
    """Decide from squared errors [R] of the same rays: `without` view dependence and with it, `gained`.

    The field stays deferred where view dependence gains more than GAIN dB plus twice the standard error of the gain.
    views: the number of validation views from which the rays are; 0 for training rays.
    """
    gain = 10 * np.log10(max(float(without.mean()), 1e-12) / max(float(gained.mean()), 1e-12))
    difference = without - gained
    error = float(difference.std() / np.sqrt(len(difference)))
    doubt = 2 * 10 / np.log(10) * error / max(float(without.mean()), 1e-12)  # dB
    threshold = GAIN + doubt
    where = f"rays of {views} views set aside" if views else "training rays, because there are too few views to set any aside"
    needed = f"needed: {threshold:.2f} dB, of which twice the standard error is {doubt:.2f}"
    evidence = f"It gains {gain:+.2f} dB over its own average on {where} ({needed})."
    return Decision(EFFECT, "deferred" if gain > threshold else "diffuse", evidence, gain, threshold)
