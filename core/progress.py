"""How long work tells of itself, and is told to stop."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with (fraction 0..1, message); may raise Cancelled."""


def silent(fraction: float, message: str, /) -> None:
    """Progress that nobody watches."""


def within(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part of the work, from `start` to `end` of the whole."""
    return lambda fraction, message: progress(start + (end - start) * min(max(fraction, 0.0), 1.0), message)


class Note(str):
    """A message to keep on the screen: the next one must not be written over it, nor may it be left out."""

    __slots__ = ()
