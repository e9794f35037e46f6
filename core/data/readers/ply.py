"""Reads points with colours from a PLY file, text or binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...io.guard import check_file, reading
from ...io.schema import FAR

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_LINES = 500
MAX_BYTES = 2**32


def read_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """(vertices [N, 3] float64, their colours [N, 3] uint8 or None where the file has none) of a PLY file.

    Raises SnergError when the file is damaged or cut short.
    """
    check_file(path, MAX_BYTES)
    with reading(path, "write the file again", f"The points {path}"):
        with open(path, "rb") as file:
            order, count, kinds = _header(file)
            if not {"x", "y", "z"} <= kinds.keys():
                raise ValueError("its vertices have no x, y, z")
            size = path.stat().st_size - file.tell()
            if order:
                table: Any = _binary(file, size, count, np.dtype([(name, order + kind) for name, kind in kinds.items()]))
            else:
                table = _text(file, size, count, list(kinds))
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        kept = (np.abs(points) <= FAR).all(axis=-1)  # false for NaN
        colours = None
        if {"red", "green", "blue"} <= kinds.keys():
            values = np.stack([table[c] for c in ("red", "green", "blue")], axis=-1)[kept]
            colours = np.nan_to_num(values.clip(0, 255)).astype(np.uint8)
        return points[kept], colours


def _header(file: BinaryIO) -> tuple[str, int, dict[str, str]]:
    """(byte order, '' for text; number of vertices; types of a vertex's properties by name) from the header."""
    if file.readline(10).strip() != b"ply":
        raise ValueError("it is not a PLY file")
    order, count, kinds, element = "", -1, {}, ""
    for _ in range(MAX_HEADER_LINES):
        words = file.readline(1000).decode("ascii").split()
        if words[:1] == ["format"]:
            order = ORDERS[words[1]]
        elif words[:1] == ["element"]:
            if count < 0 and words[1] != "vertex":
                raise ValueError("its vertices do not come first")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            kinds[words[2]] = TYPES[words[1]]
        elif words[:1] == ["end_header"]:
            if count < 0 or not kinds:
                raise ValueError("it has no vertices")
            return order, count, kinds
    raise ValueError("its header does not end")


def _binary(file: BinaryIO, size: int, count: int, kind: np.dtype[Any]) -> NDArray[Any]:
    if count * kind.itemsize > size:  # before anything is allocated for it
        raise ValueError(f"it says that it has {count} vertices, more than its size allows")
    return np.frombuffer(file.read(count * kind.itemsize), kind)


def _text(file: BinaryIO, size: int, count: int, names: list[str]) -> dict[str, NDArray[Any]]:
    if count * 2 * len(names) > size + 1:
        raise ValueError(f"it says that it has {count} vertices, more than its size allows")
    values = np.array([file.readline(10000).split()[: len(names)] for _ in range(count)], np.float64).reshape(count, len(names))
    return {name: values[:, i] for i, name in enumerate(names)}
