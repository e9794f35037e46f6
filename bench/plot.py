"""Points and the straight line through them, drawn with Pillow: a plot for whoever asks whether time is linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT = 520, 400
LEFT, TOP, RIGHT, BOTTOM = 66, 44, 24, 60  # margins
SHARP = 2  # times as large as it is shown
PAPER, INK, FAINT, LINE = "#ffffff", "#222222", "#dddddd", "#c2410c"


@dataclass(frozen=True)
class Panel:
    """points: (x, seconds)."""

    title: str
    x: str
    points: Sequence[tuple[float, float]]

    def line(self) -> tuple[float, float, float]:
        """Slope and intercept of the least squares line, and the share of the variance that it explains (R squared)."""
        x, y = np.array(self.points, float).T
        slope, start = np.polyfit(x, y, 1)
        rest, spread = ((y - slope * x - start) ** 2).sum(), ((y - y.mean()) ** 2).sum()
        return float(slope), float(start), float(1 - rest / spread) if spread > 0 else 1.0


def save_plot(path: Path, panels: Sequence[Panel]) -> None:
    """Draw the panels beside one another into a PNG."""
    image = Image.new("RGB", (SHARP * WIDTH * len(panels), SHARP * HEIGHT), PAPER)
    draw = ImageDraw.Draw(image)
    for number, panel in enumerate(panels):
        _draw(draw, panel, number * WIDTH)
    image.save(path)


def ticks(most: float, about: int = 5) -> list[float]:
    """0 and round numbers up to `most`."""
    step = most / about
    unit = 10.0 ** np.floor(np.log10(step))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= step * 0.999)
    return [float(step * i) for i in range(int(most / step + 1e-6) + 1)]


def label(value: float) -> str:
    """A number as a tick has it."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"


def _draw(draw: ImageDraw.ImageDraw, panel: Panel, offset: int) -> None:
    font, small = ImageFont.load_default(14 * SHARP), ImageFont.load_default(12 * SHARP)
    most_x, most_y = (1.06 * max(values) for values in zip(*panel.points, strict=True))
    slope, start, share = panel.line()

    def place(x: float, y: float) -> tuple[float, float]:
        across = (WIDTH - LEFT - RIGHT) * x / most_x
        return SHARP * (offset + LEFT + across), SHARP * (HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * y / most_y)

    for x in ticks(most_x):
        draw.line([place(x, 0), place(x, most_y)], FAINT, SHARP)
        left, low = place(x, 0)
        draw.text((left, low + 6 * SHARP), label(x), INK, small, anchor="ma")
    for y in ticks(most_y):
        draw.line([place(0, y), place(most_x, y)], FAINT, SHARP)
        left, low = place(0, y)
        draw.text((left - 6 * SHARP, low), f"{y:g}", INK, small, anchor="rm")
    first = max(0.0, -start / slope) if slope else 0.0
    last = min(most_x, (most_y - start) / slope) if slope > 0 else most_x
    draw.line([place(first, slope * first + start), place(last, slope * last + start)], LINE, 2 * SHARP)
    draw.line([place(0, most_y), place(0, 0), place(most_x, 0)], INK, SHARP)
    for x, y in panel.points:
        left, low = place(x, y)
        draw.ellipse([left - 4 * SHARP, low - 4 * SHARP, left + 4 * SHARP, low + 4 * SHARP], INK)
    draw.text((SHARP * (offset + LEFT), 14 * SHARP), f"{panel.title}   (R squared {share:.3f})", INK, font)
    draw.text((SHARP * (offset + WIDTH - RIGHT), SHARP * (HEIGHT - 24)), panel.x, INK, small, anchor="ra")
    draw.text((SHARP * (offset + 8), SHARP * (TOP - 12)), "seconds", INK, small)
