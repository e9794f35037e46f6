"""Files and folders that are either whole or not there (hard case 60), and JSON that says what is wrong."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .errors import SnergError

MAX_JSON_BYTES = 2**28


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


def cannot_write(path: Path, error: OSError) -> SnergError:
    """The sentence for a path that the system would not let us write."""
    return SnergError(f"Cannot write {path} ({error.strerror or error}); choose a folder that you can write to, with space left.")


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder to fill that takes the place of `path` at the end, whole, or not at all.

    Raises SnergError when the parent cannot be written, or when `path` is a file, or a folder that holds
    something other than what an earlier export left (so that `--out ~` deletes nothing).
    """
    path = Path(os.path.abspath(path))
    check_replaceable(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.mkdir()
        except OSError as error:
            raise cannot_write(path, error) from error
        try:
            yield temporary
            (temporary / MARK).write_text("Written by SNeRG for Blender; replaced whole by the next export here.\n")
            if path.exists():
                os.replace(path, old)
            os.replace(temporary, path)
        except OSError as error:
            if old.exists() and not path.exists():
                os.replace(old, path)
            raise cannot_write(path, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)


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
    """Parse a JSON file. Raises SnergError when it is missing, too large or not JSON."""
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise SnergError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB; it cannot be a file that SNeRG reads.")
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise SnergError(f"{path} does not exist; check the path.") from error
    except OSError as error:
        raise SnergError(f"Cannot read {path} ({error.strerror}).") from error
    except (ValueError, RecursionError) as error:
        raise SnergError(f"{path} is not valid JSON ({error}); write it again.") from error


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
