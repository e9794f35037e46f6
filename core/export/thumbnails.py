"""Small pictures of a page's cameras, by which people choose one."""

from __future__ import annotations

import time
from collections.abc import Sequence

from ..geometry.camera import Camera
from ..progress import Note, Progress, within
from ..scene.scene import Scene
from .page import picture_bytes
from .page_settings import PageSettings

SIDE = 160  # pixels of a thumbnail's longer side at most
QUALITY = 60  # WebP: 1 to 4 KB each
SECONDS = 30.0  # that all of them may take; the cameras that are left then have none
FOLDER = "thumbnails"


def thumbnails(scene: Scene, cameras: Sequence[Camera], page: PageSettings, progress: Progress) -> list[bytes]:
    """WebP pictures of the first `page.thumbnails` cameras, over the page's background: fewer where time runs out, which is said.

    Raises Cancelled where `progress` does.
    """
    made: list[bytes] = []
    wanted = cameras[: page.thumbnails]
    until = time.monotonic() + SECONDS
    for index, camera in enumerate(wanted):
        if time.monotonic() > until:
            progress(1.0, Note(f"Only {index} of {len(cameras)} cameras have a thumbnail: these took {SECONDS:g} seconds."))
            break
        part = within(progress, index / len(wanted), (index + 1) / len(wanted))
        part(0.0, f"Thumbnail {index + 1} of {len(wanted)}")
        made.append(picture_bytes(scene, camera, page, SIDE, QUALITY, part))
    return made


def thumbnail_name(index: int) -> str:
    """The path of a camera's thumbnail in the page's folder."""
    return f"{FOLDER}/{index:03d}.webp"
