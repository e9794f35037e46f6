"""Times and sizes as people read them: the unit that suits, and no more digits than an estimate has."""

from __future__ import annotations

from collections.abc import Sequence

Unit = tuple[str, float, float]  # its name, how many seconds or bytes it has, and below how many it is used
TIMES: tuple[Unit, ...] = (("ms", 1e-3, 0.0995), ("s", 1.0, 99.5), ("min", 60.0, 99.5 * 60), ("h", 3600.0, float("inf")))
SIZES: tuple[Unit, ...] = (("kB", 1e3, 0.9995e6), ("MB", 1e6, 0.9995e9), ("GB", 1e9, float("inf")))


def duration(seconds: float) -> str:
    """A time of any length: '40 ms', '0.4 s', '2.4 s', '95 s', '28 min', '3.2 h'."""
    return _with_unit(seconds, TIMES)


def file_size(count: float) -> str:
    """A number of bytes: '64 kB', '2.4 MB', '120 MB', '1.3 GB'. A megabyte is a million bytes."""
    return _with_unit(count, SIZES)


def _with_unit(value: float, units: Sequence[Unit]) -> str:
    name, one, _ = next((unit for unit in units if value < unit[2]), units[-1])
    amount = value / one
    return f"{amount:.1f}".removesuffix(".0") + f" {name}" if amount < 9.95 else f"{amount:.0f} {name}"
