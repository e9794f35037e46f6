"""Quality presets of the page: smooth edges at rest, drafts while it moves, and a coarse scene where the whole does not fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from playwright.sync_api import Page, Route

from scenes import make_cameras, make_snerg
from snerg.core.errors import SnergError
from snerg.core.export import bundle
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import render_scene
from snerg.core.scene.coarse import coarse_scene
from snerg.tests.web.conftest import opened, picture
from snerg.tests.web.test_modules import node

Serve = Callable[[Path], str]
VIEWER = "document.querySelector('snerg-viewer').viewer"
SIZE = "?width=160&height=120"
FAST = f"""{{ // as many images as the quality has, however slow this machine is
    const {{ renderer }} = {VIEWER};
    const begin = renderer.average.begin.bind(renderer.average);
    renderer.average.begin = (most, milliseconds, ...size) => begin(most, 1, ...size);
    renderer.change();
}}"""
SMALL, LARGE = (34, 30, 40), (61, 62, 63)
DEVICE = {"memory": None, "touch": False, "shortSide": 1080, "textureLimit": 2048}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "web"
    write_bundle(make_snerg(shape=SMALL), make_cameras(), folder, page=PageSettings(quality="phone"))
    return folder


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a coarse scene, as larger ones have it."""
    folder = tmp_path_factory.mktemp("large") / "web"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bundle, "COARSE_FROM", 1)
        write_bundle(make_snerg(shape=LARGE), make_cameras(), folder)
    return folder


def march(camera: Camera, shape: tuple[int, int, int] = SMALL) -> np.ndarray:
    return render_scene(make_snerg(shape=shape), camera).over()


def jitters(count: int) -> list[tuple[float, float]]:
    return node(f"""
        import {{ jitterOf }} from "./viewer/smoothing";
        console.log(JSON.stringify(Array.from({{ length: {count} }}, (_, k) => jitterOf(k, {count}))));
    """)


def moved(camera: Camera, right: float, up: float) -> Camera:
    return replace(camera, centre=(camera.centre[0] - right, camera.centre[1] + up))


def test_jitters_fill_the_pixel_and_do_not_shift_it() -> None:
    for count in (4, 8, 16):
        places = np.array(jitters(count))
        assert np.allclose(places.mean(axis=0), 0, rtol=0, atol=1e-12)
        steps = (np.arange(count) + 0.5) / count - 0.5
        assert np.allclose(np.sort(places, axis=0), steps[:, None])
        assert len({tuple(place) for place in (places > 0).tolist()}) == 4, "one in each quarter"


def test_a_slow_device_averages_fewer_images_or_none() -> None:
    counts = node("""
        import { affordableSamples } from "./viewer/smoothing";
        console.log(JSON.stringify([0, 60, 70, 130, 240, 260, 1e9].map((milliseconds) => affordableSamples(16, milliseconds))));
    """)
    assert counts == [16, 16, 8, 4, 4, 1, 1]


def test_the_device_chooses() -> None:
    told: list[tuple[dict, str]] = [
        ({}, "full"),
        ({"memory": 8}, "full"),
        ({"memory": 4}, "balanced"),
        ({"touch": True, "shortSide": 768}, "balanced"),
        ({"textureLimit": 512}, "balanced"),
        ({"touch": True, "shortSide": 390, "memory": 8}, "phone"),
        ({"memory": 2}, "phone"),
        ({"textureLimit": 256}, "phone"),
    ]
    found = node(f"""
        import {{ presetFor }} from "./viewer/quality";
        console.log(JSON.stringify({json.dumps([DEVICE | device for device, _ in told])}.map(presetFor)));
    """)
    assert found == [preset for _, preset in told]


def test_a_preset_bounds_pixels_and_memory() -> None:
    ratios, reason, none = node("""
        import { pixelRatioOf, PRESETS, tooMuchFor } from "./viewer/quality";
        const sizes = [[390, 844, 3], [1024, 1366, 2], [3840, 2160, 2], [800, 600, 1]];
        const ratios = Object.values(PRESETS).map((preset) => sizes.map((size) => pixelRatioOf(preset, ...size)));
        console.log(JSON.stringify([ratios, tooMuchFor("phone", { cells: 513, network: {} }), tooMuchFor("phone", { cells: 1024 })]));
    """)
    assert ratios[2] == [2, 2, 2, 1] and ratios[0][0] == 1.5 and ratios[0][3] == ratios[1][3] == 1
    assert ratios[0][2] == pytest.approx((1e6 / (3840 * 2160)) ** 0.5) and ratios[1][0] == 2
    assert reason == "the whole takes 129 MB of graphics memory, and the quality “phone” allows 128 MB" and none is None


