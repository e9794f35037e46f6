"""The plots of a study, with matplotlib: each a figure that is saved as PNG and SVG."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

from .metrics import psnr_of
from .pareto import StudyRow, pareto_front
from .plan import CODEC, RESOLUTION
from .summary import GOOD_ERROR, PREDICTED, PathPoint, making_seconds

COLOURS = ("#0f766e", "#b45309", "#7c3aed", "#be123c", "#2563eb", "#4d7c0f", "#a21caf", "#0891b2", "#78716c", "#ca8a04")
INK, FAINT, FRONT = "#1f2937", "#d1d5db", "#111827"


def files(figure: Any) -> dict[str, bytes]:
    """A figure as {"png": bytes, "svg": bytes}; the same figure gives the same bytes."""
    import matplotlib

    found = {}
    with matplotlib.rc_context({"svg.hashsalt": "snerg", "svg.fonttype": "path"}):
        for kind in ("png", "svg"):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)
            found[kind] = buffer.getvalue()
    return found


def figure(width: float, height: float, columns: int = 1) -> tuple[Any, list[Any]]:
    """A figure of `width` x `height` inches and its axes side by side, with a grid and without a frame."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    axes = made.subplots(1, columns, squeeze=False)[0]
    for one in axes:
        one.grid(True, which="major", color=FAINT, linewidth=0.6)
        one.set_axisbelow(True)
        one.spines[["top", "right"]].set_visible(False)
        one.tick_params(labelsize=8, colors=INK)
    return made, list(axes)


def logarithmic(axes: Any, *which: str) -> None:
    """Set log scales of the axes `which` ("x", "y"), with ticks at 1, 2 and 5 of each decade."""
    for name in which:
        getattr(axes, f"set_{name}scale")("log")
        _decades(getattr(axes, f"{name}axis"), lambda value: f"{value:g}")


def _decades(axis: Any, label: Callable[[float], str]) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: label(value)))
    axis.set_minor_formatter(NullFormatter())


