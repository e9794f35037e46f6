"""Files and folders that are either whole or not there (hard case 60), and JSON that says what is wrong."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import platform
import re
import shutil
import tempfile
import threading
import time
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled, SnergError
from .guard import check_file, reading, why

MAX_JSON_BYTES = 2**25  # 30,000 cameras with all that is told of them; parsed, JSON takes up to thirty times its bytes
MARK = ".snerg"  # in every folder that we write, from its beginning: only what has it is ever replaced or deleted
MARK_TEXT = "Written by SNeRG for Blender; replaced whole by the next export here.\n"
HALF_MARK = re.compile(r"\.\.snerg\.[0-9a-f]{8}\.part")  # all that is in a folder of ours if its first write was killed
ABANDONED = 3600  # seconds after which a half-written folder is nobody's: its process was killed
SAVING = threading.RLock()
"""Held while a result is put in its place or saved so that it is not lost: a process that is asked to stop waits for it."""
_unfinished: set[Path] = set()  # temporary folders that this process is filling
REMOVING = 5  # times that a folder is deleted where threads go on writing in it
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
    """A folder beside `path` to write in, with our mark, that is gone afterwards; those that kills left are tidied first."""
    _tidy(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    _unfinished.add(temporary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        (temporary / MARK).write_text(MARK_TEXT)
        yield temporary
    finally:
        _remove(temporary)  # half of a result, or the one that was there before
        _unfinished.discard(temporary)


def remove_unfinished() -> None:
    """Delete what this process is writing: it ends, in the middle of it. Threads may still be writing there for a moment."""
    for folder in list(_unfinished):
        for _ in range(REMOVING):
            _remove(folder)
            if not folder.exists():
                break


def _remove(folder: Path) -> None:
    """Delete a temporary folder, the mark last: what a kill leaves of it is still known as ours."""
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


def check_own(path: Path) -> None:
    """Raise SnergError unless `path` is a file itself: what a link points to may be somebody's secret, and must not be published."""
    if path.is_symlink() or not path.is_file():
        raise SnergError(f"{path} is a link or no file, and only files of the scene's own are published; put a copy of the file there.")


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of any shape as an uncompressed .npz, whole or not at all, without a copy in memory.

    Raises SnergError as `new_file` does.
    """
    format: Any = np.lib.format  # NumPy gives its writer no types
    with new_file(path) as file, zipfile.ZipFile(file, "w") as archive:  # np.savez leaves it open where the disk is full
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as part:
                format.write_array(part, np.asarray(array), allow_pickle=False)


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
    try:
        with _temporary(path) as temporary:
            yield temporary
            _flush(temporary)
            with SAVING:
                _swap(temporary, path)
    except OSError as error:
        raise cannot_write(path, error) from error


def put_in_place(new: Path, path: Path, keep: Path | None = None) -> None:
    """A finished folder of ours takes the place of `path`, whole, in one step where the system has one (see new_folder).

    What was there goes to `keep`, in place of a folder of ours there, or is deleted where that is None.
    Raises SnergError when it cannot; then `new` and `path` are as they were.
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
    """Delete a folder that bears our mark, and nothing that is not one."""
    if is_ours(folder):
        _remove(folder)


T = TypeVar("T")
READS = 20  # of a folder that is replaced again and again


def one_generation(folder: Path, read: Callable[[], T]) -> T:
    """What `read` gives of a folder (or file) that other processes may replace meanwhile: of one generation of it, never of two.

    It is read again where it was replaced. Raises what `read` raises, and SnergError where it is replaced in every read.
    """
    for _ in range(READS):
        with _held(folder) as same:
            try:
                result = read()
            except Exception as error:
                if isinstance(error, Cancelled) or same():
                    raise
                continue  # half of it was gone
            if same():
                return result
    raise SnergError(f"{folder} is replaced again and again while it is read; wait for what writes it, or stop that.")


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[Callable[[], bool]]:
    """Whether the same folder is still there: it is held open where the system can, so that no other gets its number."""
    before = _status(folder)
    descriptor = None
    if os.name == "posix" and before is not None:
        with contextlib.suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_NONBLOCK)  # a pipe must not hold us up
            before = os.fstat(descriptor)
    try:
        yield lambda: _same(before, _status(folder))
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _status(path: Path) -> os.stat_result | None:
    try:
        return os.stat(path)
    except (OSError, ValueError):
        return None


def _same(before: os.stat_result | None, now: os.stat_result | None) -> bool:
    return before is now if before is None or now is None else os.path.samestat(before, now)


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
        old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
        os.replace(path, old)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(old, path)
            raise
        with contextlib.suppress(OSError):  # the result is in its place; what was there is tidied later
            os.replace(old, new)
    _flush_swap(path)


def _flush_swap(path: Path) -> None:
    """The entry of a result that is in its place, to the disk. A disk that refuses this has it all the same, if not after a power cut."""
    if os.name == "posix":
        with contextlib.suppress(OSError):
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
    """Put back what a kill between two renames left aside, and delete what kills left half-written: of ours alone, see MARK."""
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
    """Whether it is a folder, and no link to one, that bears our mark."""
    return folder.is_dir() and not folder.is_symlink() and (folder / MARK).is_file()


def check_replaceable(path: Path) -> None:
    """Raise SnergError unless `path` can be created or is an earlier result of ours (or empty)."""
    if path.is_dir():
        if not (path / MARK).exists() and not all(HALF_MARK.fullmatch(one.name) for one in path.iterdir()):
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


def folder_bytes(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return path.stat().st_size if path.is_file() else sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
