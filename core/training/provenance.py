"""What a field, or a scene baked from it, keeps of its training, for whoever measures it."""

from __future__ import annotations

from typing import Any

from ..data.dataset import DatasetOptions
from .losses import shown_over


def trained(about: dict[str, Any]) -> dict[str, Any]:
    """Of what a field knows of itself, what measuring needs; a scene baked from it keeps this."""
    return {"dataset_options": about.get("dataset_options", {}), "background": about.get("settings", {}).get("background", "white")}


def options_of(known: dict[str, Any]) -> DatasetOptions:
    """How the images were read in training, from `trained`."""
    options = {name: value for name, value in known.get("dataset_options", {}).items() if name in ("holdout", "downscale")}
    return DatasetOptions(**options)


def background_of(known: dict[str, Any]) -> tuple[float, float, float]:
    """What pictures are shown over, RGB in [0, 1], from `trained`."""
    red, green, blue = shown_over(str(known.get("background", "white"))).tolist()
    return red, green, blue
