"""How the slices of the atlas are stored (section 5.4, table 3): PNG, WebP and JPEG XL lossless; JPEG, AVIF and H.264 lossy.

A slice, uint8 [H, W, 4 or 8], becomes one or more images, each of a kind: 'rgba', 'feature', 'rgb' or 'alpha'. Alpha is always
stored lossless. Colours and features are premultiplied by alpha; what a lossy codec returns is limited to alpha, so that empty
space stays empty. Chroma has full resolution: with features, and with colours too, subsampling costs more accuracy than it saves
bytes. Features may be stored at half the resolution (scene/half_features.py): a sixth of their bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import features

from ..errors import SnergError
from ..io.schema import flag
from ..scene.half_features import halve_features, restore_features
from .atlas import SLICE_PLANES

SUFFIXES = {"png": "png", "webp": "webp", "jxl": "jxl", "jpeg": "jpg", "avif": "avif", "h264": "mp4"}
LOSSLESS = ("png", "webp", "jxl")


@dataclass(frozen=True)
class CodecSettings:
    """A codec and its quality. Raises SnergError on an unknown name or a quality out of range."""

    # 'png', 'webp', 'jxl' (lossless), 'jpeg', 'avif' or 'h264' (lossy). JPEG XL needs pillow-jxl-plugin, H.264 needs PyAV, and web pages
    # cannot show the latter.
    name: str = "png"
    quality: int = 90  # 1 to 100, of lossy codecs: JPEG's and AVIF's own scales; for H.264 the constant rate factor 0.51 (100 - quality)
    half_features: bool = False  # store features at half the resolution (see scene/half_features.py); not with H.264

    def __post_init__(self) -> None:
        if self.name not in SUFFIXES:
            raise SnergError(f"There is no codec {self.name!r}; choose one of {', '.join(SUFFIXES)}.")
        if not (isinstance(self.quality, int) and 1 <= self.quality <= 100):
            raise SnergError(f"A codec's quality is {self.quality}; choose a whole number from 1 to 100.")
        if self.half_features and self.name == "h264":
            raise SnergError("H.264 stores features at full resolution alone; choose another codec, or leave out the half resolution.")

    @property
    def lossless(self) -> bool:
        """Whether images are stored exactly. Reading then returns what was written, but for features at half the resolution."""
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
        """{"name": ..., "quality": ...}, the quality None if the codec is lossless; with half_features also {"half_features": True}."""
        half = {"half_features": True} if self.half_features else {}
        return {"name": self.name, "quality": None if self.lossless else self.quality, **half}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> CodecSettings:
        """The inverse of `to_json`. Raises KeyError, TypeError, ValueError or SnergError on another value."""
        if not isinstance(value["name"], str):
            raise ValueError("a codec has no name")
        half = flag(value.get("half_features", False), "half_features")
        quality = {} if value["name"] in LOSSLESS else {"quality": value["quality"]}
        return cls(value["name"], half_features=half, **quality)

    @property
    def text(self) -> str:
        """The codec in words, for tables: "WEBP, half features" or "JPEG 90"."""
        return self.name.upper() + ("" if self.lossless else f" {self.quality}") + (", half features" if self.half_features else "")


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
    With half_features the slice must be whole (four planes), and the feature image has half its planes, rows and columns.
    Raises SnergError when the codec is lossy and a colour is above its alpha: it would be limited to alpha; or so a feature at half
    the resolution.
    """
    alpha = pixels[..., -1:]
    if not codec.lossless and (pixels > alpha).any():
        raise SnergError("The scene has colours above their alpha, which no lossy codec keeps; store it with the codec png or webp.")
    if codec.half_features and (pixels[..., 3:] > alpha).any():
        raise SnergError("The scene has features above their alpha, which half the resolution does not keep; store them at the whole one.")
    colour = {"rgba": pixels[..., [0, 1, 2, -1]]} if codec.name == "png" else {"alpha": alpha[..., 0], "rgb": pixels[..., :3]}
    if pixels.shape[-1] == 4:
        return colour
    feature = pixels[..., 3:7]
    if codec.half_features:
        feature = halve_features(_planes(pixels)).reshape(-1, pixels.shape[1] // 2, 4)
    if codec.name != "png":
        feature = np.concatenate([feature[..., :3], np.repeat(feature[..., 3:], 3, axis=-1)])
    return colour | {"feature": feature}


def slice_of_images(images: dict[str, NDArray[Any]], codec: CodecSettings) -> NDArray[Any]:
    """A slice, uint8 [H, W, 4 or 8], from its images by kind: the inverse of `images_of_slice`."""
    if codec.name == "png":
        rgb, alpha = images["rgba"][..., :3], images["rgba"][..., 3:]
    else:
        rgb, alpha = images["rgb"], images["alpha"][..., None]
    parts = [rgb]
    if (feature := images.get("feature")) is not None:
        if codec.name != "png":
            rows = len(feature) // 2
            feature = np.concatenate([feature[:rows], feature[rows:, :, 1:2]], axis=-1)
        if codec.half_features:
            planes = feature.reshape(SLICE_PLANES // 2, -1, *feature.shape[1:])
            feature = restore_features(planes, _planes(alpha)[..., 0]).reshape(*alpha.shape[:2], 4)
        parts.append(feature)
    if not codec.lossless:
        parts = [np.minimum(part, alpha) for part in parts]
    return np.concatenate([*parts, alpha], axis=-1)


def _planes(pixels: NDArray[Any]) -> NDArray[Any]:
    """A slice [4 H, W, C] as its planes [4, H, W, C]."""
    return pixels.reshape(SLICE_PLANES, -1, *pixels.shape[1:])


def image_shapes(shape: tuple[int, int, int], codec: CodecSettings) -> dict[str, tuple[int, ...]]:
    """The shape of each image of a slice [H, W, 4 or 8], by kind."""
    return {kind: pixels.shape for kind, pixels in images_of_slice(np.zeros(shape, np.uint8), codec).items()}


def image_suffix(kind: str, codec: CodecSettings) -> str:
    """The file name suffix, without a dot, of images of a kind. Alpha is PNG wherever the codec loses something or has no grey images."""
    return "png" if kind == "alpha" and codec.name != "jxl" else SUFFIXES[codec.name]
