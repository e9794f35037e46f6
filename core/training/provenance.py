"""What a field, or a scene baked from it, keeps of its training, for whoever measures it."""

from __future__ import annotations

from typing import Any

from ..data.dataset import DatasetOptions
from .losses import shown_over


def trained(about: dict[str, Any]) -> dict[str, Any]:
    """The part of a field's `about` that evaluation needs. A scene baked from the field keeps it."""
    return {"dataset_options": about.get("dataset_options", {}), "background": about.get("settings", {}).get("background", "white")}


def options_of(known: dict[str, Any]) -> DatasetOptions:
    """The options with which the dataset was read for training, from the result of `trained`."""
    options = {name: value for name, value in known.get("dataset_options", {}).items() if name in ("holdout", "downscale")}
    return DatasetOptions(**options)


def background_of(known: dict[str, Any]) -> tuple[float, float, float]:
    """The background over which pictures are evaluated, RGB in [0, 1], from the result of `trained`."""
    red, green, blue = shown_over(str(known.get("background", "white"))).tolist()
    return red, green, blue
