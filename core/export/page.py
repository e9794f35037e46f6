"""The HTML of an exported page: what it says about itself, and how it opens."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping

from PIL import Image

from ..geometry.camera import Camera
from ..io.images import to_uint8
from ..progress import Progress
from ..rendering.render import render_scene
from ..scene.scene import Scene
from .page_settings import AUTOMATIC, PageSettings, pair

POSTER = "poster.webp"
POSTER_SIDE = 960  # pixels of the poster's longer side at most
POSTER_QUALITY = 80
ELEMENT = "<snerg-viewer>"
TITLE = "<title>SNeRG</title>"
HEADING = '<h1 class="unseen">SNeRG</h1>'  # for screen readers


def page_html(template: str, settings: PageSettings, poster: str | None, backdrop: str | None = None) -> str:
    """index.html with its title, its description and the attributes of its element. poster, backdrop: the addresses of the pictures."""
    attributes: dict[str, str] = {"background": "image" if backdrop else settings.background}
    if backdrop:
        attributes["background-image"] = backdrop
    if settings.mode != "orbit":
        attributes["mode"] = settings.mode
    if settings.quality != AUTOMATIC:
        attributes["quality"] = settings.quality
    if poster:
        attributes["poster"] = poster
    if settings.distance:
        attributes["distance"] = pair(settings.distance)
    if settings.elevation:
        attributes["elevation"] = pair(settings.elevation)
    if settings.play:
        attributes["play"] = ""
    tag = "".join(f' {name}="{html.escape(value)}"' for name, value in attributes.items())
    heading = HEADING.replace("SNeRG", html.escape(settings.title or "SNeRG"))
    return template.replace(TITLE, _head(settings, poster)).replace(HEADING, heading).replace(ELEMENT, f"{ELEMENT[:-1]}{tag}>")


def _head(settings: PageSettings, poster: str | None) -> str:
    """The title, and what other sites show of a link to the page (Open Graph)."""
    title = settings.title or "SNeRG"
    lines = [f"<title>{html.escape(title)}</title>"]
    if settings.description:
        lines.append(f'<meta name="description" content="{html.escape(settings.description)}">')
    address = settings.address.rstrip("/") + "/" if settings.address else ""
    shared: Mapping[str, str] = {
        "og:title": title,
        "og:description": settings.description,
        "og:url": address,
        "og:image": address + poster if poster and not poster.startswith("data:") else "",
    }
    lines += [f'<meta property="{name}" content="{html.escape(value)}">' for name, value in shared.items() if value]
    return "\n".join(lines)


def poster_bytes(scene: Scene, camera: Camera, settings: PageSettings, progress: Progress) -> bytes:
    """A WebP picture of the scene from a camera, over the page's colour, or else with alpha. Raises as `render_scene` does."""
    return picture_bytes(scene, camera, settings, POSTER_SIDE, POSTER_QUALITY, progress)


def picture_bytes(scene: Scene, camera: Camera, settings: PageSettings, side: int, quality: int, progress: Progress) -> bytes:
    """A WebP picture as `poster_bytes`, of which the longer side has at most `side` pixels. quality: 0 to 100."""
    scale = min(1.0, side / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    frame = render_scene(scene, small, progress=progress)
    picture = to_uint8(frame.straight() if settings.colour is None else frame.over(settings.colour))
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="WEBP", quality=quality, method=4)
    return buffer.getvalue()


def data_address(picture: bytes) -> str:
    """A WebP picture as an address that holds it."""
    return "data:image/webp;base64," + base64.b64encode(picture).decode()
