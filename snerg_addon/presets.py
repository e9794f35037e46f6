"""Presets of training and baking, from a quick look to the best: what they set, and what they will take."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ..core.baking.bake import BakeSettings
from ..core.units import duration, file_size
from . import estimate_panel


@dataclass(frozen=True)
class Preset:
    """name: on its button. description: of what it is for. minutes: of training. resolution: voxels along the box's longest side."""

    name: str
    description: str
    minutes: float
    resolution: int


PRESETS = {
    "DRAFT": Preset("Draft", "A first look: whether cameras, box and light are right", 1.0, 128),
    "GOOD": Preset("Good", "For most objects on a web page", 5.0, 256),
    "BEST": Preset("Best", "Fine detail; larger files", 20.0, 512),
}


def apply(preset: Preset, scene: bpy.types.Scene) -> None:
    """Set what the preset names, and nothing else."""
    settings = scene.snerg
    settings.minutes, settings.steps = preset.minutes, 0
    settings.resolution, settings.voxel_size, settings.samples = preset.resolution, 0.0, 0


def is_set(preset: Preset, scene: bpy.types.Scene) -> bool:
    """Whether the settings are those of the preset."""
    settings = scene.snerg
    training = settings.steps == 0 and abs(settings.minutes - preset.minutes) < 1e-6
    return training and (settings.resolution, settings.voxel_size, settings.samples) == (preset.resolution, 0.0, 0)


def takes(preset: Preset, context: bpy.types.Context) -> str:
    """What the preset takes, in a few words: its training, and its bake once the project's field was measured with Estimate."""
    training = f"{preset.minutes:g} min"
    found = estimate_panel.estimated(context, BakeSettings(resolution=preset.resolution))
    if found is None:
        return f"{training} to train, {preset.resolution} voxels"
    seconds = found["bake_seconds"] + found["finishing_seconds"]
    return f"{training} + {duration(seconds)}, {file_size(1e6 * found['megabytes'])}"