def test_the_steps_of_a_moving_view() -> None:
    """Coarse at once where an image was slow; finer only when three images in a row could have been, one step."""
    steps = node("""
        import { DraftResolution } from "./viewer/draft_resolution";
        const resolution = new DraftResolution();
        const of = (...costs) => costs.map((cost) => resolution.next(cost, 1e4));
        const slow = new DraftResolution();
        console.log(JSON.stringify([of(null), of(1e-3), of(2e-2), of(6e-3, 6e-3, 6e-3, 6e-3), of(1e-3, 1e-3, 1e-3), slow.next(1, 1e4)]));
    """)
    assert steps == [[0.125], [1], [0.25], [0.25, 0.25, 0.5, 0.5], [0.5, 0.5, 1], 0.125]


@pytest.mark.parametrize(("motion", "index"), [("no-preference", 0), ("reduce", 2)])
def test_edges_are_smooth_at_rest(page: Page, small: Path, serve: Serve, motion: Literal["no-preference", "reduce"], index: int) -> None:
    """The picture changes once, to the mean of the march's pictures through 16 places of each pixel; then the device rests."""
    page.emulate_media(reduced_motion=motion)
    assert opened(page, serve(small) + "?width=80&height=60&ui=none#quality=full") is None
    page.evaluate("window.snerg.settled()")
    page.evaluate(FAST)
    page.evaluate("window.snerg.settled()")
    page.evaluate(f"{{ window.shown = []; {VIEWER}.on('image', ({{ full, samples }}) => window.shown.push([full, samples])); null; }}")
    page.evaluate(f"{VIEWER}.goTo({index})")
    smooth, camera = picture(page), make_cameras()[index].resized(80, 60)
    images = [march(moved(camera, *place)) for place in jitters(16)]
    assert np.abs(smooth - np.mean(images, axis=0)).max() < 3 / 255
    assert [samples for full, samples in page.evaluate("window.shown") if full][-2:] == [1, 16]
    assert sum(samples > 1 for _, samples in page.evaluate("window.shown")) == 1
    frames = page.evaluate(f"{VIEWER}.renderer.frames")
    page.wait_for_timeout(300)
    assert page.evaluate(f"{VIEWER}.renderer.frames") == frames and np.array_equal(picture(page), smooth)


def test_a_smooth_picture_is_neither_blurred_nor_shifted(page: Page, small: Path, serve: Serve) -> None:
    """It is nearer to the march's picture of 8 x 8 rays a pixel than the exact one, and than those of half a pixel beside it."""
    assert opened(page, serve(small) + "?width=80&height=60&ui=none#quality=full") is None
    page.evaluate(FAST)
    smooth, camera = picture(page), make_cameras()[0].resized(80, 60)
    fine = march(camera.resized(8 * 80, 8 * 60))

    def shifted(right: int, down: int) -> np.ndarray:
        return np.roll(fine, (-down, -right), (0, 1)).reshape(60, 8, 80, 8, 3).mean(axis=(1, 3))

    inner = (slice(2, -2), slice(2, -2))

    def error(image: np.ndarray) -> float:
        return float(np.abs(image - shifted(0, 0))[inner].mean())

    wide = np.mean([shifted(*place) for place in ((-4, -4), (-4, 4), (4, -4), (4, 4))], axis=0)  # over two pixels
    assert error(smooth) < 1 / 255
    for other in (march(camera), shifted(4, 0), shifted(-4, 0), shifted(0, 4), shifted(0, -4), wide):
        assert error(other) > 2 * error(smooth)


