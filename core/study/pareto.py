"""Which configurations are worth having: those that nothing else beats, and the one that a wish calls for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
ALIKE = 1.05  # times a frame within which bytes decide


@dataclass(frozen=True)
class Target:
    """What a scene is wanted to have: at least so many dB on held-out views, at most so many megabytes, at most so many
    milliseconds a frame; None where that does not matter."""

    db: float | None = None
    mb: float | None = None
    ms: float | None = None

    def __bool__(self) -> bool:
        return (self.db, self.mb, self.ms) != (None, None, None)

    def text(self) -> str:
        """For people."""
        wishes = ((self.db, "at least {:g} dB"), (self.mb, "at most {:g} MB"), (self.ms, "at most {:g} ms a frame"))
        return ", ".join(text.format(value) for value, text in wishes if value is not None)

    def misses(self, row: Row) -> float:
        """How far a row is from it: 0 where it has it all, else the sum of what is missing, as shares (dB: tenths of a decibel)."""
        missing = 0.0
        if self.db is not None:
            missing += max(self.db - row["psnr"], 0) / 10
        for most, name in ((self.mb, "megabytes"), (self.ms, "ms")):
            if most is not None:
                missing += max(row[name] / most - 1, 0)
        return missing


def front(rows: Sequence[Row], *costs: str) -> list[Row]:
    """The rows than which no other is as good in every one of `costs` (less is better) and in psnr, and better in one; cheapest first."""

    def beats(a: Row, b: Row) -> bool:
        pairs = [(a[cost], b[cost]) for cost in costs] + [(-a["psnr"], -b["psnr"])]
        return all(x <= y for x, y in pairs) and any(x < y for x, y in pairs)

    best = [row for row in rows if not any(beats(other, row) for other in rows)]
    return sorted(best, key=lambda row: [row[cost] for cost in costs])


def choose(rows: Sequence[Row], target: Target) -> tuple[Row | None, Row | None]:
    """(the row to take, the row that comes closest): one of them None.

    With a quality to reach it is the cheapest on the front that does: of those within ALIKE of the fewest milliseconds a frame the one
    with the fewest megabytes. With sizes or times alone it is the best that keeps to them.
    """
    best = front(rows, "ms", "megabytes")
    if not best:
        return None, None
    enough = [row for row in best if target.misses(row) == 0]
    if not enough:
        return None, min(best, key=target.misses)
    if target.db is None:
        return max(enough, key=lambda row: row["psnr"]), None
    quickest = min(row["ms"] for row in enough)
    return min((row for row in enough if row["ms"] <= ALIKE * quickest), key=lambda row: row["megabytes"]), None
