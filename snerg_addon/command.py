"""`blender --command snerg VERB ...`: the same command line as outside Blender."""

from __future__ import annotations

from collections.abc import Sequence


def run(arguments: Sequence[str]) -> int:
    """Run a verb with Blender's own Python and return the exit code."""
    from ..core.cli import main

    return main(list(arguments))
