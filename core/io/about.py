"""Validation of the metadata of fields and scenes (`about`) when they are read: the JSON values that later code uses.

All functions raise ValueError that names the value. Keys that no code uses may hold anything.
"""

from __future__ import annotations

import json
from typing import Any

from .schema import number, record, text, whole

MAX_COUNT = 2**53  # largest integer up to which float64 is exact


def check_about_field(value: Any) -> dict[str, Any]:
    """The metadata of a field: settings and results of its training."""
    about = finite_record(value)
    for key in ("steps", "seconds", "psnr_training_rays", "psnr_held_out_rays"):
        if about.get(key) is not None:
            number(about[key], key)
    _check_trained(about)
    settings = record(about.get("settings", {}), "settings")
    check_background(settings.get("background", "white"))
    return about


def check_about_scene(value: Any) -> dict[str, Any]:
    """The metadata of a scene: its training, its bake and its finishing."""
    about = finite_record(value)
    trained = record(about.get("trained", {}), "trained")
    _check_trained(trained)
    check_background(trained.get("background", "white"))
    _check_bake(record(about.get("bake", {}), "bake"))
    if about.get("refine") is not None:
        _check_refine(record(about["refine"], "refine"))
    if about.get("fit") is not None:
        _check_refine(record(about["fit"], "fit"))
    return about


def finite(value: Any) -> Any:
    """The value itself. Raises ValueError when it contains NaN or infinity, which cannot be written as JSON."""
    json.dumps(value, allow_nan=False)
    return value


def finite_record(value: Any) -> dict[str, Any]:
    """A JSON object without NaN and infinity."""
    found = record(value, "about")
    finite(found)
    return found


def check_background(value: Any) -> None:
    """Raise ValueError unless the value is the name of a colour, or three numbers from 0 to 1."""
    if isinstance(value, list) and len(value) == 3:
        for part in value:
            number(part, "background", 0, 1)
    else:
        text(value, "background")


def _check_trained(value: dict[str, Any]) -> None:
    options = record(value.get("dataset_options", {}), "dataset_options")
    if not options.keys() <= {"holdout", "downscale"}:
        raise ValueError(f"dataset_options has {sorted(map(str, options))[:4]}; it holds holdout and downscale")
    for key, low in (("holdout", 0), ("downscale", 1)):
        if key in options:
            whole(options[key], key, low, MAX_COUNT)
    decisions = value.get("decisions", [])
    if not isinstance(decisions, list):
        raise ValueError("decisions is no list")
    for decision in decisions:
        _check_decision(record(decision, "a decision"))


def _check_decision(value: dict[str, Any]) -> None:
    """A Decision (see training/decisions.py)."""
    if not {"effect", "chosen", "evidence"} <= value.keys() <= {"effect", "chosen", "evidence", "measured", "threshold", "overridden"}:
        raise ValueError("a decision needs an effect, what was chosen and the evidence, and no more than that")
    text(value["effect"], "effect")
    text(value["evidence"], "evidence")
    if not isinstance(value["chosen"], bool | str) or not isinstance(value.get("overridden", False), bool):
        raise ValueError("a decision was neither a yes, a no nor a name")
    for key in ("measured", "threshold"):
        if value.get(key) is not None:
            number(value[key], key)


def _check_bake(bake: dict[str, Any]) -> None:
    settings = record(bake.get("settings", {}), "settings")
    if settings.get("visibility_threshold") is not None:
        number(settings["visibility_threshold"], "visibility_threshold")
    seconds = _check_seconds(bake)
    if bake.get("voxels"):
        voxels = record(bake["voxels"], "voxels")
        whole(voxels.get("held"), "held", 0, MAX_COUNT)
        if voxels.get("seen") is not None:
            whole(voxels["seen"], "seen", 0, MAX_COUNT)
            number(seconds.get("visibility"), "visibility")
            number(settings.get("visibility_threshold"), "visibility_threshold")
    if "samples" in bake:
        whole(bake["samples"], "samples", 1, MAX_COUNT)
        number(seconds.get("prefilter"), "prefilter")
    measured = bake.get("samples_measured", [])
    if not isinstance(measured, list):
        raise ValueError("samples_measured is no list")
    for one in measured:
        whole(record(one, "samples_measured").get("samples"), "samples", 1, MAX_COUNT)
        number(one.get("error"), "error")
    for key, parts in (("light", ("passes", "voxels")), ("holes", ("with", "without"))):
        if bake.get(key):
            for part in parts:
                number(record(bake[key], key).get(part), part)
    if "warning" in bake:
        text(bake["warning"], "warning")


def _check_refine(report: dict[str, Any]) -> None:
    """The report of fine-tuning, or of fitting the voxels."""
    if "gain_db" in report:
        for key in ("gain_db", "psnr_before", "psnr_after"):
            number(report.get(key), key)
        _check_seconds(report)
    elif report:
        text(report.get("skipped"), "skipped")


def _check_seconds(value: dict[str, Any]) -> dict[str, Any]:
    seconds = record(value.get("seconds", {}), "seconds")
    for key, took in seconds.items():
        number(took, f"seconds of {key}")
    return seconds
