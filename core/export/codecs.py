"""How the slices of the atlas are stored (section 5.4, table 3): PNG, WebP and JPEG XL lossless; JPEG, AVIF and H.264 lossy.

A slice, uint8 [H, W, 4 or 8], becomes one or more images, each of a kind: 'rgba', 'feature', 'rgb' or 'alpha'. Alpha is always
stored lossless. Colours and features are premultiplied by alpha; what a lossy codec returns is limited to alpha, so that empty
space stays empty. Chroma has full resolution: with features, and with colours too, subsampling costs more accuracy than it saves
bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import features

from ..errors import SnergError

SUFFIXES = {"png": "png", "webp": "webp", "jxl": "jxl", "jpeg": "jpg", "avif": "avif", "h264": "mp4"}
LOSSLESS = ("png", "webp", "jxl")


@dataclass(frozen=True)
class CodecSettings:
    """A codec and its quality. Raises SnergError on an unknown name or a quality out of range."""

    # 'png', 'webp', 'jxl' (lossless), 'jpeg', 'avif' or 'h264' (lossy). JPEG XL needs pillow-jxl-plugin, H.264 needs PyAV, and web pages
    # cannot show the latter.
    name: str = "png"
    quality: int = 90  # 1 to 100, of lossy codecs: JPEG's and AVIF's own scales; for H.264 the constant rate factor 0.51 (100 - quality)

    def __post_init__(self) -> None:
        if self.name not in SUFFIXES:
            raise SnergError(f"There is no codec {self.name!r}; choose one of {', '.join(SUFFIXES)}.")
        if not (isinstance(self.quality, int) and 1 <= self.quality <= 100):
            raise SnergError(f"A codec's quality is {self.quality}; choose a whole number from 1 to 100.")

    @property
    def lossless(self) -> bool:
        """Whether reading returns exactly what was written."""
        return self.name in LOSSLESS

    def check(self) -> None:
        """Raise SnergError when the codec is not installed."""
        if self.name == "h264":
            import_av()
        elif self.name == "jxl":
            import_jxl()
        elif self.name in ("avif", "webp") and not features.check(self.name):
            raise SnergError(
                f"This Python's Pillow does not support {self.name.upper()}: run 'pip install --upgrade pillow', or choose another codec."
            )

    def to_json(self) -> dict[str, Any]:
        """{"name": ..., "quality": ...}; the quality is None if the codec is lossless."""
        return {"name": self.name, "quality": None if self.lossless else self.quality}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> CodecSettings:
        """The inverse of `to_json`. Raises KeyError, TypeError, ValueError or SnergError on another value."""
        if not isinstance(value["name"], str):
            raise ValueError("a codec has no name")
        return cls(value["name"]) if value["name"] in LOSSLESS else cls(value["name"], value["quality"])


PNG = CodecSettings()


def import_av() -> Any:
    """The module av. Raises SnergError, saying how to install it, when it is missing."""
    try:
        import av
    except ImportError as error:
        raise SnergError("H.264 needs the package PyAV, which is not installed: run 'pip install av', or choose another codec.") from error
    return av


def import_jxl() -> Any:
    """The module pillow_jxl, which teaches Pillow JPEG XL. Raises SnergError, saying how to install it, when it is missing."""
    try:
        import pillow_jxl
    except ImportError as error:
        raise SnergError(
            "JPEG XL needs the package pillow-jxl-plugin, which is not installed: run 'pip install pillow-jxl-plugin', "
            "or choose another codec."
        ) from error
    return pillow_jxl


def images_of_slice(pixels: NDArray[Any], codec: CodecSettings) -> dict[str, NDArray[Any]]:
    """A slice, or part of one, uint8 [H, W, 4 or 8] (RGB, four features, alpha), as images by kind.

    PNG: 'rgba' and 'feature', [H, W, 4], as in the reference layout. Other codecs: 'alpha' [H, W]; 'rgb' [H, W, 3]; 'feature'
    [2 H, W, 3], features 0 to 2 above feature 3 as grey. These have no alpha channel, so that every decoder returns them unchanged.
    Raises SnergError when the codec is lossy and a colour is above its alpha: it would be limited to alpha.
    """
    colour, alpha = pixels[..., :-1], pixels[..., -1]
    if codec.name == "png":
        images = {"rgba": pixels[..., [0, 1, 2, -1]]}
        return images | ({"feature": pixels[..., 3:7]} if pixels.shape[-1] == 8 else {})
    if not codec.lossless and (colour > alpha[..., None]).any():
        raise SnergError("The scene has colours above their alpha, which no lossy codec keeps; store it with the codec png or webp.")
    images = {"alpha": alpha, "rgb": pixels[..., :3]}
    if pixels.shape[-1] == 8:
        images["feature"] = np.concatenate([pixels[..., 3:6], np.repeat(pixels[..., 6:7], 3, axis=-1)])
    return images


def slice_of_images(images: dict[str, NDArray[Any]], codec: CodecSettings) -> NDArray[Any]:
    """A slice, uint8 [H, W, 4 or 8], from its images by kind: the inverse of `images_of_slice`."""
    feature = images.get("feature")
    if codec.name == "png":
        rgba = images["rgba"]
        return rgba if feature is None else np.concatenate([rgba[..., :3], feature, rgba[..., 3:]], axis=-1)
    rgb, alpha = images["rgb"], images["alpha"][..., None]
    parts = [rgb] if feature is None else [rgb, feature[: len(rgb)], feature[len(rgb) :, :, 1:2]]
    if not codec.lossless:
        parts = [np.minimum(part, alpha) for part in parts]
    return np.concatenate([*parts, alpha], axis=-1)


def image_shapes(shape: tuple[int, int, int], codec: CodecSettings) -> dict[str, tuple[int, ...]]:
    """The shape of each image of a slice [H, W, 4 or 8], by kind."""
    return {kind: pixels.shape for kind, pixels in images_of_slice(np.zeros(shape, np.uint8), codec).items()}


def image_suffix(kind: str, codec: CodecSettings) -> str:
    """The file name suffix, without a dot, of images of a kind. Alpha is PNG wherever the codec loses something or has no grey images."""
    return "png" if kind == "alpha" and codec.name != "jxl" else SUFFIXES[codec.name]
