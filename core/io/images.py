"""Reading and writing pictures as arrays, and the sRGB curve.

Images are read as they are stored. An EXIF orientation is applied only where it is asked for: COLMAP and tools that use it find poses
for the stored pixels, others turn the pictures first.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, features

from ..errors import SnergError
from .files import write_bytes
from .guard import check_file, reading, why

MAX_PIXELS = 2**27  # of an image: more than any camera has, too few for a small file to fill the memory (hard case 61)
FLAT_PIXELS = 2**24  # pixels that an image may have however small its file is
FLAT_MASK = 2**26  # the same for a mask, which has one channel and may be white everywhere
PIXELS_PER_BYTE = 256  # pixels per byte of file that larger images may have: a PNG of one RGBA colour has 250, others have fewer
MAX_BYTES = 2**31  # of an image's file
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "AVIF")  # and HEIF; some other formats of Pillow start external programs
LINEAR = (".exr",)  # read with OpenImageIO
QUARTER_TURNS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height
TURNS = {5: (-1, True), 6: (1, False), 7: (1, True), 8: (-1, False)}  # these orientations as (quarter turns clockwise, mirrored first)
ENDS = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}  # the last part of each whole file
MAX_BOXES = 64  # of an AVIF or HEIC file at its top level
TAIL = 4096  # bytes at the end of a file in which that part is looked for
DEEP = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")  # Pillow clips these instead of scaling them


def read_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone, in pixels. Raises SnergError as `read_image` does, and for a file that was cut short."""
    if path.suffix.lower() in LINEAR:
        return _Linear(path).size
    with _open(path, header=True) as image:
        size, kind = image.size, str(image.format)
    if _may_be_cut(path, kind):
        read_image(path)  # its last bytes are another program's, or missing: the decoder knows
    return size


def lies_down(path: Path) -> bool:
    """Whether an image's EXIF orientation turns it by a quarter, so that its upright width is its stored height."""
    if path.suffix.lower() in LINEAR:
        return False
    with _open(path, header=True) as image, reading(path, "write it again", f"The image {path}"):
        return image.getexif().get(ExifTags.Base.Orientation) in QUARTER_TURNS


def quarter_turn(path: Path) -> tuple[int, bool]:
    """How the EXIF orientation of an image that `lies_down` turns it up: (quarter turns clockwise, whether it is mirrored first, left to
    right); (0, False) for other images."""
    if path.suffix.lower() in LINEAR:
        return 0, False
    with _open(path, header=True) as image, reading(path, "write it again", f"The image {path}"):
        return TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1), (0, False))


def read_image(path: Path, upright: bool = False) -> NDArray[Any]:
    """Read an image as uint8 [H, W, 3 or 4], sRGB, with straight alpha where the file has alpha.

    upright: turn it by its EXIF orientation.

    16-bit channels are rounded to 8 bits. OpenEXR, which is linear with premultiplied alpha, is converted.
    Raises SnergError when the file is missing, damaged or larger than MAX_PIXELS, or is OpenEXR or HEIC and OpenImageIO or pillow-heif is
    not installed.
    """
    if path.suffix.lower() in LINEAR:
        return _Linear(path).read()
    with _open(path) as image, reading(path, "write it again", f"The image {path}"):
        if upright:
            ImageOps.exif_transpose(image, in_place=True)
        if image.mode in DEEP:
            return _deep(path, image)
        has_alpha = "A" in image.getbands() or "transparency" in image.info
        return np.asarray(image.convert("RGBA" if has_alpha else "RGB"))


def read_numbers(path: Path) -> NDArray[Any]:
    """The numbers of an image of one channel as they are stored, uint8, uint16, int32 or float32 [H, W], as depth is written.

    Raises SnergError as `read_image` does, and for an image of several channels.
    """
    with _open(path) as image, reading(path, "write it again", f"The image {path}"):
        if image.mode not in ("L", *DEEP):
            raise SnergError(f"The image {path} has the channels {', '.join(image.getbands())} where one of 16 bits is needed.")
        return np.asarray(image)


