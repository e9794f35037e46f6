"""Pictures in panels: a training's curve, drawn here, and image files such as the plots of a study."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from bpy.utils import previews
from PIL import Image, ImageDraw, ImageFont

from .curve import Curve

SIZE = (440, 300)  # pixels of the curve's picture
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 30, 40  # pixels from its edges to the axes
PAPER, INK, GRID, LINE = (29, 29, 29, 255), (200, 200, 200, 255), (66, 66, 66, 255), (90, 170, 255, 255)
FONT_SIZE = 20
_collection: Any = None
_drawn: dict[str, tuple[Any, Any]] = {}  # the state of what was drawn, and its picture, by its name


def icon_of_curve(curve: Curve) -> int:
    """The number of an icon that shows a curve of at least two points."""
    return _icon("curve", curve.points, lambda: curve_picture(curve.points))


def icon_of_file(path: Path) -> int:
    """The number of an icon that shows an image file; 0 where it cannot be read."""
    try:
        status = path.stat()
        return _icon(str(path), (status.st_mtime_ns, status.st_size), lambda: Image.open(path).convert("RGBA"))
    except OSError:
        return 0


def _icon(name: str, state: Any, make: Any) -> int:
    """The number of the icon of that name, drawn anew when its state has changed."""
    global _collection
    if _collection is None:
        _collection = previews.new()
    known = _drawn.get(name)
    if known is None or known[0] != state:
        preview = _collection.new(f"{name} {len(_collection)}")  # a new one: Blender shows a changed picture only after a redraw of its own
        picture = make()
        pixels = np.asarray(picture, np.float32)[::-1] / 255
        preview.image_size = picture.size
        preview.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
        known = _drawn[name] = (state, preview)
    return int(known[1].icon_id)


def clear() -> None:
    """Free the pictures."""
    global _collection
    _drawn.clear()
    if _collection is not None:
        previews.remove(_collection)
        _collection = None


def curve_picture(points: tuple[tuple[float, float], ...]) -> Image.Image:
    """The curve of (seconds, dB) with axes, RGBA of SIZE."""
    picture = Image.new("RGBA", SIZE, PAPER)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(FONT_SIZE)
    x, y = np.array(points, float).T
    ticks = ticks_between(float(y.min()), float(y.max()))
    low, high, most = min(ticks[0], y.min()), max(ticks[-1], y.max()), max(float(x.max()), 1e-6)
    right, bottom = SIZE[0] - RIGHT, SIZE[1] - BOTTOM

    def row(value: float) -> float:
        return bottom - (value - low) / (high - low) * (bottom - TOP)

    for tick in ticks:
        pen.line([(LEFT, row(tick)), (right, row(tick))], GRID)
        pen.text((LEFT - 8, row(tick)), f"{tick:g}", INK, font, anchor="rm")
    pen.text((8, 4), "dB", INK, font)
    unit, name = (60.0, "min") if most >= 120 else (1.0, "s")
    for tick in ticks_between(0, most / unit):
        column = LEFT + tick * unit / most * (right - LEFT)
        if column <= right:
            pen.text((column, bottom + 8), f"{tick:g}", INK, font, anchor="mt")
    pen.text((right, 4), name, INK, font, anchor="ra")
    pen.line([(LEFT, TOP), (LEFT, bottom), (right, bottom)], INK)
    pen.line([(LEFT + a / most * (right - LEFT), row(b)) for a, b in zip(x, y, strict=True)], LINE, 3)
    return picture


def ticks_between(low: float, high: float) -> list[float]:
    """Three to six round numbers that reach from at most `low` to at least `high`."""
    span = max(high - low, 1e-3)
    power = 10.0 ** math.floor(math.log10(span))
    step = next(size * power for size in (0.2, 0.5, 1.0, 2.0, 5.0) if span / (size * power) <= 4)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 10) for index in range(first, max(last, first + 1) + 1)]
