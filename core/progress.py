"""How long work reports its progress, and how it learns that it should stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Progress = Callable[[float, str], None]
"""Long work calls it as progress(fraction, text): the fraction done in [0, 1] and a few words. It may raise Cancelled."""


class Note(str):
    """A sticky text: it stays on the screen, and the next text does not replace it.

    Work passes one in place of a plain text, `progress(fraction, Note("..."))`. It is a `str` so that every function between the work
    and the watcher (`within`, wrappers, lambdas) hands it on unchanged; `ProgressEvent.of` turns it into `sticky=True`.
    """

    __slots__ = ()


@dataclass(frozen=True)
class ProgressEvent:
    """One report of progress, as the terminal, the panel and the files of a job have it.

    fraction: done, in [0, 1]. text: a few words for people. sticky: whether the text stays on the screen.
    """

    fraction: float
    text: str
    sticky: bool = False

    @classmethod
    def of(cls, fraction: float, text: str) -> ProgressEvent:
        """The event of a call progress(fraction, text). The fraction is clamped to [0, 1]."""
        return cls(min(max(float(fraction), 0.0), 1.0), str(text), isinstance(text, Note))

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> ProgressEvent | None:
        """The event that `to_json` wrote; None where the object is something else."""
        fraction = value.get("progress")
        if not isinstance(fraction, int | float):
            return None
        return cls(float(fraction), str(value.get("message", "")), value.get("note") is True)

    def to_json(self) -> dict[str, Any]:
        """{"progress", "message"}, and "note": true where it is sticky."""
        return {"progress": self.fraction, "message": self.text, **({"note": True} if self.sticky else {})}


def silent(fraction: float, text: str, /) -> None:
    """Progress that nobody watches."""


def within(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part of the work, which takes the whole from the fraction `start` to the fraction `end`."""
    return lambda fraction, text: progress(start + (end - start) * min(max(fraction, 0.0), 1.0), text)
