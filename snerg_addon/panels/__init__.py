"""The sidebar of the 3D view: one panel whose steps open and close, each with its settings, its buttons and its result."""

from __future__ import annotations

from .farm import SNERG_PT_farm
from .main import SNERG_PT_main
from .preferences import SNERG_AP_preferences
from .results import SNERG_UL_results
from .scene_object import SNERG_PT_object

CLASSES = (SNERG_AP_preferences, SNERG_UL_results, SNERG_PT_main, SNERG_PT_farm, SNERG_PT_object)
