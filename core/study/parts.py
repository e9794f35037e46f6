"""Locks and notes of a study that is measured in parts, in several processes or on several machines that share its folder."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ..io.files import write_bytes
from ..io.json_files import json_bytes, read_json
from ..io.lock import one_writer
from .machine import describe_machine
from .plan import Part

PATIENCE = 60.0  # seconds to wait for other parts that begin at the same time; each needs some milliseconds


@contextlib.contextmanager
def part_writer(out: Path, part: Part, begin: Callable[[], None]) -> Iterator[None]:
    """Hold the lock of a part of the study in `out`. begin: makes the folder; no other process writes it meanwhile.

    Raises SnergError when the whole study, or the same part, is being measured elsewhere, and what `begin` raises.
    """
    with contextlib.ExitStack() as stack:
        with one_writer(out, "a study", PATIENCE):
            begin()
            stack.enter_context(one_writer(_folder(out) / part.name, f"part {part} of a study"))
        yield


@contextlib.contextmanager
def no_parts(out: Path) -> Iterator[None]:
    """Hold the locks of all parts of the study in `out`, which are left where a part was killed.

    The caller holds the lock of the study, so that no part begins. Raises SnergError when one is being measured.
    """
    with contextlib.ExitStack() as stack:
        for lock in sorted(_folder(out).glob(".*-of-*.lock")):
            stack.enter_context(one_writer(_folder(out) / lock.name[1 : -len(".lock")], "a study"))
        yield


def note_part(out: Path, part: Part) -> None:
    """Record on which machine a part was measured."""
    write_bytes(_folder(out) / f"{part.name}.json", json_bytes({"part": str(part), "machine": describe_machine()}))


def elsewhere(out: Path) -> list[str]:
    """A sentence about parts that were measured on machines of another kind than this one; [] where there are none."""
    here, others = describe_machine(), []
    for path in sorted(_folder(out).glob("*-of-*.json")):
        known: Any = read_json(path)
        if isinstance(known, dict) and known.get("machine") != here:
            others.append(str(known.get("part")))
    if not others:
        return []
    were = "Part {} was" if len(others) == 1 else "Parts {} were"
    return [f"{were.format(', '.join(others))} measured on machines of another kind: compare times only within a part."]


def _folder(out: Path) -> Path:
    return out / "parts"
