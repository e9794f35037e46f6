"""Bakes a field, then finishes the scene on the training images. Uses JAX."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..data.dataset import Dataset
from ..errors import needs_jax
from ..geometry.box import Box
from ..progress import Progress, silent, within
from ..scene.half_features import with_half_features
from ..scene.scene import Scene
from ..training.provenance import background_of, trained
from .bake import BakeSettings
from .finish import DEFAULT_FINISHING, Finishing, finish

if TYPE_CHECKING:
    from ..nerf.field import Field


def bake_field(
    field: Field,
    box: Box,
    settings: BakeSettings,
    dataset: Dataset | None,
    progress: Progress = silent,
    resume: Path | None = None,
    finishing: Finishing = DEFAULT_FINISHING,
    half_features: bool = False,
) -> tuple[Scene, dict[str, float]]:
    """Bake a field inside a box, and finish the scene on the images of a dataset if there is one.

    resume: see `bake`. half_features: the scene will be stored with features at half the resolution; the network is fine-tuned on what
    is read back then. Returns the scene and the seconds of each stage: "bake", and those of the finishing. Raises SnergError without JAX.
    """
    with needs_jax():
        from .bake import bake
    began = time.perf_counter()
    share = 0.97 if dataset is None else 0.3 if finishing.fit else 0.7
    scene = bake(field, box, field.cameras, settings, within(progress, 0, share), resume)
    known = trained(field.about)
    decided = {"decisions": field.about.get("decisions", [])}
    scene = replace(scene, about={**scene.about, "trained": known | decided})
    seconds = {"bake": time.perf_counter() - began}
    if half_features and settings.quantise and scene.network is not None and not scene.square_roots:
        scene = replace(scene, cells=with_half_features(scene.cells))
    if dataset is not None:
        scene, finished = finish(scene, dataset, finishing, background_of(known), within(progress, share, 0.97))
        seconds |= finished
    return scene, {name: round(value, 2) for name, value in seconds.items()}
