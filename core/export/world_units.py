"""Lengths of a scene as people read them: what a unit of it is, and in which system it is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..errors import SnergError

SYSTEMS = ("metric", "imperial", "none")
METRES = (1e-9, 1e12)  # smallest and largest unit


@dataclass(frozen=True)
class WorldUnits:
    """The unit of a scene's coordinates. Raises SnergError for values that cannot be used."""

    metres: float = 1.0  # of a unit: Blender's unit scale
    system: str = "metric"  # of SYSTEMS; "none" tells lengths in units of the scene

    def __post_init__(self) -> None:
        if self.system not in SYSTEMS:
            raise SnergError(f"There is no system of units {self.system!r}; choose from {', '.join(SYSTEMS)}.")
        if not METRES[0] <= self.metres <= METRES[1]:  # false for NaN
            raise SnergError(f"A unit of the scene is {self.metres} metres; give a number above 0.")

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return {"metres": self.metres, "system": self.system}
