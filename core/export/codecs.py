"""How the atlas's pictures are stored (section 5.4, table 3): PNG and WebP without loss; JPEG, AVIF and H.264 with it.

Alpha is never stored with loss, and what a lossy codec gives back is bounded by it: colours and features are premultiplied,
so that what is empty stays empty (hard case 58). Chroma is kept at full resolution: features are no colours, and coarser
chroma costs more decibels than bytes for both.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, features

from ..errors import SnergError
from ..io.guard import check_file, why
from ..io.images import MAX_BYTES, check_size, damaged, png_bytes

SUFFIXES = {"png": "png", "webp": "webp", "jpeg": "jpg", "avif": "avif", "h264": "mp4"}
LOSSLESS = ("png", "webp")
MODES = {1: "L", 3: "RGB", 4: "RGBA"}  # Pillow's, by the number of channels
YCBCR = np.array([[0.299, 0.587, 0.114], [-0.168735892, -0.331264108, 0.5], [0.5, -0.418687589, -0.081312411]], np.float32)  # BT.601
MIDDLE = np.array([0, 128, 128], np.float32)
GROUP = 32  # frames of a video that depend on one another: the planes of a layer of cells


@dataclass(frozen=True)
class CodecSettings:
    """name: 'png' or 'webp' (lossless), 'jpeg', 'avif' or 'h264' (lossy; H.264 needs PyAV and does not open on web pages).

    quality: 1 to 100, for lossy codecs. JPEG's and AVIF's own scales; for H.264 a constant rate factor of 0.51 (100 - quality).
    Raises SnergError on another name or quality.
    """

    name: str = "png"
    quality: int = 90

    def __post_init__(self) -> None:
        if self.name not in SUFFIXES:
            raise SnergError(f"There is no codec {self.name!r}; choose one of {', '.join(SUFFIXES)}.")
        if not (isinstance(self.quality, int) and 1 <= self.quality <= 100):
            raise SnergError(f"A codec's quality is {self.quality}; choose a whole number from 1 to 100.")

    @property
    def lossless(self) -> bool:
        """Whether what is read is what was written."""
        return self.name in LOSSLESS

    def check(self) -> None:
        """Raise SnergError when this Python has no such codec."""
        if self.name == "h264":
            _av()
        elif self.name in ("avif", "webp") and not features.check(self.name):
            raise SnergError(
                f"This Python's Pillow knows no {self.name.upper()}: run 'pip install --upgrade pillow', or take another codec."
            )

    def to_json(self) -> dict[str, Any]:
        """{"name": ..., "quality": ...}, quality null where nothing is lost."""
        return {"name": self.name, "quality": None if self.lossless else self.quality}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> CodecSettings:
        """From `to_json`."""
        if not isinstance(value["name"], str):
            raise ValueError("a codec has no name")
        return cls(value["name"]) if value["name"] in LOSSLESS else cls(value["name"], value["quality"])


def pictures_of(pixels: NDArray[Any], codec: CodecSettings) -> dict[str, NDArray[Any]]:
    """Part of the atlas, uint8 [H, W, 4 or 8], as the pictures that hold it, by kind.

    PNG: 'rgba' and 'feature', as in the reference layout. Else 'alpha' [H, W], always PNG, 'rgb' [H, W, 3], and 'feature'
    [2 H, W, 3]: three of them, and below them the fourth, grey. Opaque pictures are what every decoder gives back as they are.
    Raises SnergError where a lossy codec would bound a colour above its alpha.
    """
    colour, alpha = pixels[..., :-1], pixels[..., -1]
    if codec.name == "png":
        pictures = {"rgba": pixels[..., [0, 1, 2, -1]]}
        return pictures | ({"feature": pixels[..., 3:7]} if pixels.shape[-1] == 8 else {})
    if not codec.lossless and (colour > alpha[..., None]).any():
        raise SnergError("The scene has colours above their alpha, which no lossy codec keeps; store it with the codec png or webp.")
    pictures = {"alpha": alpha, "rgb": pixels[..., :3]}
    if pixels.shape[-1] == 8:
        pictures["feature"] = np.concatenate([pixels[..., 3:6], np.repeat(pixels[..., 6:7], 3, axis=-1)])
    return pictures


def pixels_of(pictures: dict[str, NDArray[Any]], codec: CodecSettings) -> NDArray[Any]:
    """Undo `pictures_of`: uint8 [H, W, 4 or 8]."""
    feature = pictures.get("feature")
    if codec.name == "png":
        rgba = pictures["rgba"]
        return rgba if feature is None else np.concatenate([rgba[..., :3], feature, rgba[..., 3:]], axis=-1)
    rgb, alpha = pictures["rgb"], pictures["alpha"][..., None]
    parts = [rgb] if feature is None else [rgb, feature[: len(rgb)], feature[len(rgb) :, :, 1:2]]
    if not codec.lossless:
        parts = [np.minimum(part, alpha) for part in parts]
    return np.concatenate([*parts, alpha], axis=-1)


def suffix(kind: str, codec: CodecSettings) -> str:
    """Of the files of a kind."""
    return "png" if kind == "alpha" else SUFFIXES[codec.name]


def encode(kind: str, pixels: NDArray[Any], codec: CodecSettings) -> bytes:
    """A picture as a file's bytes."""
    if suffix(kind, codec) == "png":
        return png_bytes(pixels)
    options: dict[str, Any] = {
        "webp": {"format": "WEBP", "lossless": True, "quality": 50, "method": 3},
        "jpeg": {"format": "JPEG", "quality": codec.quality, "subsampling": 0, "optimize": True},
        "avif": {"format": "AVIF", "quality": codec.quality, "subsampling": "4:4:4", "speed": 8, "max_threads": 1},
    }[codec.name]
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, **options)
    return buffer.getvalue()


