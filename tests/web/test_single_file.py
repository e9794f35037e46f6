"""A page of one file, from the disk: its coarse scene comes first, stands in where the whole does not fit, and all can be read again."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from scenes import make_cameras, make_snerg
from snerg.core.export import bundle
from snerg.core.export.bundle import write_bundle
from snerg.core.rendering.render import render_scene
from snerg.core.scene.coarse import coarse_scene
from snerg.tests.web.conftest import opened, picture

SHAPE = (34, 30, 40)
VIEWER = "document.querySelector('snerg-viewer').viewer"
WATCH = """
    window.read = [];  // the files that are taken out of the page, in order
    new MutationObserver((changes) => {
      for (const change of changes) for (const node of change.removedNodes) if (node.dataset?.file) window.read.push(node.dataset.file);
    }).observe(document, { childList: true, subtree: true });
"""
LOSE = """async (canvas) => {
    const lost = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
    lost.loseContext();
    await new Promise((resolve) => setTimeout(resolve, 100));
    lost.restoreContext();
}"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a coarse scene, as larger ones have it."""
    folder = tmp_path_factory.mktemp("single") / "web"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bundle, "COARSE_FROM", 1)
        write_bundle(make_snerg(shape=SHAPE), make_cameras(), folder, single_file=True)
    return folder / "index.html"


def whole() -> np.ndarray:
    return render_scene(make_snerg(shape=SHAPE), make_cameras()[0]).over()


def coarse() -> np.ndarray:
    return render_scene(coarse_scene(make_snerg(shape=SHAPE)), make_cameras()[0]).over()


def with_file(page: str, name: str, change: dict[str, object]) -> str:
    """A page with other values in a JSON file that lies inside it."""
    found = re.search(f'(<script type="text/plain" data-file="{name}">)([^<]*)', page)
    assert found
    value = json.loads(base64.b64decode(found[2])) | change
    return page.replace(found[0], found[1] + base64.b64encode(json.dumps(value).encode()).decode())


def unread(page: Page, folder: str) -> int:
    """The files of texels of a scene that still lie in the page."""
    return int(page.evaluate(f"document.querySelectorAll('script[data-file^=\"{folder}/rgba\"]').length"))


def test_a_phone_shows_the_coarse_scene_and_says_why(page: Page, made: Path, tmp_path: Path) -> None:
    """The files of a scene that it does not hold stay unread."""
    large = tmp_path / "large.html"
    large.write_text(with_file(made.read_text(), "scene/scene.json", {"atlas_blocks": [1, 1, 600], "cells": 600}))
    assert opened(page, large.as_uri() + "?width=160&height=120#quality=phone") is None
    reason = "the whole takes 150 MB of graphics memory, and the quality “phone” allows 128 MB."
    assert page.locator("#notice-text").inner_text() == f"The scene is shown at a quarter of its resolution: {reason}"
    assert unread(page, "scene") > 0 and unread(page, "coarse") == 0
    page.get_by_role("button", name="Close this message").click()
    assert np.abs(picture(page) - coarse()).mean() < 1 / 255


def test_it_comes_first_and_the_quality_can_be_changed(page: Page, made: Path) -> None:
    """There and back, and after a lost graphics context: files that were taken out of the page can be read again."""
    page.add_init_script(WATCH)
    assert opened(page, made.as_uri() + "?width=160&height=120#quality=full") is None
    texels = [name.split("/")[0] for name in page.evaluate("window.read") if "/rgba" in name]
    assert texels == sorted(texels) and {*texels} == {"coarse", "scene"}  # all of the one before any of the other
    assert np.abs(picture(page) - whole()).mean() < 0.5 / 255 and unread(page, "scene") == 0
    page.evaluate(f"{VIEWER}.growing.scene.description.cells += 600")  # as if it were larger
    page.get_by_role("combobox", name="Quality").select_option("phone")
    page.locator("#notice").wait_for(state="visible")
    page.get_by_role("button", name="Close this message").click()
    assert np.abs(picture(page) - coarse()).mean() < 1 / 255
    page.evaluate(f"{VIEWER}.growing.scene.description.cells -= 600")
    page.get_by_role("combobox", name="Quality").select_option("full")
    page.evaluate(f"{VIEWER}.growing.filling")
    assert np.abs(picture(page) - whole()).mean() < 0.5 / 255 and page.locator("#notice").is_hidden()
    frames = page.evaluate("window.snerg.frames")
    page.locator("#canvas").evaluate(LOSE)
    while page.evaluate("window.snerg.frames") == frames:  # the page's security policy forbids wait_for_function
        page.wait_for_timeout(100)
    assert page.evaluate("window.snerg.problem") is None and np.abs(picture(page) - whole()).mean() < 0.5 / 255