def read_mask(path: Path, width: int, height: int, hides: bool = False) -> NDArray[Any]:
    """Read a mask and resize it to the image's size: bool [height, width], True for pixels to use.

    A pixel is used where all of the mask's pixels that it covers are white (grey level 128 or more); with `hides`, where all are black.
    Raises SnergError as `read_image` does, and when the mask's aspect ratio is not the image's.
    """
    with _open(path, FLAT_MASK) as image:
        if abs(image.width * height - image.height * width) > 0.02 * image.width * height + 2 * max(image.size):
            raise SnergError(f"The mask {path} is {image.width} x {image.height}, its image {width} x {height}; make it the same size.")
        with reading(path, "write it again", f"The mask {path}"):
            grey = image.convert("L")
            white = grey.point([255] * 128 + [0] * 128 if hides else [0] * 128 + [255] * 128)
            return np.equal(np.asarray(white.resize((width, height), Image.Resampling.BOX)), 255)


def reduced(pixels: NDArray[Any], factor: int) -> NDArray[Any]:
    """Downscale uint8 sRGB pixels [H, W, 3 or 4] to uint8 [H // factor, W // factor, 3 or 4] with a box filter.

    A result is the mean of factor x factor pixels, of the sRGB values as they are stored. With an alpha channel (straight), colours are
    averaged with alpha as their weight. The last H % factor rows and W % factor columns are left out.
    """
    if factor == 1:
        return pixels
    height, width = pixels.shape[0] // factor * factor, pixels.shape[1] // factor * factor
    image = Image.fromarray(np.ascontiguousarray(pixels[:height, :width]))
    if pixels.shape[-1] == 4:
        return np.asarray(image.convert("RGBa").reduce(factor).convert("RGBA"))
    return np.asarray(image.reduce(factor))


def damaged(path: Path, error: Exception | str) -> SnergError:
    """The error for an image that cannot be decoded."""
    return SnergError(f"The image {path} is damaged ({error}); write it again.")


