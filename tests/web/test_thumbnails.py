"""The cameras of a page as small pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page

from scenes import make_cameras, make_snerg
from snerg.core.commands.bundle import bundle_scene
from snerg.core.errors import Cancelled
from snerg.core.export import thumbnails as module
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.export.scene_files import write_scene
from snerg.core.progress import Note
from snerg.core.rendering.render import render_scene
from snerg.tests.web.conftest import opened, picture
from snerg.tests.web.test_modules import node

Serve = Callable[[Path], str]
SHAPE = (34, 30, 40)
SMALL = PageSettings(thumbnails=2)
CAMERAS = [replace(camera, name=name) for camera, name in zip(make_cameras(), ("r_0", "IMG_0012", "Window seat"), strict=False)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "web"
    write_bundle(make_snerg(SHAPE), CAMERAS, folder, page=SMALL)
    return folder


def test_the_first_cameras_have_a_picture_each(made: Path) -> None:
    files = sorted((made / "thumbnails").iterdir())
    assert [path.name for path in files] == ["000.webp", "001.webp"]
    listed = json.loads((made / "cameras.json").read_text())["cameras"]
    assert [camera.get("thumbnail") for camera in listed] == ["thumbnails/000.webp", "thumbnails/001.webp", None]
    for path, camera in zip(files, CAMERAS, strict=False):
        with Image.open(path) as image:
            shown = np.asarray(image.convert("RGB")) / 255
        assert max(image.size) <= module.SIDE and path.stat().st_size < 5000
        small = camera.resized(*image.size)
        assert np.abs(shown - render_scene(make_snerg(SHAPE), small).over()).mean() < 6 / 255


def test_a_camera_is_chosen_by_its_picture(page: Page, made: Path, serve: Serve) -> None:
    """By mouse and by keys; the name that a program gave stays in the address alone."""
    assert opened(page, serve(made) + "?width=160&height=120") is None
    assert page.get_by_role("combobox", name="Camera").count() == 0
    button = page.get_by_role("button", name="Camera: ")
    assert button.get_attribute("aria-label") == "Camera: View 1, 1 of 3" and button.inner_text() == "View 1"
    button.click()
    dialog = page.get_by_role("dialog", name="Cameras")
    shown = dialog.get_by_role("button")
    assert [each.inner_text() for each in shown.all()] == ["View 1", "View 2", "Window seat", "Close"]
    assert dialog.locator("[aria-current=true]").inner_text() == "View 1"
    loaded = "images => Promise.all(images.map((image) => image.decode().then(() => image.naturalWidth)))"
    widths = dialog.locator("img:not([hidden])").evaluate_all(loaded)
    assert len(widths) == 2 and min(widths) > 20
    dialog.get_by_role("button", name="View 2").click()
    assert dialog.is_hidden()
    assert np.abs(picture(page) - render_scene(make_snerg(SHAPE), CAMERAS[1]).over()).mean() < 0.5 / 255
    page.wait_for_url("**#*camera=IMG_0012*")
    assert button.get_attribute("aria-label") == "Camera: View 2, 2 of 3"
    button.press("Enter")
    page.keyboard.press("Tab")  # from the present camera to the next one
    page.keyboard.press("Enter")
    assert button.inner_text() == "Window seat"
    button.press("Enter")
    page.keyboard.press("Escape")
    assert dialog.is_hidden() and button.evaluate("button => button.getRootNode().activeElement === button")
    page.get_by_role("button", name="Next camera").click()
    assert button.inner_text() == "View 1"


def test_pictures_lie_inside_a_single_file_too(page: Page, tmp_path: Path) -> None:
    write_bundle(make_snerg((20, 20, 20)), CAMERAS, tmp_path / "web", single_file=True, page=SMALL)
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    assert opened(page, (tmp_path / "web" / "index.html").as_uri()) is None
    shown = page.locator("#gallery-open img")
    assert shown.evaluate("image => image.decode().then(() => image.naturalWidth)") > 20 and said == []


def test_a_picture_that_does_not_arrive_leaves_its_label(page: Page, made: Path, serve: Serve) -> None:
    page.route("**/thumbnails/*", lambda route: route.fulfill(status=404))
    assert opened(page, serve(made) + "?width=80&height=60") is None
    page.locator("#gallery-open img").wait_for(state="hidden")
    assert page.get_by_role("button", name="Camera: ").inner_text() == "View 1"


def test_a_file_elsewhere_is_no_thumbnail(page: Page, made: Path, serve: Serve) -> None:
    damaged = json.loads((made / "cameras.json").read_text())
    damaged["cameras"][0]["thumbnail"] = "https://example.org/thumbnails/1.webp"
    page.route("**/cameras.json", lambda route: route.fulfill(json=damaged))
    assert opened(page, serve(made)) == "The file cameras.json is damaged: it is not a list of cameras. Export the page again."


def test_names_that_a_program_gave_are_numbers() -> None:
    names = ["r_0", "00012", "IMG_3401", "frame-7", "Camera.003", "v4", "Window seat", "Room 101", "Front", "B2"]
    labels = node(f"""
        import {{ labelOf }} from "./viewer/gallery";
        console.log(JSON.stringify({json.dumps(names)}.map(labelOf)));
    """)
    assert labels == [f"View {i}" for i in range(1, 7)] + names[6:]


def test_time_runs_out_and_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SECONDS", 0.0)
    said: list[str] = []
    write_bundle(make_snerg((20, 20, 20)), CAMERAS, tmp_path / "web", progress=lambda _, text: said.append(text), page=SMALL)
    assert any(isinstance(text, Note) and "cameras have a thumbnail" in text for text in said)
    assert len(list((tmp_path / "web").glob("thumbnails/*"))) < 2


def test_cancelling_between_thumbnails_leaves_nothing(tmp_path: Path) -> None:
    def stop(_: float, text: str) -> None:
        if text.startswith("Thumbnail 2"):
            raise Cancelled

    write_scene(make_snerg((20, 20, 20)), tmp_path / "scene")
    with pytest.raises(Cancelled):
        write_bundle(make_snerg((20, 20, 20)), CAMERAS, tmp_path / "web", progress=stop, page=SMALL)
    assert not (tmp_path / "web").exists()
    assert bundle_scene(tmp_path / "scene", tmp_path / "web", page=SMALL)["cameras"] == 0
