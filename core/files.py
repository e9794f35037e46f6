"""Files and folders that are either whole or not there (hard case 60), and JSON that says what is wrong."""

from __future__ import annotations

import contextlib
import ctypes
import glob
import json
import os
import platform
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .errors import SnergError
from .guard import check_file, reading, why

MAX_JSON_BYTES = 2**25  # 30,000 cameras with all that is told of them; parsed, JSON takes up to thirty times its bytes
ABANDONED = 3600  # seconds after which a half-written folder is nobody's: its process was killed
AT_FDCWD, EXCHANGE = -100, 2  # of renameat2 (Linux) and renamex_np (macOS)


def write_bytes(path: Path, data: bytes) -> None:
    """`data` as a file, whole or not at all. Raises SnergError as `new_file` does."""
    with new_file(path) as file:
        file.write(data)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write beside `path`, flushed to the disk and then swapped with it: the old file or the new one, never half of it.

    Raises SnergError when the folder cannot be written or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Arrays as an .npz, whole or not at all, without a copy in memory. Raises SnergError as `new_file` does."""
    with new_file(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def cannot_write(path: Path, error: OSError) -> SnergError:
    """The sentence for a path that the system would not let us write."""
    return SnergError(f"Cannot write {path} ({error.strerror or error}); choose a folder that you can write to, with space left.")


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder to fill that takes the place of `path` at the end, whole, or not at all (hard case 60).

    It is flushed to the disk and swapped with what is there in one step, so that whoever reads `path`, and whoever finds it
    after a kill or a power cut, has the old folder or the new one. Where the system has no such step (Windows) there is an
    instant without either; a folder lost in it is put back by the next export there.
    Raises SnergError when the parent cannot be written, when the disk is full, or when `path` is a file, or a folder that
    holds something other than what an earlier export left (so that `--out ~` deletes nothing).
    """
    path = Path(os.path.realpath(path))  # through a link, so that it stays one
    check_replaceable(path)
    _tidy(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.mkdir()
            yield temporary
            (temporary / MARK).write_text("Written by SNeRG for Blender; replaced whole by the next export here.\n")
            _flush(temporary)
            _swap(temporary, path)
        except OSError as error:
            raise cannot_write(path, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)  # half a folder, or the one that was there before


def _flush(folder: Path) -> None:
    """All that a folder holds to the disk."""
    for path in folder.rglob("*"):
        if path.is_file():
            with open(path, "r+b") as file:
                os.fsync(file.fileno())
    if os.name == "posix":  # elsewhere folders cannot be opened
        for path in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            _flush_entries(path)


def _flush_entries(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _swap(new: Path, path: Path) -> None:
    """Folder `new` to `path`; what was there goes to where `new` was."""
    if not path.exists():
        os.replace(new, path)
    elif not _exchange(new, path):
        old = new.with_suffix(".old")
        os.replace(path, old)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(old, path)
            raise
        os.replace(old, new)
    if os.name == "posix":
        _flush_entries(path.parent)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two folders in one step; False where the system or the disk's format cannot."""
    names = os.fsencode(a), os.fsencode(b)
    with contextlib.suppress(AttributeError, OSError, TypeError):  # a C library without the call, or none to ask
        library = ctypes.CDLL(None)
        if platform.system() == "Linux":
            return bool(library.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], EXCHANGE) == 0)
        if platform.system() == "Darwin":
            return bool(library.renamex_np(*names, EXCHANGE) == 0)
    return False


def _tidy(path: Path) -> None:
    """Put back what a kill between two renames left aside, and delete what kills left half-written."""
    left = list(path.parent.glob(f".{glob.escape(path.name)}.????????.*")) if path.parent.is_dir() else []
    aside = [folder for folder in left if folder.suffix == ".old"]
    if aside and not path.exists():
        with contextlib.suppress(OSError):
            os.replace(aside.pop(), path)
    for folder in left:
        with contextlib.suppress(OSError):
            if folder.suffix in (".part", ".old") and time.time() - folder.stat().st_mtime > ABANDONED:
                shutil.rmtree(folder)


MARK = ".snerg"


def check_replaceable(path: Path) -> None:
    """Raise SnergError unless `path` can be created or is an earlier result of ours (or empty)."""
    if path.is_dir():
        if any(path.iterdir()) and not (path / MARK).exists():
            raise SnergError(f"The folder {path} holds other files; choose a new or empty folder, so that nothing of yours is replaced.")
    elif path.exists():
        raise SnergError(f"{path} is a file; choose a folder.")
    parent = path
    while not parent.exists():
        parent = parent.parent
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".snerg-", dir=parent))  # asking for permission is not enough: root has it everywhere
    except OSError as error:
        raise SnergError(f"Cannot write {path} ({parent} is not a folder that you can write to); choose another.") from error


def read_json(path: Path) -> Any:
    """Parse a JSON file. Raises SnergError when it is missing, no regular file, too large or not JSON."""
    check_file(path, MAX_JSON_BYTES)
    with reading(path, "write it again"):
        text = path.read_bytes()
        try:
            return json.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise SnergError(f"{path} is not valid JSON ({why(error)}); write it again.") from error


def json_bytes(value: Any) -> bytes:
    """JSON without NaN or infinity (hard case 59). Raises SnergError when the value holds one."""
    try:
        return (json.dumps(value, allow_nan=False, indent=1) + "\n").encode()
    except ValueError as error:
        raise SnergError(f"A value that would be written is not finite ({error}); nothing was written.") from error


def inside(root: Path, name: str, where: str) -> Path:
    """`root / name`, resolved. Raises SnergError when it leaves `root` (hard case 62)."""
    try:
        root = root.resolve()
        path = (root / name).resolve()
        path.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a name too long, a zero byte
        raise SnergError(f"{where} names {name[:200]!r}, which is no path ({error}); rename the file.") from error
    if not path.is_relative_to(root):
        raise SnergError(f"{where} names {name!r}, which lies outside {root}; keep a dataset's files in its own folder.")
    return path
