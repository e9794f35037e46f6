"""Checks where a command may write its result."""

from __future__ import annotations

from pathlib import Path

from ..errors import SnergError
from ..io.files import check_replaceable
from ..nerf.checkpoint import is_field


def check_out(out: Path, kind: str, *sources: Path) -> None:
    """Check that a result of `kind` ('field', 'scene', 'page', ...) may be written to the folder `out`.

    Raises SnergError when `out` is one of `sources` or contains one, when it is a file or a folder that SNeRG did not write, and when it
    holds a dataset or a field and `kind` is another.
    """
    there = out.resolve()
    for source in sources:
        other = source.resolve()
        if there == other or there in other.parents:
            raise SnergError(f"Writing to {out} would replace {source}, which it is made from; choose another folder.")
    check_replaceable(out.absolute())
    if out.is_dir() and any(out.iterdir()):
        for old, found in (("dataset", any(out.glob("transforms*.json"))), ("field", is_field(out))):
            if found and old != kind:
                raise SnergError(f"The folder {out} holds a {old}; choose another, so that it is not replaced.")
