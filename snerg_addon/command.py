"""`blender --command snerg VERB ...`: the same command line as outside Blender."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Sequence


def run(arguments: Sequence[str]) -> int:
    """Run a verb with Blender's own Python and return the exit code."""
    from ..core.cli import main

    _flush_banner()
    code = main(list(arguments))
    sys.stdout.flush()
    return code


def _flush_banner() -> None:
    """Let out what Blender itself has printed: held back in a pipe, its version would follow the result's last line."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no library without a name
        ctypes.CDLL(None).fflush(None)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("ucrtbase").fflush(None)
