"""Error handling of all readers: a damaged or malicious file leads to one SnergError and bounded memory (hard cases 61, 62)."""

from __future__ import annotations

import os
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError, clean

MAX_REASON = 200  # characters of a decoder's message that are quoted
MAX_MEMBERS = 4096  # arrays of an .npz
MAX_SMALL_UNPACKED = 2**24  # bytes that any .npz may unpack to
MAX_EXPANSION = 8  # unpacked bytes per packed byte, beyond MAX_SMALL_UNPACKED; arrays that SNeRG writes are not compressed
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes; the output of others is not bounded by their input


@contextmanager
def reading(path: Path, advice: str, subject: str = "") -> Iterator[None]:
    """Turn any exception of decoding `path` into one SnergError; a SnergError, Cancelled included, passes unchanged.

    advice: what to do when the file is damaged, such as 'export it again'. subject: the subject of the sentence; the path if empty.
    """
    subject = subject or str(path)
    try:
        yield
    except SnergError:
        raise
    except FileNotFoundError as error:
        raise SnergError(f"{subject} does not exist; check the path.") from error
    except MemoryError as error:
        raise SnergError(f"{subject} needs more memory than is free; {advice}, or close other programs.") from error
    except Exception as error:  # decoders raise any exception: zlib.error, TokenError, OverflowError, RecursionError, struct.error ...
        if isinstance(error, OSError) and error.errno is not None:
            raise SnergError(f"Cannot read {path} ({error.strerror or error}).") from error
        raise SnergError(f"{subject} is damaged or cut short ({why(error)}); {advice}.") from error


def why(error: BaseException) -> str:
    """The reason that an exception gives, as part of a sentence."""
    kind, text = type(error).__name__, clean(str(error), MAX_REASON)
    return text if text and type(error) in (ValueError, OSError) else f"{kind}: {text}" if text else kind


def check_file(path: Path, most: int) -> int:
    """The size of a regular file in bytes. Raises SnergError when it is missing, not a regular file, or larger than `most` bytes."""
    try:
        known = os.stat(path)
    except FileNotFoundError as error:
        raise SnergError(f"{path} does not exist; check the path.") from error
    except (OSError, ValueError) as error:
        raise SnergError(f"Cannot read {path} ({getattr(error, 'strerror', None) or error}).") from error
    if stat.S_ISDIR(known.st_mode):
        raise SnergError(f"{path} is a folder where a file is needed; check the path.")
    if not stat.S_ISREG(known.st_mode):
        raise SnergError(f"{path} is a device or a pipe, not a file; copy what it holds to a file first.")
    if known.st_size > most:
        raise SnergError(f"{path} is larger than {most >> 20} MiB; it cannot be a file that SNeRG reads.")
    return known.st_size


def read_arrays(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """The arrays, of any shape, of an .npz of at most `most` bytes, by name. Pickles are refused.

    The unpacked size is checked from the headers before anything is unpacked. Raises SnergError as `check_file` does, and whatever
    the decoder raises: call it in `reading`.
    """
    size = check_file(path, most)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if len(members) > MAX_MEMBERS or total > MAX_SMALL_UNPACKED + MAX_EXPANSION * size:
            raise ValueError(f"{size} bytes would unpack to {len(members)} arrays of {total} bytes, which no file of SNeRG's does")
        return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """The array of one member. Raises ValueError when its length differs from its header, and whatever the decoder raises."""
    if member.compress_type not in METHODS:
        raise ValueError(f"{member.filename} is packed by method {member.compress_type}")
    with archive.open(member) as file:
        header: Any = np.lib.format  # NumPy gives these readers no types
        version = header.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{member.filename} has version {version} of NumPy's format")
        read_header = header.read_array_header_1_0 if version == (1, 0) else header.read_array_header_2_0
        shape, fortran, kind = read_header(file)
        count = 1
        for length in shape:
            count *= length
        if kind.hasobject or kind.itemsize == 0 or min(shape, default=0) < 0 or count * kind.itemsize > member.file_size:
            raise ValueError(f"{member.filename} says that it is {shape} {kind}, more than it holds")
        data = file.read(count * kind.itemsize + 1)
        if len(data) != count * kind.itemsize:
            raise ValueError(f"{member.filename} says that it is {shape} {kind}, but has {len(data)} bytes")
    values = np.frombuffer(bytearray(data), kind)
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
