"""What the field and bake panels say of the version in use."""

from __future__ import annotations

import textwrap

from ..project import Project
from .layout import LINE_WIDTH, joined


def made_with(project: Project, step: str) -> list[str]:
    """Lines that say when the version in use was made, and with which settings."""
    version = project.in_use(step)
    return textwrap.wrap(joined(str(project.note_of(version).get("when", "")), project.settings_of(version)), LINE_WIDTH)
