"""The picture behind a web page's scene."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from ..io.images import read_image

BACKDROP = "background.webp"
BACKDROP_SIDE = 2560  # pixels of its longer side at most: a large screen
BACKDROP_QUALITY = 85


def backdrop_bytes(path: Path) -> bytes:
    """A picture as the page shows it: WebP, upright, of at most BACKDROP_SIDE pixels a side, and without what its file says of it.

    A photograph's file names its place, its camera and its owner, which nobody means to publish. Raises SnergError as `read_image` does.
    """
    picture = Image.fromarray(read_image(path, upright=True))
    picture.thumbnail((BACKDROP_SIDE, BACKDROP_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="WEBP", quality=BACKDROP_QUALITY, method=4)
    return buffer.getvalue()
