"""The training curve for the panel, from the log that training writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import SnergError
from ..core.training.log import FILE, read_log

POINTS = 200  # of a curve: more than a picture in the sidebar can show


@dataclass(frozen=True)
class Curve:
    """The state of one training. fraction: done, in [0, 1]. psnr: latest dB on training rays. held_out: latest dB on held-out views.

    Both are None where they were not measured. points: (seconds, dB) of the held-out views, or of the training rays where there are few.
    """

    fraction: float = 0.0
    steps: int = 0
    seconds: float = 0.0
    psnr: float | None = None
    held_out: float | None = None
    points: tuple[tuple[float, float], ...] = ()


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
    name, shown = ("held_out_psnr", held) if len(held) > 3 else ("psnr", rays)
    points = [(float(line.get("seconds", 0.0)), float(line[name])) for line in shown]
    return Curve(
        fraction=float(last.get("fraction", 0.0)),
        steps=int(last.get("step", 0)),
        seconds=float(last.get("seconds", 0.0)),
        psnr=last.get("psnr"),
        held_out=held[-1]["held_out_psnr"] if held else None,
        points=tuple(points[:: -(-len(points) // POINTS) or 1]),
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
