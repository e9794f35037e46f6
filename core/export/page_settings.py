"""What a web page says about itself, and how it opens."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..errors import SnergError
from .annotations import Annotation
from .world_units import WorldUnits

BACKGROUNDS = {"white": 1.0, "grey": 128 / 255, "black": 0.0}
TRANSPARENT = "transparent"  # what is behind the page's frame shows through
COLOUR = re.compile("#[0-9a-fA-F]{6}")
BACKGROUND_NAMES = ", ".join((*BACKGROUNDS, TRANSPARENT))  # for sentences
MODES = ("orbit", "fly", "walk")
AUTOMATIC = "auto"  # the quality that suits the device
QUALITIES = (AUTOMATIC, "phone", "balanced", "full")
THUMBNAILS = 24  # cameras that have a small picture, where nothing else is asked for


@dataclass(frozen=True)
class PageSettings:
    """What a page says about itself, and how it opens. Raises SnergError for values that cannot be used."""

    title: str = ""
    description: str = ""
    address: str = ""  # where the page will be published: other sites show its picture only by a whole address
    background: str = "white"  # of BACKGROUNDS, TRANSPARENT or #rrggbb
    distance: tuple[float, float] | None = None  # nearest and farthest orbit, in units of the scene, from the point that is looked at
    elevation: tuple[float, float] | None = None  # lowest and highest orbit, in degrees above the horizon
    background_image: Path | None = None  # a picture behind the scene, which is shown in place of `background` at first
    mode: str = "orbit"  # of MODES: how people move at first
    quality: str = AUTOMATIC  # of QUALITIES: how fine the picture is at first, and how much graphics memory the scene may take
    play: bool = False  # whether the page's camera path plays as soon as the scene is there
    thumbnails: int = 0  # cameras at most that have a small picture in the page's list
    annotations: tuple[Annotation, ...] = ()  # labels in the scene
    measures: bool = False  # whether people can measure lengths
    vr: bool = False  # whether people can enter the scene with a headset
    units: WorldUnits = WorldUnits()  # of measured lengths, and of the size that a headset shows

    def __post_init__(self) -> None:
        if not is_background(self.background):
            raise SnergError(f"There is no background {self.background!r}; choose from {BACKGROUND_NAMES}, or give a colour as #204060.")
        if self.mode not in MODES:
            raise SnergError(f"There is no way to move {self.mode!r}; choose from {', '.join(MODES)}.")
        if self.quality not in QUALITIES:
            raise SnergError(f"There is no quality {self.quality!r} of a page; choose from {', '.join(QUALITIES)}.")
        if self.address and not self.address.startswith(("http://", "https://")):
            raise SnergError(f"{self.address} is not the address of a page; it begins with https:// or http://.")
        if not isinstance(self.thumbnails, int) or self.thumbnails < 0:
            raise SnergError(f"A page cannot have {self.thumbnails} small pictures; give a whole number from 0 on.")
        if self.distance is not None and not 0 < self.distance[0] <= self.distance[1] < float("inf"):
            raise SnergError(f"The orbit's distances are {pair(self.distance)}; give two above 0, the smaller one first.")
        if self.elevation is not None and not -90 <= self.elevation[0] <= self.elevation[1] <= 90:
            raise SnergError(f"The orbit's elevations are {pair(self.elevation)}; give two from -90 to 90, the smaller one first.")

    @property
    def colour(self) -> tuple[float, float, float] | None:
        """The background's sRGB colour in [0, 1]; None where something else shows through."""
        if self.background_image or self.background == TRANSPARENT:
            return None
        if self.background in BACKGROUNDS:
            return (BACKGROUNDS[self.background],) * 3
        red, green, blue = bytes.fromhex(self.background[1:])
        return red / 255, green / 255, blue / 255


def is_background(text: str) -> bool:
    """Whether a text names a background: one of BACKGROUNDS, TRANSPARENT, or a colour as #rrggbb."""
    return text in BACKGROUNDS or text == TRANSPARENT or COLOUR.fullmatch(text) is not None


PLAIN = PageSettings()


def pair(values: tuple[float, float]) -> str:
    """Two numbers as they are written into the page."""
    return f"{values[0]:g} {values[1]:g}"
