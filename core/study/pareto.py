"""The Pareto front of a study's rows, and the row that meets a target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

StudyRow = dict[str, Any]
"""What was measured of a configuration, or of a field: JSON values, as in rows/KEY.json."""
SAME_TIME_RATIO = 1.05  # ratio of milliseconds a frame up to which rows are equally fast and megabytes decide


@dataclass(frozen=True)
class StudyTarget:
    """What a scene has to reach; None where it does not matter."""

    db: float | None = None  # lowest PSNR on held-out views, in dB
    mb: float | None = None  # most megabytes of files
    ms: float | None = None  # most milliseconds a frame

    def __bool__(self) -> bool:
        return (self.db, self.mb, self.ms) != (None, None, None)

    def text(self) -> str:
        """The target in words."""
        wishes = ((self.db, "at least {:g} dB"), (self.mb, "at most {:g} MB"), (self.ms, "at most {:g} ms a frame"))
        return ", ".join(text.format(value) for value, text in wishes if value is not None)

    def misses(self, row: StudyRow) -> float:
        """How far a row is from the target: 0 where it meets it, else the sum of the relative excesses, and of the missing dB / 10."""
        missing = 0.0
        if self.db is not None:
            missing += max(self.db - row["psnr"], 0) / 10
        for most, name in ((self.mb, "megabytes"), (self.ms, "ms")):
            if most is not None:
                missing += max(row[name] / most - 1, 0)
        return missing


def pareto_front(rows: Sequence[StudyRow], *costs: str) -> list[StudyRow]:
    """The Pareto front of rows in psnr and in each of `costs` (less is better), the cheapest first.

    A row is on the front when no other row is as good in all of these and better in one.
    """

    def dominates(a: StudyRow, b: StudyRow) -> bool:
        pairs = [(a[cost], b[cost]) for cost in costs] + [(-a["psnr"], -b["psnr"])]
        return all(x <= y for x, y in pairs) and any(x < y for x, y in pairs)

    front = [row for row in rows if not any(dominates(other, row) for other in rows)]
    return sorted(front, key=lambda row: [row[cost] for cost in costs])


def choose(rows: Sequence[StudyRow], target: StudyTarget) -> tuple[StudyRow | None, StudyRow | None]:
    """Choose a row on the Pareto front of milliseconds a frame and megabytes.

    Returns (row, None) where one meets the target, (None, row) with the row that misses it least where none does, and (None, None)
    without rows. Among rows that meet a target PSNR (dB), the one with the fewest megabytes is chosen of those that take at most
    SAME_TIME_RATIO times the fewest milliseconds a frame. Without a target PSNR, the row with the highest PSNR is chosen.
    """
    front = pareto_front(rows, "ms", "megabytes")
    if not front:
        return None, None
    enough = [row for row in front if target.misses(row) == 0]
    if not enough:
        return None, min(front, key=target.misses)
    if target.db is None:
        return max(enough, key=lambda row: float(row["psnr"])), None
    fastest = min(row["ms"] for row in enough)
    return min((row for row in enough if row["ms"] <= SAME_TIME_RATIO * fastest), key=lambda row: float(row["megabytes"])), None
