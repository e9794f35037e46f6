"""Image files of the atlas: PNG, WebP, JPEG XL, JPEG and AVIF."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import SnergError
from ..io.guard import check_file, why
from ..io.images import MAX_BYTES, check_size, damaged, png_bytes
from .codecs import CodecSettings, image_suffix, import_jxl
from .jxl import MAX_HEADER_BYTES, jxl_size

MODES = {1: "L", 3: "RGB", 4: "RGBA"}  # Pillow's, by the number of channels


def encode_image(kind: str, pixels: NDArray[Any], codec: CodecSettings) -> bytes:
    """The bytes of an image file. pixels: uint8 [H, W] or [H, W, 3 or 4]; kind: as in `images_of_slice`."""
    if image_suffix(kind, codec) == "png":
        return png_bytes(pixels)
    codec.check()  # it registers JPEG XL with Pillow
    options: dict[str, Any] = {
        "webp": {"format": "WEBP", "lossless": True, "quality": 50, "method": 3},
        "jxl": {"format": "JXL", "lossless": True, "effort": 7, "num_threads": 0},
        "jpeg": {"format": "JPEG", "quality": codec.quality, "subsampling": 0, "optimize": True},
        "avif": {"format": "AVIF", "quality": codec.quality, "subsampling": "4:4:4", "speed": 8, "max_threads": 1},
    }[codec.name]
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, **options)
    return buffer.getvalue()


def read_image_file(path: Path, shape: tuple[int, ...]) -> NDArray[Any]:
    """An image of exactly that shape, [H, W] or [H, W, 3 or 4], as uint8, in the format that the file's suffix names.

    Raises SnergError naming the file when it is missing, damaged or of another shape.
    """
    mode = MODES[shape[2] if len(shape) == 3 else 1]
    check_present(path)
    if path.suffix == ".jxl":
        import_jxl()
    try:
        if path.suffix == ".jxl":  # this decoder decodes all of an image before it tells its size
            with path.open("rb") as file:
                check_size(path, *jxl_size(file.read(MAX_HEADER_BYTES)))
        with Image.open(path, formats=["JPEG" if path.suffix == ".jpg" else path.suffix[1:].upper()]) as image:
            check_size(path, image.width, image.height)
            if (image.height, image.width) != shape[:2] or image.mode != mode:
                raise SnergError(
                    f"{path} is {image.width} x {image.height} {image.mode}, not {shape[1]} x {shape[0]} {mode}; "
                    "the scene's folder is damaged: export it again."
                )
            pixels: NDArray[Any] = np.asarray(image)
            return pixels
    except SnergError:
        raise
    except Exception as error:  # each decoder raises its own: RuntimeError (AVIF), SyntaxError (PNG), ...
        raise damaged(path, "it cannot be decoded" if path.suffix == ".jxl" and isinstance(error, RuntimeError) else why(error)) from error


def check_present(path: Path) -> None:
    """Raise SnergError when a file of a scene is missing, not a regular file, or larger than any image."""
    if not path.exists():
        raise SnergError(f"{path} is missing; the scene's folder is damaged: export it again.")
    check_file(path, MAX_BYTES)
