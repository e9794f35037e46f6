"""Times of a bake: the seconds of each stage, and the time that is left."""

from __future__ import annotations

import time

from ..progress import Progress
from ..units import duration

TRUSTED_SECONDS, TRUSTED_FRACTION = 2.0, 0.02  # done before the remaining time is estimated: it would jump about


class TimeLeft:
    """A Progress that adds the remaining time to the text, once enough is done to tell, assuming that the mean rate goes on."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.first: tuple[float, float] | None = None

    def __call__(self, fraction: float, what: str) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = now, fraction
        gone, done = now - self.first[0], fraction - self.first[1]
        if gone > TRUSTED_SECONDS and done > TRUSTED_FRACTION:
            left = gone * (1 - fraction) / done
            what += f", {duration(max(round(left), 1))} left"
        self.progress(fraction, what)


class StageTimer:
    """Measures the seconds of each stage, the time from one lap to the next."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Record the time since the last lap as that of a stage."""
        now = time.perf_counter()
        self.laps[name] = round(now - self.last, 3)
        self.last = now