def error_against_time(rows: Sequence[StudyRow], paths: dict[str, list[PathPoint]], baseline: StudyRow) -> Any:
    """Mean squared error against milliseconds a frame and against seconds to make the files, on log axes.

    Each parameter's path leads through the baseline (star); the Pareto front is dashed.
    """
    made, axes = figure(12, 5.4, 2)
    costs: tuple[tuple[str, Callable[[StudyRow], float]], ...] = (
        ("milliseconds a frame", lambda row: float(row["ms"])),
        ("seconds to bake, refine and write", making_seconds),
    )
    for one, (title, cost) in zip(axes, costs, strict=True):
        for colour, (parameter, path) in zip(COLOURS * 4, paths.items(), strict=False):
            if "," not in parameter:
                x, y = [cost(point.row) for point in path], [mse(point.row) for point in path]
                one.plot(x, y, "-o", color=colour, markersize=3.5, linewidth=1, alpha=0.85, label=parameter)
        best = pareto_front([row | {"cost": cost(row)} for row in rows], "cost")
        x, y = [row["cost"] for row in best], [mse(row) for row in best]
        one.step(x, y, where="post", color=FRONT, linewidth=1.6, linestyle="--", label="Pareto front")
        one.scatter(x, y, s=46, facecolors="none", edgecolors=FRONT, linewidths=1.4, zorder=4)
        one.scatter([cost(baseline)], [mse(baseline)], marker="*", s=130, color=FRONT, zorder=5, label="baseline")
        logarithmic(one, "x", "y")
        one.set_xlabel(title)
        one.set_ylabel("mean squared error")
        right = one.secondary_yaxis("right", functions=(lambda e: e, lambda e: e))
        _decades(right.yaxis, lambda value: f"{psnr_of(value):.1f} dB")
        right.tick_params(labelsize=8, colors=INK)
    handles, labels = axes[0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return made


def rate_and_distortion(paths: dict[str, list[PathPoint]], rows: Sequence[StudyRow]) -> Any:
    """PSNR against megabytes: of PNG by resolution; at the baseline's, of the lossless codecs, and of the others by quality."""
    made, (one,) = figure(8, 5)
    drawn = {"PNG, by resolution": paths.get(RESOLUTION, []), "lossless codecs": paths.get(CODEC, [])}
    drawn |= {parameter: path for parameter, path in paths.items() if parameter.endswith("quality")}
    for colour, (label, path) in zip(COLOURS, drawn.items(), strict=False):
        x, y = [point.row["megabytes"] for point in path], [point.row["psnr"] for point in path]
        one.plot(x, y, "-o", color=colour, markersize=4, linewidth=1, label=label)
        for point in path:
            label = point.value.removesuffix(" voxels")
            place = point.row["megabytes"], point.row["psnr"]
            if not point.is_baseline:
                one.annotate(label, place, (4, -9), textcoords="offset points", fontsize=7, color=colour)
    best = pareto_front([row for row in rows if row["config"]["bake"]["quantise"]], "megabytes")
    x, y = [row["megabytes"] for row in best], [row["psnr"] for row in best]
    one.step(x, y, where="post", color=FRONT, linewidth=1.4, linestyle="--", label="Pareto front of all rows")
    logarithmic(one, "x")
    one.set_xlabel("megabytes")
    one.set_ylabel("PSNR, mean of held-out views, dB")
    one.legend(fontsize=8, frameon=False)
    return made


def waterfall(found: Sequence[tuple[str, StudyRow]]) -> Any:
    """PSNR of the first stage, and the change in dB of each stage from the field to the web page."""
    made, (one,) = figure(8, 4)
    values = [row["psnr"] for _, row in found]
    names = [stage for stage, _ in found]
    one.bar([0], [values[0]], color=COLOURS[4], width=0.62)
    for index in range(1, len(values)):
        change = values[index] - values[index - 1]
        colour = COLOURS[0] if change >= 0 else COLOURS[3]
        one.bar([index], [abs(change)], bottom=min(values[index], values[index - 1]), color=colour, width=0.62)
        one.plot([index - 1 + 0.31, index - 0.31], [values[index - 1]] * 2, color=INK, linewidth=0.7)
        label = f"{change:+.2f}" if abs(change) >= 0.005 else "0"
        place = index, max(values[index], values[index - 1])
        one.annotate(label, place, (0, 4), textcoords="offset points", ha="center", fontsize=8)
    one.annotate(f"{values[0]:.2f} dB", (0, values[0]), (0, 4), textcoords="offset points", ha="center", fontsize=8)
    spread = max(max(values) - min(values), 0.2)
    one.set_ylim(min(values) - 0.6 * spread, max(values) + 0.4 * spread)
    one.set_xticks(range(len(names)), names)
    one.set_ylabel("PSNR, mean of held-out views, dB")
    return made


def ablations(found: Sequence[tuple[str, float, float]]) -> Any:
    """Gains in PSNR of changes to one parameter. found: (text, gain in dB over the baseline, half the width of its 95 % interval)."""
    made, (one,) = figure(8, 0.9 + 0.24 * len(found))
    y = list(range(len(found)))[::-1]
    gains = [gain for _, gain, _ in found]
    halves = [half if half < 1e9 else 0.0 for _, _, half in found]
    one.errorbar(gains, y, xerr=halves, fmt="o", color=COLOURS[4], ecolor=INK, elinewidth=1, capsize=2.5, markersize=4)
    one.axvline(0, color=INK, linewidth=0.8)
    one.set_yticks(y, [what for what, _, _ in found], fontsize=8)
    one.set_ylim(-0.7, len(found) - 0.3)
    one.set_xlabel("dB against the baseline, mean over held-out views and its 95 % interval")
    return made


def predicted_and_measured(found: Sequence[tuple[str, StudyRow, float, float]]) -> Any:
    """Predicted against measured numbers, with the band of GOOD_ERROR. found: see `summary.predictions`."""
    names = [name for name in PREDICTED if any(name == one for one, *_ in found)]
    made, axes = figure(3.1 * len(names), 3.3, len(names))
    for one, colour, name in zip(axes, COLOURS, names, strict=False):
        predicted, measured = zip(*(pair for what, _, *pair in found if what == name), strict=True)
        low, high = 0.7 * min(predicted + measured), 1.4 * max(predicted + measured)
        one.fill_between(
            [low, high],
            [low * (1 - GOOD_ERROR), high * (1 - GOOD_ERROR)],
            [low * (1 + GOOD_ERROR), high * (1 + GOOD_ERROR)],
            color="#e5e7eb",
            zorder=0,
        )
        one.plot([low, high], [low, high], color=INK, linewidth=0.7)
        one.scatter(measured, predicted, s=18, color=colour, alpha=0.8, zorder=3)
        logarithmic(one, "x", "y")
        one.set_title(PREDICTED[name], fontsize=9, color=INK)
        one.set_xlabel("measured", fontsize=8)
    axes[0].set_ylabel("predicted", fontsize=8)
    return made


def mse(row: StudyRow) -> float:
    """Mean squared error of a row, from its PSNR."""
    return float(10 ** (-row["psnr"] / 10))
