"""The values of the add-on's preferences (panels/preferences.py)."""

from __future__ import annotations

from typing import Any

import bpy

ADDON = __package__.rpartition(".")[0]  # the extension's own name, by which Blender keeps its preferences
GPU_MEGABYTES = 2048
FLAMENCO_URL = "http://localhost:8080"  # the port that a Flamenco Manager listens on


def gpu_bytes() -> int:
    """Bytes of graphics memory that the viewport may take."""
    return int(_chosen("gpu_megabytes", GPU_MEGABYTES)) * 2**20


def training_python() -> str:
    """The path of another Python that trains; empty for Blender's own."""
    path = str(_chosen("training_python", "")).strip()
    return str(bpy.path.abspath(path)) if path else ""


def project_pattern() -> str:
    """Where new projects go; empty for the default (see folder_pattern.py)."""
    return str(_chosen("project_pattern", "")).strip()


def flamenco_url() -> str:
    """The URL of the Flamenco Manager; empty where jobs are sent to none."""
    return str(_chosen("flamenco_url", FLAMENCO_URL)).strip()


def _chosen(name: str, otherwise: Any) -> Any:
    addon = bpy.context.preferences.addons.get(ADDON)
    return getattr(addon.preferences, name, otherwise) if addon else otherwise
