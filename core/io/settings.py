"""Validation of settings: one sentence that says which one is wrong, and what it may be. The readers of files have schema.py."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import numpy as np

from ..errors import SnergError
from .schema import shown


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number: an int or one of NumPy's."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_whole(what: str, value: Any, least: int, most: int) -> None:
    """Raise SnergError unless a value is a whole number from `least` to `most`. what: its name, with which the sentence begins."""
    if not is_whole(value) or not least <= int(value) <= most:
        raise SnergError(f"{what} is {shown(value)}; choose a whole number from {least} to {most}.")


def check_number(what: str, value: Any, least: float, most: float) -> None:
    """Raise SnergError unless a value is a number from `least` to `most`, which NaN is not."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real) or not least <= float(value) <= most:
        raise SnergError(f"{what} is {shown(value)}; choose a number from {least:g} to {most:g}.")


def check_flag(what: str, value: Any) -> None:
    """Raise SnergError unless a value is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise SnergError(f"{what} is {shown(value)}; choose True or False.")


def check_colour(what: str, value: Any) -> None:
    """Raise SnergError unless a value is three numbers from 0 to 1."""
    if not isinstance(value, tuple | list) or len(value) != 3:
        raise SnergError(f"{what} is {shown(value)}; choose three numbers from 0 to 1.")
    for part in value:
        check_number(what, part, 0, 1)
