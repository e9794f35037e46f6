"""Files and folders that are written whole or not at all, also after a kill or a power cut (hard case 60)."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import re
import shutil
import tempfile
import threading
import time
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError

MARK = ".snerg"  # file in every folder that SNeRG writes, from the start: only folders that contain it are replaced or deleted
MARK_TEXT = "Written by SNeRG for Blender; replaced whole by the next export here.\n"
HALF_MARK = re.compile(r"\.\.snerg\.[0-9a-f]{8}\.part")  # the only content of our folder if its process was killed while writing MARK
ABANDONED = 3600  # seconds after which an unfinished folder is deleted: its process was killed
SAVING = threading.RLock()
"""Held while a result is swapped into its place or saved: a process that is asked to stop waits until it is released."""
_unfinished: set[Path] = set()  # temporary folders that this process is filling
REMOVE_ATTEMPTS = 5  # to delete a folder in which threads are still writing
AT_FDCWD, EXCHANGE = -100, 2  # constants of the system calls renameat2 (Linux) and renamex_np (macOS)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to a file, whole or not at all. Raises SnergError as `new_file` does."""
    with new_file(path) as file:
        file.write(data)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A temporary file beside `path` to write to; at the end it is flushed to the disk and replaces `path` in one step.

    A reader of `path` gets the old file or the new one, never a part of it.

    Raises SnergError when the folder cannot be written or the disk is full.
    """
    try:
        with _temporary(path) as folder:
            temporary = folder / "file"
            with open(temporary, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            with SAVING:
                os.replace(temporary, path)
                _flush_swap(path)
    except OSError as error:
        raise cannot_write(path, error) from error


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A temporary folder with MARK beside `path`, deleted at the end. Folders that killed processes left are cleaned up first."""
    _tidy(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    _unfinished.add(temporary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        (temporary / MARK).write_text(MARK_TEXT)
        yield temporary
    finally:
        _remove(temporary)  # an unfinished result, or the previous one
        _unfinished.discard(temporary)


def remove_unfinished() -> None:
    """Delete the temporary folders of this process, which is about to end. Its threads may still be writing to them."""
    for folder in list(_unfinished):
        for _ in range(REMOVE_ATTEMPTS):
            _remove(folder)
            if not folder.exists():
                break


def _remove(folder: Path) -> None:
    """Delete a temporary folder, MARK last, so that what remains after a kill is still recognised as ours."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != MARK:
                path.unlink()
    with contextlib.suppress(OSError):
        if all(path.name == MARK for path in folder.iterdir()):
            (folder / MARK).unlink(missing_ok=True)
            folder.rmdir()


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of any shape as an uncompressed .npz, whole or not at all, without a copy in memory.

    Raises SnergError as `new_file` does.
    """
    format: Any = np.lib.format  # NumPy gives its writer no types
    with new_file(path) as file, zipfile.ZipFile(file, "w") as archive:  # np.savez leaves the file open when the disk is full
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as part:
                format.write_array(part, np.asarray(array), allow_pickle=False)


def cannot_write(path: Path, error: OSError) -> SnergError:
    """The error for a path that cannot be written."""
    return SnergError(f"Cannot write {path} ({error.strerror or error}); choose a folder that you can write to, with space left.")


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder to fill, which replaces `path` at the end, whole or not at all (hard case 60).

    The folder is flushed to the disk and exchanged with `path` in one step, so that a reader finds the old folder or the new one,
    also after a kill or a power cut. Windows has no such step: for an instant neither is there, and if the process is killed then,
    the next write to `path` restores the old folder.
    Raises SnergError when the parent cannot be written, the disk is full, or `path` is a file, or a folder that was not written by
    SNeRG (so that `--out ~` deletes nothing).
    """
    path = Path(os.path.realpath(path))  # follow a link, so that the link itself is kept
    check_replaceable(path)
    try:
        with _temporary(path) as temporary:
            yield temporary
            _flush(temporary)
            with SAVING:
                _swap(temporary, path)
    except OSError as error:
        raise cannot_write(path, error) from error


def put_in_place(new: Path, path: Path, keep: Path | None = None) -> None:
    """Move the finished folder `new` to `path`, in one step where the system has one (see new_folder).

    The previous folder at `path` is moved to `keep`; a folder that SNeRG wrote at `keep` is deleted first. The previous folder is
    deleted if `keep` is None or the move to `keep` fails.
    Raises SnergError when `path` cannot be replaced; `new` and `path` are then unchanged.
    """
    path = Path(os.path.realpath(path))
    check_replaceable(path)
    _tidy(path)
    try:
        _flush(new)
        with SAVING:
            _swap(new, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    if keep is not None and new.exists():
        with contextlib.suppress(OSError):
            discard(keep)
            os.replace(new, keep)
    _remove(new)


def discard(folder: Path) -> None:
    """Delete a folder if it contains MARK; leave anything else."""
    if is_ours(folder):
        _remove(folder)


def _flush(folder: Path) -> None:
    """Flush all files of a folder to the disk."""
    for path in folder.rglob("*"):
        if path.is_file():
            with open(path, "r+b") as file:
                os.fsync(file.fileno())
    if os.name == "posix":  # other systems cannot open folders
        for path in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            _flush_entries(path)


def _flush_entries(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _swap(new: Path, path: Path) -> None:
    """Move the folder `new` to `path`, and the previous folder at `path` to where `new` was."""
    if not path.exists():
        os.replace(new, path)
    elif not _exchange(new, path):
        old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
        os.replace(path, old)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(old, path)
            raise
        with contextlib.suppress(OSError):  # the result is in its place; the old folder is cleaned up later
            os.replace(old, new)
    _flush_swap(path)


def _flush_swap(path: Path) -> None:
    """Flush the directory entry of `path` to the disk. A disk that cannot do this may lose the entry in a power cut, and only then."""
    if os.name == "posix":
        with contextlib.suppress(OSError):
            _flush_entries(path.parent)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders in one step; False where the system or the file system cannot."""
    names = os.fsencode(a), os.fsencode(b)
    with contextlib.suppress(AttributeError, OSError, TypeError):  # the C library lacks the call, or there is none
        library = ctypes.CDLL(None)
        if platform.system() == "Linux":
            return bool(library.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], EXCHANGE) == 0)
        if platform.system() == "Darwin":
            return bool(library.renamex_np(*names, EXCHANGE) == 0)
    return False


