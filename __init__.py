"""SNeRG for Blender: from Blender's cameras to a baked radiance field, in Blender and on a web page.

`import snerg` outside Blender, or the extension's module inside, offers the names of `__all__`; each is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core.api import bake, evaluate, export_scene, export_web, render, train
    from .core.artifact import open_artifact
    from .core.baking.bake import BakeSettings
    from .core.data.dataset import Dataset, DatasetOptions
    from .core.data.load import read_dataset
    from .core.data.readers.camera_files import read_cameras
    from .core.errors import Cancelled, SnergError
    from .core.geometry.box import Box
    from .core.geometry.camera import Camera
    from .core.nerf.field import Field
    from .core.nerf.frame import Frame
    from .core.rendering.render import MarchSettings
    from .core.scene.scene import Scene

_WHERE = {
    "api": ("bake", "evaluate", "export_scene", "export_web", "render", "train"),
    "artifact": ("open_artifact",),
    "baking.bake": ("BakeSettings",),
    "data.dataset": ("Dataset", "DatasetOptions"),
    "data.load": ("read_dataset",),
    "data.readers.camera_files": ("read_cameras",),
    "errors": ("Cancelled", "SnergError"),
    "geometry.box": ("Box",),
    "geometry.camera": ("Camera",),
    "nerf.field": ("Field",),
    "nerf.frame": ("Frame",),
    "rendering.render": ("MarchSettings",),
    "scene.scene": ("Scene",),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "BakeSettings",
    "Box",
    "Camera",
    "Cancelled",
    "Dataset",
    "DatasetOptions",
    "Field",
    "Frame",
    "MarchSettings",
    "Scene",
    "SnergError",
    "bake",
    "evaluate",
    "export_scene",
    "export_web",
    "open_artifact",
    "read_cameras",
    "read_dataset",
    "render",
    "train",
]


def __getattr__(name: str) -> Any:
    """A name of the public face, imported now: outside Blender there is no bpy, and JAX takes a second."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".core.{_MODULES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import snerg_addon

    snerg_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import snerg_addon

    snerg_addon.unregister()