def test_a_saved_picture_is_exact(page: Page, small: Path, serve: Serve) -> None:
    assert opened(page, serve(small) + SIZE + "#quality=full") is None
    picture(page)
    rgba = page.evaluate(f"""async () => {{
        const blob = await {VIEWER}.capture({{ width: 160, height: 120 }});
        const canvas = new OffscreenCanvas(160, 120);
        const context = canvas.getContext("2d");
        context.drawImage(await createImageBitmap(blob), 0, 0);
        return [...context.getImageData(0, 0, 160, 120).data];
    }}""")
    saved = np.array(rgba).reshape(120, 160, 4)[..., :3] / 255
    assert np.abs(saved - march(make_cameras()[0])).max() < 3 / 255


def test_a_change_does_not_wait_for_the_timer_of_the_one_before(page: Page, small: Path, serve: Serve) -> None:
    """Else a moving view would have eight drafts a second."""
    assert opened(page, serve(small) + SIZE) is None
    page.evaluate("window.snerg.settled()")
    full = page.evaluate(f"""async () => {{
        const {{ renderer }} = {VIEWER};
        const wait = window.setTimeout;
        window.setTimeout = (run, delay, ...more) => (delay > 30 ? -1 : wait(run, delay, ...more)); // the timer never ends
        renderer.cost = 1; // milliseconds a pixel: drafts are wanted
        const images = [];
        {VIEWER}.on("image", (image) => images.push(image.full));
        for (let count = 1; count <= 3; count++) {{
            renderer.change();
            for (let frame = 0; images.length < count && frame < 600; frame++) await new Promise(requestAnimationFrame);
            for (let frame = 0; frame < 3; frame++) await new Promise(requestAnimationFrame);
        }}
        window.setTimeout = wait;
        return images;
    }}""")
    assert full == [False, False, False]


def test_the_page_says_why_it_shows_the_coarse_scene(page: Page, large: Path, serve: Serve) -> None:
    """A phone does not ask for the files of a scene that it does not hold."""
    asked: list[str] = []

    def enlarge(route: Route) -> None:
        value = json.loads((large / "scene" / "scene.json").read_text())
        route.fulfill(json=value | {"atlas_blocks": [1, 1, 600], "cells": 600})

    page.route("**/scene/scene.json", enlarge)
    page.on("request", lambda request: asked.append(request.url))
    assert opened(page, serve(large) + SIZE + "#quality=phone") is None
    notice = page.locator("#notice-text").inner_text()
    assert notice.endswith("the whole takes 150 MB of graphics memory, and the quality “phone” allows 128 MB.")
    assert not [url for url in asked if "/scene/rgba" in url]
    page.get_by_role("button", name="Close this message").click()
    assert page.locator("#notice").is_hidden() and page.locator("#loading").is_hidden()
    page.evaluate("window.snerg.settled()")
    page.locator("#canvas").press("n")
    page.get_by_role("combobox", name="Camera").select_option("Parallel")
    coarse = render_scene(coarse_scene(make_snerg(shape=LARGE)), make_cameras()[2])
    assert np.abs(picture(page) - coarse.over()).mean() < 2 / 255


def test_a_device_that_does_not_hold_the_scene(page: Page, large: Path, serve: Serve) -> None:
    page.add_init_script("""
        const ask = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {
          return name === WebGL2RenderingContext.MAX_3D_TEXTURE_SIZE ? 32 : ask.call(this, name);
        };
        window.said = [];
        addEventListener("DOMContentLoaded", () => {
          const region = document.querySelector("snerg-viewer").shadowRoot.getElementById("spoken");
          new MutationObserver(() => window.said.push(region.textContent)).observe(region, { childList: true });
        });
    """)
    assert opened(page, serve(large) + SIZE) is None
    text = "The scene is shown at a quarter of its resolution: this device's graphics memory or driver does not hold the whole."
    assert page.locator("#notice-text").inner_text() == text and text in page.evaluate("window.said")
    coarse = render_scene(coarse_scene(make_snerg(shape=LARGE)), make_cameras()[0]).over()
    page.get_by_role("button", name="Close this message").click()
    assert np.abs(picture(page) - coarse).mean() < 1 / 255
    page.get_by_role("combobox", name="Quality").select_option("full")
    assert page.evaluate(f"{VIEWER}.quality") == "full" and page.evaluate("window.snerg.problem") is None
    assert page.locator("#notice-text").inner_text() == text and page.locator("#notice").is_visible()


