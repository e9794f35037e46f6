"""Scatter plots with the least squares line through the points, with matplotlib: whether time is linear in the work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

WIDTH, HEIGHT = 520, 400  # pixels of a panel at DPI dots an inch; the PNG has twice as many in each direction
DPI = 100
POINT_COLOUR, LINE_COLOUR, GRID_COLOUR = "#222222", "#c2410c", "#dddddd"


@dataclass(frozen=True)
class Panel:
    """Measured times against an amount of work."""

    title: str
    x: str  # what the work is counted in
    points: Sequence[tuple[float, float]]  # (amount of work, seconds)

    def line(self) -> tuple[float, float, float]:
        """Slope and intercept of the least squares line, and R squared, the share of the variance that it explains."""
        x, y = np.array(self.points, float).T
        slope, intercept = np.polyfit(x, y, 1)
        residual, total = ((y - slope * x - intercept) ** 2).sum(), ((y - y.mean()) ** 2).sum()
        return float(slope), float(intercept), float(1 - residual / total) if total > 0 else 1.0


def save_plot(path: Path, panels: Sequence[Panel]) -> None:
    """Draw the panels side by side into a PNG."""
    figure = Figure(figsize=(WIDTH * len(panels) / DPI, HEIGHT / DPI), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel)
    figure.savefig(path, dpi=2 * DPI)


def _draw(axes: Axes, panel: Panel) -> None:
    x, y = np.array(panel.points, float).T
    slope, intercept, share = panel.line()
    ends = np.array([0.0, 1.06 * x.max()])
    axes.plot(ends, slope * ends + intercept, color=LINE_COLOUR, linewidth=2)
    axes.scatter(x, y, color=POINT_COLOUR, s=22, zorder=3)
    axes.set(xlim=ends, ylim=(0, 1.06 * y.max()), xlabel=panel.x, ylabel="seconds", title=f"{panel.title}   (R squared {share:.3f})")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(color=GRID_COLOUR)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
