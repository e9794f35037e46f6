"""The sidebar of the 3D view: one panel for each step, which shows its settings, its buttons and its result."""

from __future__ import annotations

from .bake import SNERG_PT_bake
from .box import SNERG_PT_box
from .dataset import SNERG_PT_dataset
from .export import SNERG_PT_export
from .farm import SNERG_PT_farm
from .field import SNERG_PT_field
from .main import SNERG_PT_main
from .preferences import SNERG_AP_preferences
from .preview import SNERG_PT_preview
from .scene_object import SNERG_PT_object
from .study import SNERG_PT_study

CLASSES = (
    SNERG_AP_preferences,
    SNERG_PT_main,
    SNERG_PT_dataset,
    SNERG_PT_field,
    SNERG_PT_box,
    SNERG_PT_bake,
    SNERG_PT_preview,
    SNERG_PT_study,
    SNERG_PT_export,
    SNERG_PT_farm,
    SNERG_PT_object,
)
