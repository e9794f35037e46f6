"""Reading and writing pictures as arrays, and the sRGB curve."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import SnergError
from ..files import write_bytes

MAX_PIXELS = 2**27  # 134 million: past any camera, short of filling the memory from a small file (hard case 61)


def read_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone, in pixels. Raises SnergError as `read_image` does."""
    with _open(path) as image:
        return image.size


def read_image(path: Path) -> np.ndarray:
    """A picture as uint8 [H, W, 3 or 4], sRGB, straight alpha.

    Raises SnergError when the file is missing, damaged or larger than MAX_PIXELS.
    """
    with _open(path) as image:
        try:
            has_alpha = "A" in image.getbands() or "transparency" in image.info
            return np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
        except (OSError, ValueError, SyntaxError) as error:
            raise SnergError(f"The image {path} is damaged ({error}); write it again.") from error


def _open(path: Path) -> Image.Image:
    try:
        image = Image.open(path)
    except FileNotFoundError as error:
        raise SnergError(f"The image {path} does not exist; put it there or take it out of the dataset.") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SnergError(f"The image {path} cannot be read as a picture ({error}).") from error
    if image.width * image.height > MAX_PIXELS:
        size = f"{image.width} x {image.height}"
        image.close()
        raise SnergError(f"The image {path} says that it is {size} pixels; the most is {MAX_PIXELS} in all.")
    return image


def png_bytes(pixels: np.ndarray, compress_level: int = 6) -> bytes:
    """uint8 [H, W], [H, W, 3] or [H, W, 4] as a PNG of exactly those channels, 8 bits each."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=compress_level)
    return buffer.getvalue()


def write_png(path: Path, pixels: np.ndarray, compress_level: int = 6) -> None:
    """uint8 pixels to a PNG file, whole or not at all."""
    write_bytes(path, png_bytes(pixels, compress_level))


def to_uint8(colour: np.ndarray) -> np.ndarray:
    """Display-referred [0, 1] to 8 bits, rounded to nearest. Raises SnergError on values that are not finite."""
    if not np.isfinite(colour).all():
        raise SnergError("A picture holds values that are not finite; nothing was written.")
    return (np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)


def over_white(image: np.ndarray) -> np.ndarray:
    """uint8 [..., 3 or 4] with straight alpha to float32 [..., 3] over white, in display space (hard case 8)."""
    colour = image[..., :3].astype(np.float32) / 255
    if image.shape[-1] == 3:
        return colour
    alpha = image[..., 3:].astype(np.float32) / 255
    return colour * alpha + (1 - alpha)


def srgb_to_linear(colour: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, elementwise."""
    return np.where(colour <= 0.04045, colour / 12.92, ((np.maximum(colour, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(colour: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, elementwise; below 0 stays linear."""
    return np.where(colour <= 0.0031308, colour * 12.92, 1.055 * np.maximum(colour, 0.0031308) ** (1 / 2.4) - 0.055)
