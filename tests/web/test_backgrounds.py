"""What is behind the scene of a page: colours, nothing, a picture."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page

from scenes import make_cameras, make_snerg
from snerg.core.commands.bundle import background_of
from snerg.core.errors import SnergError
from snerg.core.export.backdrop import BACKDROP_SIDE, backdrop_bytes
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.rendering.render import render_scene
from snerg.tests.web.conftest import opened, picture

Serve = Callable[[Path], str]
SHAPE = (34, 30, 40)
SECRET = "51.5007 N, 0.1246 W"


def photograph(path: Path, width: int = 320, height: int = 240) -> NDArray[np.float64]:
    """Write a smooth picture that says where it was taken; returns it, [H, W, 3] in [0, 1]."""
    y, x = np.mgrid[0:height, 0:width]
    pixels = np.stack([255 * x / width, 255 * y / height, np.full_like(x, 140)], axis=-1).astype(np.uint8)
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[0x010E] = SECRET
    image.save(path, exif=exif, quality=95)
    return pixels / 255


def front() -> NDArray[np.float32]:
    frame = render_scene(make_snerg(shape=SHAPE), make_cameras()[0])
    return np.concatenate([frame.colour, frame.alpha[..., None]], axis=-1)


def over(background: NDArray[np.float64] | tuple[float, float, float]) -> NDArray[np.float64]:
    """The first camera's picture over a background."""
    scene = front()
    return np.clip(scene[..., :3] + (1 - scene[..., 3:]) * np.array(background), 0, 1)


def near(shown: NDArray[np.float64], expected: NDArray[np.float64], levels: float = 0.5) -> bool:
    return bool(np.abs(shown - expected).mean() < levels / 255)


@pytest.mark.parametrize("single_file", [False, True])
def test_a_picture_behind_the_scene(page: Page, tmp_path: Path, serve: Serve, single_file: bool) -> None:
    """It is shown, poster included, saved with the view, can be left for a colour, and says nothing of the photographer."""
    behind = photograph(tmp_path / "photograph.jpg")[::2, ::2]
    settings = PageSettings(background_image=tmp_path / "photograph.jpg")
    folder = tmp_path / "web"
    write_bundle(make_snerg(shape=SHAPE), make_cameras(), folder, single_file, page=settings)
    assert not any(SECRET.encode() in path.read_bytes() for path in folder.rglob("*") if path.is_file())
    assert (folder / "background.webp").exists() != single_file
    address = (folder / "index.html").as_uri() if single_file else serve(folder)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    assert opened(page, f"{address}?width=160&height=120") is None
    assert near(picture(page), over(behind), 2)
    assert all(url.startswith(("data:", "blob:", address.rsplit("/", 1)[0])) for url in asked)

    page.get_by_role("button", name="Picture").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save PNG").click()
    download.value.save_as(tmp_path / "saved.png")
    with Image.open(tmp_path / "saved.png") as image:
        saved = np.asarray(image) / 255
    assert (saved[..., 3] == 1).all() and near(saved[..., :3], over(behind), 4)

    page.get_by_role("radio", name="Black background").check()
    assert near(picture(page), over((0, 0, 0)))
    page.get_by_role("radio", name="The page's picture as background").check()
    assert near(picture(page), over(behind), 2)
    if not single_file:
        with Image.open(folder / "poster.webp") as image:
            assert image.mode == "RGBA" and np.abs(np.asarray(image)[..., 3] / 255 - front()[..., 3]).mean() < 1 / 255


def test_a_picture_that_did_not_arrive(page: Page, tmp_path: Path, serve: Serve) -> None:
    photograph(tmp_path / "photograph.jpg")
    write_bundle(make_snerg(shape=SHAPE), make_cameras(), tmp_path / "web", page=PageSettings(background_image=tmp_path / "photograph.jpg"))
    (tmp_path / "web" / "background.webp").unlink()
    assert opened(page, serve(tmp_path / "web") + "?width=160&height=120") is None
    assert near(picture(page), over((1, 1, 1)))


def test_any_colour(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Of the export, of the address and of the picker; the link keeps it."""
    write_bundle(make_snerg(shape=SHAPE), make_cameras(), tmp_path / "web", page=PageSettings(background="#204060"))
    address = serve(tmp_path / "web")
    assert opened(page, f"{address}?width=160&height=120") is None
    assert near(picture(page), over((32 / 255, 64 / 255, 96 / 255)))
    assert page.get_by_role("radio", name="The page's picture as background").is_hidden()
    page.locator("#colour").fill("#ff8000")
    assert near(picture(page), over((1, 128 / 255, 0)))
    page.wait_for_url("**background=%23ff8000**")
    assert opened(page, f"{address}?width=160&height=120&background=0f0") is None
    assert near(picture(page), over((0, 1, 0)))
    page.evaluate("location.hash = 'background=https://example.org/spy.png'")
    page.wait_for_timeout(300)
    assert near(picture(page), over((0, 1, 0)))  # an address brings no pictures


def test_no_background_shows_the_page_around(page: Page, tmp_path: Path, serve: Serve) -> None:
    folder = tmp_path / "web"
    write_bundle(make_snerg(shape=SHAPE), make_cameras(), folder, page=PageSettings(background="transparent"))
    (folder / "around.html").write_text(
        '<body style="margin:0;background:#c04080"><iframe src="index.html?width=160&height=120&ui=none" width="160" height="120" '
        'style="border:0;display:block"></iframe>'
    )
    page.goto(serve(folder) + "around.html")
    inside = page.frames[1]
    inside.wait_for_load_state()
    assert inside.evaluate("window.snerg.ready")
    inside.evaluate("window.snerg.settled()")
    shot = page.screenshot(clip={"x": 0, "y": 0, "width": 160, "height": 120})
    shown = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")) / 255
    assert near(shown, over((192 / 255, 64 / 255, 128 / 255)))


def test_a_large_picture_is_made_smaller_and_stands_upright(tmp_path: Path) -> None:
    image = Image.fromarray(np.zeros((40, 5200, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6  # lies on its side
    image.save(tmp_path / "long.jpg", exif=exif)
    with Image.open(io.BytesIO(backdrop_bytes(tmp_path / "long.jpg"))) as written:
        assert written.format == "WEBP" and max(written.size) == written.height == BACKDROP_SIDE and not written.getexif()


@pytest.mark.parametrize("content", [b"", b"<svg onload='alert(1)'/>", b"#!/bin/sh\n"])
def test_what_is_no_picture_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "picture.png").write_bytes(content)
    with pytest.raises(SnergError, match=r"picture\.png"):
        write_bundle(make_snerg(shape=(8, 8, 8)), (), tmp_path / "web", page=PageSettings(background_image=tmp_path / "picture.png"))
    assert not (tmp_path / "web").exists()


def test_the_value_of_an_option_is_a_colour_or_a_picture(tmp_path: Path) -> None:
    (tmp_path / "here.png").write_bytes(b"")
    assert background_of("black") == ("black", None) and background_of("transparent") == ("transparent", None)
    assert background_of("#204060") == ("#204060", None)
    assert background_of(str(tmp_path / "here.png")) == ("white", tmp_path / "here.png")
    with pytest.raises(SnergError, match="no background 'pink', and no picture"):
        background_of("pink")
    with pytest.raises(SnergError, match="no background '#20406'"):
        PageSettings(background=background_of("#20406")[0])
    with pytest.raises(SnergError, match="no way to move 'swim'"):
        PageSettings(mode="swim")
