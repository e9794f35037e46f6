"""Transparency that a dataset states beside its pictures' own alpha channel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.images import read_image, srgb_to_linear


@dataclass(frozen=True)
class Opacity:
    """What makes pixels of a picture transparent, as instant-ngp means it."""

    levels: tuple[int, ...] = ()  # pixels of which all three channels have this 8-bit value are transparent: 255 white, 0 black
    image: Path | None = None  # an image whose red channel, in linear light, replaces alpha

    def applied(self, pixels: NDArray[Any], upright: bool) -> NDArray[Any]:
        """uint8 [H, W, 3 or 4] with straight alpha, uint8 [H, W, 4]. upright: whether the picture was turned by its EXIF orientation.

        Raises SnergError when the image of the opacity cannot be read or is not as large as the picture.
        """
        alpha = pixels[..., 3].copy() if pixels.shape[-1] == 4 else np.full(pixels.shape[:2], 255, np.uint8)
        if self.image is not None:
            red = read_image(self.image, upright=upright)[..., 0]
            if red.shape != alpha.shape:
                size, wanted = (f"{shape[1]} x {shape[0]}" for shape in (red.shape, alpha.shape))
                raise SnergError(f"The alpha image {self.image} is {size}, its picture {wanted}; make it the same size.")
            alpha = np.rint(255 * srgb_to_linear(red.astype(np.float64) / 255)).astype(np.uint8)
        for level in self.levels:
            alpha[(pixels[..., :3] == level).all(axis=-1)] = 0
        return np.concatenate([pixels[..., :3], alpha[..., None]], axis=-1)
