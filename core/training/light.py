"""The light on diffuse surfaces, as a renderer's pass gives it: what the diffuse colour of a field is trained on (section 4.2)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..io.images import linear_to_srgb, to_uint8


def diffuse_pixels(dataset: Dataset) -> NDArray[Any]:
    """The diffuse colours of all pixels, view after view and row by row, uint8 [N, 3]: sRGB, not premultiplied.

    Raises SnergError where a view has no such pass, or it cannot be read.
    """
    found = []
    for i, camera in enumerate(dataset.cameras):
        light = dataset.render_pass(i, "diffuse")
        if light is None:
            raise SnergError(f"The view {camera.name} has no diffuse pass; render the dataset with light passes, or set diffuse to 0.")
        colour = light[..., :3]
        if light.shape[-1] == 4:
            colour = colour / np.maximum(light[..., 3:], 1 / 1024)
        found.append(to_uint8(linear_to_srgb(colour.clip(0, 1))).reshape(-1, 3))
    return np.concatenate(found)
