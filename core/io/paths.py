"""Paths named in files: they may be wrong or malicious, and must stay inside their folder."""

from __future__ import annotations

from pathlib import Path

from ..errors import SnergError


def inside(root: Path, name: str, where: str) -> Path:
    """`root / name`, resolved. Raises SnergError when it is outside `root`, so that a file cannot name others' files (hard case 62)."""
    try:
        root = root.resolve()
        path = (root / name).resolve()
        path.is_file()
        if path.is_symlink():  # from Python 3.13 on, a cycle is resolved as far as it goes
            raise OSError("a cycle of links")
    except (OSError, ValueError, RuntimeError) as error:  # a cycle of links, a name too long, a zero byte
        raise SnergError(f"{where} names {name[:200]!r}, which is no path ({error}); rename the file.") from error
    if not path.is_relative_to(root):
        raise SnergError(f"{where} names {name!r}, which lies outside {root}; keep a dataset's files in its own folder.")
    return path


def check_own(path: Path) -> None:
    """Raise SnergError unless `path` is a regular file: the target of a link may be private and must not be published."""
    if path.is_symlink() or not path.is_file():
        raise SnergError(f"{path} is a link or no file, and only files of the scene's own are published; put a copy of the file there.")
