"""Where new projects go: a pattern such as `//{file}.snerg/{scene}`, which the preferences may change."""

from __future__ import annotations

import os
import re
import string
from pathlib import Path

DEFAULT = "//{file}.snerg/{scene}"
NAMES = ("file", "scene")  # that a pattern may hold: the names of the .blend file, without .blend, and of the scene
ILLEGAL = re.compile(r'[<>"|?*\x00-\x1f]')  # in the name of a folder on Windows
MAX_NAME = 60  # characters of a scene's name in the name of its folder: paths are limited on Windows


def problem(pattern: str) -> str:
    """What is wrong with a pattern, a sentence; '' for a good one, and for an empty one, which stands for DEFAULT."""
    pattern = pattern.strip()
    if not pattern:
        return ""
    try:
        parts = list(string.Formatter().parse(pattern))
    except ValueError:
        return f"The pattern {pattern} has a brace without its partner; write {{file}} and {{scene}}."
    for _, name, form, conversion in parts:
        if name is not None and (name not in NAMES or form or conversion):
            return f"The pattern {pattern} has {{{name}}} in it; only {{file}} and {{scene}} have a meaning."
    if not pattern.startswith("//") and not os.path.isabs(pattern):
        return f"The pattern {pattern} begins nowhere; begin with // for the folder of the .blend file, or with a whole path."
    rest = pattern[2:] if pattern.startswith("//") else os.path.splitdrive(pattern)[1]
    if ILLEGAL.search(rest) or ":" in rest:
        return f"The pattern {pattern} has a character that no folder's name may have: one of < > : \" | ? *"
    if not any(part.strip(" .") for part in re.split(r"[/\\]", rest)):
        return f"The pattern {pattern} names no folder of its own; add one, such as //snerg/{{file}}/{{scene}}."
    return ""


def folder_of_pattern(pattern: str, blend: Path, scene: str) -> Path:
    """The folder for a scene of a .blend file; by DEFAULT where the pattern has a problem or is empty."""
    if not pattern.strip() or problem(pattern):
        pattern = DEFAULT
    filled = pattern.strip().format(file=blend.stem, scene=safe_name(scene)[:MAX_NAME] or "Scene")
    return Path(os.path.normpath(blend.parent / filled[2:])) if filled.startswith("//") else Path(os.path.normpath(filled))


def safe_name(name: str) -> str:
    """A data-block's name without the characters that a folder's name may not have."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._ ")
