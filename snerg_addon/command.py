"""`blender --command snerg COMMAND ...`: the same command line as outside Blender."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Sequence


def run(arguments: Sequence[str]) -> int:
    """Run a command in this process and return the exit code."""
    from ..core.cli import main

    _flush_banner()
    code = main(list(arguments))
    sys.stdout.flush()
    return code


def _flush_banner() -> None:
    """Flush C's standard output, where Blender printed its version: in a pipe it would otherwise follow the result."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no library without a name
        ctypes.CDLL(None).fflush(None)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("ucrtbase").fflush(None)