def _tidy(path: Path) -> None:
    """Restore a folder that a kill between two renames left aside, and delete abandoned temporary folders; only those with MARK."""
    name = re.compile(re.escape(f".{path.name}.") + r"[0-9a-f]{8}\.(part|old)")
    with contextlib.suppress(OSError):  # a folder that is not there or may not be read
        left = [folder for folder in path.parent.iterdir() if name.fullmatch(folder.name) and is_ours(folder)]
        aside = [folder for folder in left if folder.suffix == ".old"]
        if aside and not path.exists():
            os.replace(aside.pop(), path)
        for folder in left:
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > ABANDONED:
                    _remove(folder)


def is_ours(folder: Path) -> bool:
    """Whether `folder` is a folder, not a link to one, and contains MARK."""
    return folder.is_dir() and not folder.is_symlink() and (folder / MARK).is_file()


def check_replaceable(path: Path) -> None:
    """Raise SnergError unless `path` can be created, is empty, or was written by SNeRG."""
    if path.is_dir():
        if not (path / MARK).exists() and not all(HALF_MARK.fullmatch(one.name) for one in path.iterdir()):
            raise SnergError(f"The folder {path} holds other files; choose a new or empty folder, so that nothing of yours is replaced.")
    elif path.exists():
        raise SnergError(f"{path} is a file; choose a folder.")
    parent = path
    while not parent.exists():
        parent = parent.parent
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".snerg-", dir=parent))  # os.access is not enough: it is always true for root
    except OSError as error:
        raise SnergError(f"Cannot write {path} ({parent} is not a folder that you can write to); choose another.") from error


def folder_bytes(path: Path) -> int:
    """Size in bytes of a file, or of all files in a folder."""
    return path.stat().st_size if path.is_file() else sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