def _deep(path: Path, image: Image.Image) -> NDArray[Any]:
    """A grey image of 16 bits as uint8 [H, W, 3], rounded to nearest. Raises SnergError when values are not in 0..65535."""
    values = np.asarray(image)
    if image.mode == "F" or values.min() < 0 or values.max() > 65535:
        raise SnergError(f"The image {path} has {image.mode!r} values, whose range is not known; write it as PNG or OpenEXR.")
    grey = (values.astype(np.uint32) * 255 + 32767) // 65535
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def _open(path: Path, flat: int = FLAT_PIXELS, header: bool = False) -> Image.Image:
    """Open an image with Pillow and check its size. Raises SnergError as `read_image` does.

    header: read the header alone. Otherwise the whole file is read first: a decoder that reads from the file allocates as many bytes as
    the file states for a part of itself, which may be gigabytes.
    """
    size = _check_image_file(path)
    formats = _formats(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # MAX_PIXELS decides
            image = Image.open(path if header else io.BytesIO(path.read_bytes()), formats=formats)
    except Exception as error:  # Pillow's readers of headers raise what they like
        raise SnergError(f"The image {path} cannot be read as a picture ({why(error)}).") from error
    try:
        check_size(path, image.width, image.height, size, flat)
    except SnergError:
        image.close()
        raise
    return image


def _formats(path: Path) -> tuple[str, ...]:
    """The names by which Pillow knows the formats that a file may have. HEIC, which phones write, is known by its content: it is often
    called .jpg. Raises SnergError when no decoder is installed for the file."""
    with reading(path, "write it again", f"The image {path}"), open(path, "rb") as file:
        head = file.read(64)
    if head[4:8] != b"ftyp":
        return FORMATS
    if b"avif" in head or b"avis" in head:
        if not features.check("avif"):
            raise SnergError(f"The image {path} is AVIF, which this Pillow lacks: run 'pip install -U pillow', or convert it to PNG.")
        return FORMATS
    try:
        import pillow_heif
    except ImportError as error:
        raise SnergError(
            f"The image {path} is HEIC, which needs the package pillow-heif: run 'pip install pillow-heif', or convert it to JPEG."
        ) from error
    pillow_heif.register_heif_opener()
    return ("HEIF",)


def _may_be_cut(path: Path, kind: str) -> bool:
    """Whether the end of a file is not as its format has it: a file that was copied in part has a whole header. Reads a few bytes."""
    with reading(path, "write it again", f"The image {path}"), open(path, "rb") as file:
        length = path.stat().st_size
        if kind in ENDS:
            file.seek(max(length - TAIL, 0))
            return ENDS[kind] not in file.read()
        if kind == "WEBP":
            return int.from_bytes(file.read(8)[4:], "little") + 8 > length
        if kind not in ("AVIF", "HEIF"):
            return False
        at = 0
        for _ in range(MAX_BOXES):  # of ISO 14496-12: size, name, content
            file.seek(at)
            size = int.from_bytes(file.read(8)[:4], "big")
            if size == 1:  # the size follows in 64 bits
                size = int.from_bytes(file.read(8), "big")
            if size < 8 or at + size >= length:
                return at + size > length  # 0 is up to the end of the file
            at += size
        return True


def check_size(path: Path, width: int, height: int, size: int | None = None, flat: int = FLAT_PIXELS) -> None:
    """Check the size in pixels that an image's header states.

    size: bytes of the file, None where unknown. Raises SnergError when the image has no pixels, more than MAX_PIXELS, or more than both
    `flat` and PIXELS_PER_BYTE * size, which no file of that many bytes can hold (hard case 61).
    """
    if not 0 < width * height <= MAX_PIXELS or width < 1:
        raise SnergError(f"The image {path} says that it is {width} x {height} pixels; the most is {MAX_PIXELS} in all.")
    if size is not None and width * height > max(flat, PIXELS_PER_BYTE * size):
        raise SnergError(f"The image {path} says that it is {width} x {height} pixels in {size} bytes, too few; write it again.")


def _check_image_file(path: Path) -> int:
    """The size of an image's file in bytes. Raises SnergError when it does not exist, is not a regular file or is above MAX_BYTES."""
    if not path.exists():
        raise SnergError(f"The image {path} does not exist; put it there or take it out of the dataset.")
    return check_file(path, MAX_BYTES)


class _Linear:
    """An OpenEXR image: linear values with premultiplied alpha."""

    def __init__(self, path: Path) -> None:
        """Reads the header. Raises SnergError as `read_image` does."""
        self.path, self.oiio = path, _open_image_io(path)
        size = _check_image_file(path)
        file = self._input()
        spec = file.spec()
        file.close()
        self.size = int(spec.full_width), int(spec.full_height)
        check_size(path, *self.size, size)
        check_size(path, int(spec.width), int(spec.height), size)
        if spec.deep:
            raise SnergError(f"The image {path} is a deep one; write it flattened.")
        self.corner = int(spec.x - spec.full_x), int(spec.y - spec.full_y)
        self.channels = self._choose(list(spec.channelnames))

    def _input(self) -> Any:
        file = self.oiio.ImageInput.open(str(self.path))
        if file is None:
            raise SnergError(f"The image {self.path} cannot be read as a picture ({_line(self.oiio.geterror())}).")
        return file

    def _choose(self, names: list[str]) -> list[int]:
        """The indices of the channels R, G, B and, if there is one, A: those without a prefix, else those of Blender's pass Combined, else
        the grey channel Y three times. Raises SnergError when there are none of these."""
        for prefix in ("", *sorted({n.rpartition(".")[0] + "." for n in names if n.rpartition(".")[0].endswith("Combined")})):
            if all(prefix + c in names for c in "RGB"):
                return [names.index(prefix + c) for c in "RGBA" if prefix + c in names]
        if "Y" in names:
            return [names.index("Y")] * 3 + ([names.index("A")] if "A" in names else [])
        raise SnergError(f"The image {self.path} has no channels R, G and B but {', '.join(names[:8])}; write the combined pass alone.")

    def read(self) -> NDArray[Any]:
        """uint8 [H, W, 3 or 4], sRGB, straight alpha."""
        file = self._input()
        try:
            first, last = min(self.channels), max(self.channels) + 1
            values = file.read_image(0, 0, first, last, "float")
            if values is None:
                raise damaged(self.path, _line(file.geterror()))
        finally:
            file.close()
        values = np.asarray(values, np.float32)[..., [c - first for c in self.channels]]
        if not np.isfinite(values).all():
            raise SnergError(f"The image {self.path} holds values that are not finite; render it again.")
        return to_uint8(display_referred(self._framed(values)))

    def _framed(self, values: NDArray[Any]) -> NDArray[Any]:
        """The whole image [H, W, C] from its data window: values outside the data window are 0."""
        (width, height), (x, y) = self.size, self.corner
        if values.shape[:2] == (height, width) and (x, y) == (0, 0):
            return values
        whole = np.zeros((height, width, values.shape[-1]), np.float32)
        left, top = max(x, 0), max(y, 0)
        part = values[top - y : max(height - y, 0), left - x : max(width - x, 0)]
        whole[top : top + part.shape[0], left : left + part.shape[1]] = part
        return whole


def _line(text: str) -> str:
    return " ".join(text.split())


def _open_image_io(path: Path) -> Any:
    try:
        import OpenImageIO
    except ImportError as error:
        raise SnergError(
            f"The image {path} is OpenEXR, which needs the package OpenImageIO: run 'pip install openimageio' "
            "(beside NumPy 1: 'openimageio<3.1'), or convert it to PNG."
        ) from error
    return OpenImageIO


def display_referred(values: NDArray[Any]) -> NDArray[Any]:
    """Convert linear premultiplied float32 [..., 3 or 4] to sRGB with straight alpha, clipped to [0, 1].

    Colours are divided by alpha before the sRGB curve, which is not linear (hard case 8).
    """
    colour = values[..., :3]
    if values.shape[-1] == 3:
        return linear_to_srgb(np.clip(colour, 0, 1))
    alpha = np.clip(values[..., 3:], 0, 1)
    straight = np.where(alpha > 0, colour / np.where(alpha > 0, alpha, 1), colour)
    return np.concatenate([linear_to_srgb(np.clip(straight, 0, 1)), alpha], axis=-1)


def png_bytes(pixels: NDArray[Any], compress_level: int = 6) -> bytes:
    """uint8 [H, W], [H, W, 3] or [H, W, 4] as a PNG of exactly those channels, 8 bits each."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=compress_level)
    return buffer.getvalue()


def write_png(path: Path, pixels: NDArray[Any], compress_level: int = 6) -> None:
    """Write uint8 [H, W], [H, W, 3] or [H, W, 4] as a PNG file, whole or not at all."""
    write_bytes(path, png_bytes(pixels, compress_level))


def to_uint8(colour: NDArray[Any]) -> NDArray[Any]:
    """Display-referred [0, 1] to 8 bits, rounded to nearest. Raises SnergError on values that are not finite."""
    if not np.isfinite(colour).all():
        raise SnergError("A picture holds values that are not finite; nothing was written.")
    return (np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)


def over(image: NDArray[Any], background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> NDArray[Any]:
    """Composite uint8 sRGB [..., 3 or 4] with straight alpha over a background colour: float32 [..., 3] in [0, 1].

    The sRGB values are blended as they are stored, as the renderer and the reference do, not in linear light (hard case 8).
    """
    colour = image[..., :3].astype(np.float32) / 255
    if image.shape[-1] == 3:
        return colour
    alpha = image[..., 3:].astype(np.float32) / 255
    return np.asarray(colour * alpha + (1 - alpha) * np.array(background, np.float32))


def srgb_to_linear(colour: NDArray[Any]) -> NDArray[Any]:
    """Convert sRGB in [0, 1] to linear light, elementwise (IEC 61966-2-1)."""
    return np.where(colour <= 0.04045, colour / 12.92, ((np.maximum(colour, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(colour: NDArray[Any]) -> NDArray[Any]:
    """Convert linear light to sRGB, elementwise (IEC 61966-2-1); values below 0 stay on its linear part."""
    return np.where(colour <= 0.0031308, colour * 12.92, 1.055 * np.maximum(colour, 0.0031308) ** (1 / 2.4) - 0.055)
