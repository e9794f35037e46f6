"""Whether a scene calls for view dependence, measured while it trains (JAX).

Training begins with view dependence. After a while, rays of views that were set aside are compared with what they ought to
show, once as they are, and once with what the view-dependence network adds averaged over the directions from which the training
cameras see the same points: the best that a field without it, but otherwise the same, could show. Where that is as good, training
goes on without. Comparing two short trainings instead tells little: the network needs long to find out what a highlight is, and
a step at the full rate happens to do more to either side than what there is to measure.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from .ray_dataset import RayDataset
from .validation import ValidationRays

AT = 0.3  # of the training: what view dependence there is shows by then
LEAST = 100  # steps before that; after fewer nothing can be told
SILENT = -100.0  # the network's last bias: a residual of 1e-13 with gradients of exactly 0
VIEWS = 12  # from how many views on some can be set aside
RAYS = 16384
EYES = 24  # cameras, at most, from which points are looked at
GAIN = 0.05  # dB that view dependence must bring, beyond twice the standard error
EFFECT = "View dependence"


def silenced(params: dict[str, Any]) -> dict[str, Any]:
    """Parameters whose view-dependence networks add nothing, and learn nothing any more."""
    changed = dict(params)
    if "view" in params:
        *rest, last = params["view"]
        changed["view"] = (*rest, jnp.full_like(last, SILENT))
    if "coarse" in params:
        changed["coarse"] = silenced(params["coarse"])
    return changed


def set_aside(views: int) -> NDArray[Any]:
    """bool [views]: 2 to 4 of them, spread evenly; none where there are few."""
    aside = np.zeros(views, bool)
    if views >= VIEWS:
        count = min(max(views // 12, 2), 4)
        aside[np.linspace(0, views - 1, count + 2).round().astype(int)[1:-1]] = True
    return aside


def run(step: int, field: Field, rays: RayDataset, validation_views: NDArray[Any], settings: TrainSettings) -> Decision:
    """Decide between a deferred and a diffuse field. `measured` of the decision is None where the training is too short to tell.

    step: steps done. field: as trained so far, deferred. validation_views: bool [views], not trained on so far.
    """
    if step < LEAST:
        return Decision(EFFECT, "deferred", "The training is too short to tell; a longer one measures it.")
    tested = ValidationRays(rays, validation_views if validation_views.any() else None, RAYS, settings)
    cameras = [camera for camera, left_out in zip(field.cameras, validation_views, strict=True) if not left_out]
    return judged(*errors(field, tested, cameras), int(validation_views.sum()))


def errors(field: Field, rays: ValidationRays, cameras: Sequence[Camera]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Squared errors [R] of a deferred field's rays with view dependence averaged over where the cameras are, and as it is."""
    gathered, through = integrate(field, rays.origins, rays.directions, rays.near, rays.looking)
    along = mean_distance(np, gathered[:, -1], 1 - through, 0.0)
    points = field.domain.to_world(rays.origins + rays.directions * along[:, None])
    points = points if field.ndc is None else field.ndc.to_world(points)

    def shown(looking: NDArray[Any]) -> NDArray[Any]:
        params = {"view": field.network}
        return ray_colour(np, "deferred", params, gathered[:, :-1], through, looking.astype(np.float32), rays.background)

    own = shown(rays.looking)
    total, count = np.zeros_like(own), np.zeros(len(own), np.float32)
    for camera in cameras[:: -(-len(cameras) // EYES)]:
        looking = camera.toward(points)
        sees = camera.shows(points) & ((looking * rays.looking).sum(axis=-1) > 0)  # from the other side there is another surface
        total += np.where(sees[:, None], shown(looking), 0)
        count += sees
    averaged = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], own)
    return rays.errors(averaged), rays.errors(own)


def judged(without: NDArray[Any], gained: NDArray[Any], views: int) -> Decision:
    """From squared errors [R] of the same rays without and with view dependence."""
    gain = 10 * np.log10(max(float(without.mean()), 1e-12) / max(float(gained.mean()), 1e-12))
    difference = without - gained
    error = float(difference.std() / np.sqrt(len(difference)))
    doubt = 2 * 10 / np.log(10) * error / max(float(without.mean()), 1e-12)  # dB
    threshold = GAIN + doubt
    where = f"rays of {views} views set aside" if views else "training rays, because there are too few views to set any aside"
    needed = f"needed: {threshold:.2f} dB, of which twice the standard error is {doubt:.2f}"
    evidence = f"It gains {gain:+.2f} dB over its own average on {where} ({needed})."
    return Decision(EFFECT, "deferred" if gain > threshold else "diffuse", evidence, gain, threshold)