def test_an_upload_that_fails(page: Page, large: Path, serve: Serve) -> None:
    """Graphics memory that is full after a texture is like a limit; what was allocated is freed."""
    page.add_init_script("""
        const { texStorage3D, getError, deleteTexture } = WebGL2RenderingContext.prototype;
        window.large = 0;
        let failed = false;
        WebGL2RenderingContext.prototype.texStorage3D = function (...sizes) {
          if (sizes[5] > 40 && ++window.large === 2) failed = true;
          else texStorage3D.apply(this, sizes);
        };
        WebGL2RenderingContext.prototype.getError = function () {
          const error = failed ? this.OUT_OF_MEMORY : getError.call(this);
          failed = false;
          return error;
        };
        WebGL2RenderingContext.prototype.deleteTexture = function (texture) {
          window.deleted = (window.deleted ?? 0) + 1;
          deleteTexture.call(this, texture);
        };
    """)
    assert opened(page, serve(large) + SIZE) is None
    assert page.evaluate("window.large") == 2 and page.evaluate("window.deleted") >= 2
    assert "does not hold the whole" in page.locator("#notice-text").inner_text()
    coarse = render_scene(coarse_scene(make_snerg(shape=LARGE)), make_cameras()[0]).over()
    page.get_by_role("button", name="Close this message").click()
    assert np.abs(picture(page) - coarse).mean() < 1 / 255


@pytest.mark.slow
def test_the_quality_is_changed(page: Page, large: Path, serve: Serve) -> None:
    """From the whole scene to the coarse one, and back."""
    assert opened(page, serve(large) + SIZE + "#quality=full") is None
    whole, coarse = march(make_cameras()[0], LARGE), render_scene(coarse_scene(make_snerg(shape=LARGE)), make_cameras()[0]).over()
    page.evaluate(f"{VIEWER}.growing.scene.description.cells += 600")  # as if it were larger
    page.get_by_role("combobox", name="Quality").select_option("phone")
    page.locator("#notice").wait_for(state="visible")
    assert page.evaluate(f"{VIEWER}.growing.volume.source.description.shape") == list(coarse_scene(make_snerg(shape=LARGE)).shape)
    page.get_by_role("button", name="Close this message").click()
    assert np.abs(picture(page) - coarse).mean() < 1 / 255
    page.wait_for_url("**#*quality=phone*")
    page.evaluate(f"{VIEWER}.growing.scene.description.cells -= 600")
    page.get_by_role("combobox", name="Quality").select_option("auto")
    page.wait_for_url("**#*quality=auto*")
    page.evaluate(f"{VIEWER}.growing.filling")
    assert page.locator("#notice").is_hidden()
    assert np.abs(picture(page) - whole).max() < 3 / 255, "a picture of a given size is exact where nobody chose"


@pytest.mark.slow
def test_the_artist_chooses(page: Page, small: Path, serve: Serve) -> None:
    """The page's own quality is in force until somebody chooses, and a link says what was chosen."""
    address = serve(small) + SIZE
    assert opened(page, address) is None
    choice = page.get_by_role("combobox", name="Quality")
    assert page.evaluate(f"{VIEWER}.quality") == "phone" == choice.input_value()
    page.locator("#canvas").press("2")
    page.wait_for_url("**#*camera=*")
    assert "quality" not in page.url
    for link, value in (("quality=full", "full"), ("quality=auto", "auto"), ("quality=toString", "auto")):
        page.goto("about:blank")
        assert opened(page, f"{address}#{link}") is None
        assert choice.input_value() == value
    choice.select_option("auto")
    page.wait_for_url("**#*quality=auto*")
    preset = page.evaluate(f"{VIEWER}.quality")
    assert choice.evaluate("list => list.selectedOptions[0].text") == f"Quality: auto ({preset})"
    page.evaluate("location.hash = 'quality=balanced'")
    page.wait_for_url("**#*quality=balanced*")
    assert choice.input_value() == "balanced"


def test_page_settings_know_the_presets() -> None:
    with pytest.raises(SnergError, match="no quality 'best' of a page; choose from auto, phone, balanced, full"):
        PageSettings(quality="best")
