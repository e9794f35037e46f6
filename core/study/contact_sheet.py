"""Contact sheets: images beside one another, to compare by eye."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..io.images import to_uint8

GAP, LABEL = 6, 22  # pixels between images, and of a line of text
PAPER, INK = (38, 38, 42), (235, 235, 235)  # background and text, 8-bit sRGB
GAIN = 10  # of an error picture, so that errors of 1/255 can be seen


def error_picture(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """GAIN times the absolute difference of two images [H, W, 3] in [0, 1], clipped to 1: [H, W, 3]."""
    return np.asarray(np.clip(GAIN * np.abs(a - b), 0, 1))


def contact_sheet(rows: Sequence[tuple[str, Sequence[NDArray[Any]]]], titles: Sequence[str], most: int = 10**6) -> NDArray[Any]:
    """A sheet uint8 [H, W, 3] with a row of images [h, w, 3] in [0, 1] for each (name, images).

    titles: of the columns. most: width in pixels to which wider images are reduced.
    """
    shown = [(name, [_fitted(picture, most) for picture in pictures]) for name, pictures in rows]
    width = max((picture.width for _, pictures in shown for picture in pictures), default=1)
    tops = np.cumsum([GAP] + [pictures[0].height + LABEL + GAP for _, pictures in shown])
    sheet = Image.new("RGB", (len(titles) * (width + GAP) + GAP, int(tops[-1])), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for top, (name, pictures) in zip(tops.tolist(), shown, strict=False):
        for column, (title, picture) in enumerate(zip(titles, pictures, strict=True)):
            left = GAP + column * (width + GAP)
            sheet.paste(picture, (left, top + LABEL))
            draw.text((left + 2, top + 2), f"{name}  {title}" if column == 0 else title, INK, font)
    return np.asarray(sheet)


def _fitted(picture: NDArray[Any], most: int) -> Image.Image:
    image = Image.fromarray(to_uint8(picture))
    if image.width <= most:
        return image
    return image.resize((most, max(1, round(image.height * most / image.width))), Image.Resampling.BOX)
