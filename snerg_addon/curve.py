"""The training curve for the panel, from the log that training writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import SnergError
from ..core.training.log import FILE, read_log

BARS = "▁▂▃▄▅▆▇█"
WIDTH = 32  # bars that fit across the sidebar


@dataclass(frozen=True)
class Curve:
    """The state of one training. fraction: done, in [0, 1]. psnr: latest dB on training rays. held_out: latest dB on held-out views.

    Both are None where they were not measured. bars: the curve of the held-out PSNR as text, or of the training rays' where there is none.
    """

    fraction: float = 0.0
    steps: int = 0
    seconds: float = 0.0
    psnr: float | None = None
    held_out: float | None = None
    bars: str = ""


_cache: dict[Path, tuple[tuple[int, int], Curve]] = {}


def curve_of(folder: Path) -> Curve | None:
    """The curve of the training log in a field's folder, cached until the log grows; None where there is none. Never raises."""
    path = folder / FILE
    try:
        status = path.stat()
    except OSError:
        return None
    stamp = (status.st_mtime_ns, status.st_size)
    if path not in _cache or _cache[path][0] != stamp:
        try:
            _cache[path] = (stamp, read_curve(read_log(folder)))
        except SnergError:
            return None
    return _cache[path][1]


def read_curve(lines: list[dict[str, Any]]) -> Curve:
    """The curve of the lines of a log (see core/training/log.py)."""
    rays = [line for line in lines if _is_number(line.get("psnr"))]
    held = [line for line in lines if _is_number(line.get("held_out_psnr"))]
    last = rays[-1] if rays else {}
    values = [line["held_out_psnr"] for line in held] if len(held) > 3 else [line["psnr"] for line in rays]
    return Curve(
        fraction=float(last.get("fraction", 0.0)),
        steps=int(last.get("step", 0)),
        seconds=float(last.get("seconds", 0.0)),
        psnr=last.get("psnr"),
        held_out=held[-1]["held_out_psnr"] if held else None,
        bars=sparkline(values),
    )


def sparkline(values: list[float], width: int = WIDTH) -> str:
    """Values as a line of at most `width` bars, each the mean of its part of the values; '' for fewer than two values."""
    if len(values) < 2:
        return ""
    count = min(width, len(values))
    parts = [values[i * len(values) // count : (i + 1) * len(values) // count] for i in range(count)]
    means = [sum(part) / len(part) for part in parts]
    low, high = min(means), max(means)
    return "".join(BARS[min(int((mean - low) / (high - low or 1) * len(BARS)), len(BARS) - 1)] for mean in means)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
