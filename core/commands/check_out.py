"""Checks where a command may write its result."""

from __future__ import annotations

from pathlib import Path

from ..errors import SnergError
from ..io.files import check_replaceable
from ..nerf.checkpoint import is_field


def check_out(out: Path, kind: str, *sources: Path) -> None:
    """Raise SnergError when a result of `kind` cannot be written to `out`, or would replace one of `sources`, a dataset or a field."""
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
