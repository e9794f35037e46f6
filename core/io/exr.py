"""OpenEXR files of named channels, such as depth and other passes of a renderer: linear numbers, not pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from .files import cannot_write, write_bytes
from .guard import check_file, reading
from .images import MAX_BYTES, check_size


def has_openimageio() -> bool:
    """Whether OpenImageIO can be imported, which reads and writes OpenEXR. Blender brings it."""
    try:
        import OpenImageIO  # noqa: F401
    except ImportError:
        return False
    return True


def read_channels(path: Path) -> dict[str, NDArray[Any]]:
    """Every channel of every part of an OpenEXR file by its name, float32 [H, W]; 0 outside of a part's data window.

    Raises SnergError when the file is missing, damaged or too large, or OpenImageIO is not installed.
    """
    oiio = _open_image_io(path)
    size = check_file(path, MAX_BYTES)
    found: dict[str, NDArray[Any]] = {}
    with reading(path, "write it again"):
        file = oiio.ImageInput.open(str(path))
        if file is None:
            raise ValueError(" ".join(str(oiio.geterror()).split()))
        try:
            part = 0
            while file.seek_subimage(part, 0):
                spec = file.spec()
                check_size(path, spec.full_width, spec.full_height, size)
                check_size(path, spec.width, spec.height, size)
                if spec.deep:
                    raise ValueError("it is a deep one")
                found |= _part(file, part, spec)
                part += 1
        finally:
            file.close()
    return found


def _part(file: Any, part: int, spec: Any) -> dict[str, NDArray[Any]]:
    values = file.read_image(part, 0, 0, spec.nchannels, "float")
    if values is None:
        raise ValueError(" ".join(str(file.geterror()).split()))
    values = np.asarray(values, np.float32).reshape(spec.height, spec.width, spec.nchannels)
    whole = np.zeros((spec.full_height, spec.full_width, spec.nchannels), np.float32)
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    left, top = max(x, 0), max(y, 0)
    inner = values[top - y : max(spec.full_height - y, 0), left - x : max(spec.full_width - x, 0)]
    whole[top : top + inner.shape[0], left : left + inner.shape[1]] = inner
    return {name: whole[..., index] for index, name in enumerate(spec.channelnames)}


def write_channels(path: Path, channels: Mapping[str, NDArray[Any]], half: bool = False) -> None:
    """Write channels [H, W] by name as an OpenEXR file, whole or not at all: 32 bits a value, or 16 with `half`; losslessly compressed.

    Raises SnergError when it cannot be written, or OpenImageIO is not installed.
    """
    oiio = _open_image_io(path)
    values = np.stack(list(channels.values()), axis=-1).astype(np.float16 if half else np.float32)
    height, width, count = values.shape
    spec = oiio.ImageSpec(width, height, count, "half" if half else "float")
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # else the time of writing: the same values must give the same bytes
    beside = path.with_name(f".{path.stem}.part.exr")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        output = oiio.ImageOutput.create(str(beside))
        if output is None or not output.open(str(beside), spec) or not output.write_image(values) or not output.close():
            raise OSError(" ".join(str((output or oiio).geterror()).split()) or "OpenImageIO refused")
        write_bytes(path, beside.read_bytes())
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        if beside.exists():
            os.unlink(beside)


def _open_image_io(path: Path) -> Any:
    try:
        import OpenImageIO
    except ImportError as error:
        raise SnergError(f"{path} is OpenEXR, which needs the package OpenImageIO: run 'pip install openimageio'.") from error
    return OpenImageIO
