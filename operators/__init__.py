"""Blender's operators, one file each: they read the settings, start a task, and record its result."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any


def classes() -> tuple[type[Any], ...]:
    """Every operator of the files beside this one, for registration. Imported here, because the package must import without Blender."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    return tuple(
        value
        for module in modules
        for name, value in vars(module).items()
        if name.startswith("SNERG_OT_") and value.__module__ == module.__name__
    )
