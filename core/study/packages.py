"""Packages that only some commands need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import SnergError


@contextmanager
def needs_package(name: str, use: str) -> Iterator[None]:
    """Raise SnergError in place of the ImportError of a missing package. use: what needs it, in the plural, at a sentence's start."""
    try:
        yield
    except ImportError as error:
        raise SnergError(f"{use} need the package {name}, which is not installed: run 'pip install {name}'.") from error