def read_picture(path: Path, shape: tuple[int, ...]) -> NDArray[Any]:
    """A picture of the kind that its suffix says, which must have exactly this shape, [H, W] or [H, W, 3 or 4].

    Raises SnergError naming the file when it is missing, damaged or another picture.
    """
    mode = MODES[shape[2] if len(shape) == 3 else 1]
    _check_stored(path)
    try:
        with Image.open(path, formats=["JPEG" if path.suffix == ".jpg" else path.suffix[1:].upper()]) as image:
            check_size(path, image.width, image.height)
            if (image.height, image.width) != shape[:2] or image.mode != mode:
                raise SnergError(
                    f"{path} is {image.width} x {image.height} {image.mode}, not {shape[1]} x {shape[0]} {mode}; "
                    "the scene's folder is damaged: export it again."
                )
            return np.asarray(image)
    except SnergError:
        raise
    except Exception as error:  # RuntimeError of AVIF's, SyntaxError of PNG's ...
        raise damaged(path, why(error)) from error


def _check_stored(path: Path) -> None:
    """Raise SnergError where one of a scene's files is missing or no regular file."""
    if not path.exists():
        raise SnergError(f"{path} is missing; the scene's folder is damaged: export it again.")
    check_file(path, MAX_BYTES)


def _rounded(values: NDArray[Any]) -> NDArray[Any]:
    """To 8 bits without a bias, which rays would add up: Pillow's own conversion is a level and a half too dark."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise SnergError("H.264 needs the package PyAV, which is not installed: run 'pip install av', or take another codec.") from error
    return av


class VideoWriter:
    """Frames uint8 [H, W, 3], one after another, to an H.264 file: YCbCr of the full range, no chroma left out."""

    def __init__(self, path: Path, codec: CodecSettings) -> None:
        """Raises SnergError where PyAV is missing."""
        self.av, self.path, self.codec = _av(), path, codec
        self.buffer = io.BytesIO()  # compressed, a video is small; and a full disk is then told as for any file
        self.container = self.av.open(self.buffer, "w", format="mp4")
        self.stream: Any = None

    def add(self, pixels: NDArray[Any]) -> None:
        """The next frame."""
        if self.stream is None:
            options = {"crf": f"{0.51 * (100 - self.codec.quality):.2f}", "preset": "medium", "sc_threshold": "0"}
            self.stream = self.container.add_stream("libx264", rate=GROUP, options=options)
            self.stream.height, self.stream.width = pixels.shape[:2]
            self.stream.pix_fmt, self.stream.gop_size = "yuv444p", GROUP
        planes = _rounded(pixels.astype(np.float32) @ YCBCR.T + MIDDLE).transpose(2, 0, 1)
        frame = self.av.VideoFrame.from_ndarray(np.ascontiguousarray(planes), format="yuv444p")
        self.container.mux(self.stream.encode(frame))

    def close(self) -> None:
        """Write the file."""
        if self.stream is not None:
            self.container.mux(self.stream.encode())
        self.container.close()
        self.path.write_bytes(self.buffer.getbuffer())


def read_video(path: Path, shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """The frames that `VideoWriter` wrote, one after another, each of exactly this shape.

    Raises SnergError naming the file when it is missing, damaged or another video, or where PyAV is missing.
    """
    av = _av()
    _check_stored(path)
    try:
        with av.open(os.fspath(path), format="mp4") as container:
            stream = container.streams.video[0]
            if (stream.height, stream.width) != shape[:2] or stream.pix_fmt != "yuv444p":
                raise SnergError(f"{path} is a video of another kind; the scene's folder is damaged: export it again.")
            for frame in container.decode(stream):
                planes = frame.to_ndarray(format="yuv444p").transpose(1, 2, 0)
                yield _rounded((planes.astype(np.float32) - MIDDLE) @ np.linalg.inv(YCBCR).T)
    except (av.FFmpegError, IndexError, ValueError, OSError, RuntimeError, MemoryError, TypeError) as error:
        raise SnergError(f"The video {path} is damaged ({why(error)}); export the scene again.") from error
    raise SnergError(f"The video {path} is cut short; export the scene again.")
