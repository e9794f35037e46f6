"""What a web page says about itself, and how it opens."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import SnergError

BACKGROUNDS = {"white": 1.0, "grey": 128 / 255, "black": 0.0}


@dataclass(frozen=True)
class PageSettings:
    """What a page says about itself, and how it opens. Raises SnergError for values that cannot be used."""

    title: str = ""
    description: str = ""
    address: str = ""  # where the page will be published: other sites show its picture only by a whole address
    background: str = "white"  # of BACKGROUNDS
    distance: tuple[float, float] | None = None  # nearest and farthest orbit, in units of the scene, from the point that is looked at
    elevation: tuple[float, float] | None = None  # lowest and highest orbit, in degrees above the horizon

    def __post_init__(self) -> None:
        if self.background not in BACKGROUNDS:
            raise SnergError(f"There is no background {self.background!r}; choose from {', '.join(BACKGROUNDS)}.")
        if self.address and not self.address.startswith(("http://", "https://")):
            raise SnergError(f"{self.address} is not the address of a page; it begins with https:// or http://.")
        if self.distance is not None and not 0 < self.distance[0] <= self.distance[1] < float("inf"):
            raise SnergError(f"The orbit's distances are {pair(self.distance)}; give two above 0, the smaller one first.")
        if self.elevation is not None and not -90 <= self.elevation[0] <= self.elevation[1] <= 90:
            raise SnergError(f"The orbit's elevations are {pair(self.elevation)}; give two from -90 to 90, the smaller one first.")


PLAIN = PageSettings()


def pair(values: tuple[float, float]) -> str:
    """Two numbers as they are written into the page."""
    return f"{values[0]:g} {values[1]:g}"
