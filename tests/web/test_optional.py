"""Pages hold only what their scene calls for; optional code is loaded when it is wanted."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from scenes import make_cameras, make_snerg, two_frequencies
from snerg.core.export import bundle
from snerg.core.export.annotations import Annotation
from snerg.core.export.bundle import VIEWER, write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.geometry.camera_path import CameraPath, Shot
from snerg.core.rendering.render import render_scene
from snerg.core.study.benchmarks import read_benchmark
from snerg.tests.web.conftest import ROOT, opened, picture
from snerg.tests.web.test_access import AXE

Serve = Callable[[Path], str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("optional") / "web"
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras()[:1], folder)
    return folder


@pytest.mark.parametrize("network", [False, True])
def test_a_bundle_holds_what_its_scene_calls_for(tmp_path: Path, network: bool) -> None:
    write_bundle(make_snerg(shape=(20, 20, 20), diffuse=not network), make_cameras(), tmp_path / "web")
    names = {path.relative_to(tmp_path / "web").as_posix() for path in (tmp_path / "web").rglob("*.*") if not path.name.startswith(".")}
    assert any("feature_" in name for name in names) == network
    assert {name for name in names if name.startswith("optional/")} == {"optional/benchmark.js"}


@pytest.mark.parametrize("frequencies", [0, 2, 4], ids=["diffuse", "two frequencies", "four frequencies"])
def test_the_shader_holds_what_its_scene_calls_for(page: Page, tmp_path: Path, serve: Serve, frequencies: int) -> None:
    """A diffuse scene has no network and no feature textures in the code that the driver compiles; a network, no inputs without weights."""
    network = frequencies > 0
    page.add_init_script("""
        window.shaders = [];
        const source = WebGL2RenderingContext.prototype.shaderSource;
        WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {
          window.shaders.push(text);
          return source.call(this, shader, text);
        };
    """)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    scene = make_snerg(shape=(20, 20, 20), diffuse=not network)
    scene = replace(scene, network=two_frequencies(scene.network)) if frequencies == 2 else scene
    write_bundle(scene, make_cameras()[:1], tmp_path / "web")
    assert opened(page, serve(tmp_path / "web") + "?width=80&height=60") is None
    marching = [text for text in page.evaluate("window.shaders") if "rgbaAt(" in text]
    assert marching
    for text in marching:
        assert ("vec3 viewDependentColour(" in text) == network
        assert ("sampler3D feature_0" in text) == network
        assert ("sin(2.0 * direction)" in text) == network and text.count(" += i0.x * ") == 4 * network
        assert ("sin(8.0 * direction)" in text) == ("cos(4.0 * direction)" in text) == (frequencies == 4)
    assert any("/feature_" in url for url in asked) == network


def test_viewer_js_holds_no_optional_code() -> None:
    """A text of each optional module that is in no other file."""
    viewer = (VIEWER / "dist" / "viewer.js").read_text(encoding="utf-8")
    for name, text in (
        ("benchmark", "snerg-benchmark"),
        ("annotations", "annotations.json"),
        ("measure", "Measured lengths"),
        ("vr", "Enter VR"),
    ):
        assert text in (VIEWER / "dist" / "optional" / f"{name}.js").read_text(encoding="utf-8")
        assert text not in viewer


def test_optional_code_shares_the_classes_of_viewer_js() -> None:
    """Each script is far smaller than three.js, of which it uses classes."""
    for script in (VIEWER / "dist" / "optional").iterdir():
        assert script.stat().st_size < 40_000


def test_a_benchmark_is_measured_and_read(page: Page, made: Path, serve: Serve, tmp_path: Path) -> None:
    """What the page saves is what a study reads."""
    assert opened(page, serve(made) + "?width=80&height=60#benchmark=360&frames=2") is None
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save JSON").click()
    saved.value.save_as(tmp_path / "benchmark.json")
    found = read_benchmark(tmp_path / "benchmark.json")
    assert found == page.evaluate("window.snerg.benchmark")
    assert (found["kind"], found["width"], found["height"], found["frames"]) == ("360", 990, 773, 2)
    assert found["fps"] == pytest.approx(1000 / found["ms"]) and 1 < found["ms"] < 60_000
    files = sum(path.stat().st_size for path in (made / "scene").glob("*_*.png"))
    assert found["megabytes"] == pytest.approx(files / 1e6)
    pages, pixels = (2 * 4 + 1) * 32**3, 4 * 990 * 773  # one cell of colour, features and distances, and the image
    assert found["memory_megabytes"] == pytest.approx((pages + 4 + pixels) / 1e6)


@pytest.mark.slow
def test_axe_finds_nothing_in_the_benchmark(browser: Browser, made: Path, serve: Serve) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 700}, bypass_csp=True)
    page = context.new_page()
    assert opened(page, serve(made) + "#benchmark&frames=1") is None
    page.locator("#benchmark dd").first.wait_for()
    page.add_script_tag(path=ROOT / "node_modules" / "axe-core" / "axe.min.js")
    assert page.evaluate(AXE) == []
    context.close()


@pytest.mark.slow
def test_a_benchmark_is_cancelled(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made) + "?width=80&height=60#benchmark") is None
    page.locator("#benchmark").get_by_role("status").filter(has_text="Frame").wait_for()
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#benchmark")).to_have_count(0)
    while not page.evaluate("'benchmark' in window.snerg"):
        page.wait_for_timeout(50)
    assert page.evaluate("window.snerg.benchmark") is None and page.evaluate("window.snerg.problem") is None


def test_optional_code_is_fetched_when_it_is_wanted(page: Page, made: Path, serve: Serve) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    assert opened(page, serve(made) + "?width=80&height=60") is None
    assert not any("optional" in url for url in asked)
    page.evaluate("location.hash = 'benchmark&frames=1'")
    page.locator("#benchmark dd").first.wait_for()
    assert sum("optional/benchmark.js" in url for url in asked) == 1


def test_the_scene_stays_where_optional_files_are_missing(
    page: Page, tmp_path: Path, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything is deleted that a page can do without: one sentence names each part of it, once, and can be closed."""
    monkeypatch.setattr(bundle, "COARSE_FROM", 1)
    web, scene = tmp_path / "web", make_snerg(shape=(34, 30, 40))
    cameras = make_cameras()
    path = CameraPath((Shot((1.0, 9.0), (cameras[0], cameras[0])),), 1, 9, 24.0)
    notes = (Annotation("A rod", (0.8, -0.2, 0.9)),)
    write_bundle(scene, cameras, web, page=PageSettings(thumbnails=3, annotations=notes, measures=True, vr=True), path=path)
    for name in ("coarse", "thumbnails", "optional"):
        shutil.rmtree(web / name)
    for name in ("annotations.json", "poster.webp"):
        (web / name).unlink()
    assert opened(page, serve(web) + "?width=160&height=120#benchmark&frames=1") is None
    said = page.locator("#missing-list p")
    expect(said).to_have_count(6)
    texts = said.all_inner_texts()
    for name in ("path", "annotations", "measure", "vr", "benchmark"):
        assert texts.count(f"The file optional/{name}.js did not arrive. Upload the whole folder of the page.") == 1
    assert "The file coarse/scene.json is missing from the server. Upload the whole folder of the page." in texts
    page.evaluate("location.hash = 'benchmark&frames=2'")  # said already
    page.locator("#canvas").press("2")
    page.locator("#canvas").press("1")
    page.get_by_role("button", name="Close").click()
    expect(said).to_have_count(0)
    assert np.abs(picture(page) - render_scene(scene, cameras[0]).over()).mean() < 0.5 / 255


def test_a_missing_texel_file_of_the_coarse_scene_is_named(
    page: Page, tmp_path: Path, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundle, "COARSE_FROM", 1)
    write_bundle(make_snerg(shape=(34, 30, 40)), make_cameras()[:1], tmp_path / "web")
    (tmp_path / "web" / "coarse" / "rgba_002.png").unlink()
    assert opened(page, serve(tmp_path / "web") + "?width=80&height=60") is None
    assert page.locator("#missing-list p").all_inner_texts() == [
        "The file coarse/rgba_002.png is missing from the server. Upload the whole folder of the page."
    ]


def test_a_page_of_one_file_says_what_it_leaves_out(page: Page, tmp_path: Path) -> None:
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras()[:1], tmp_path / "web", single_file=True)
    assert opened(page, (tmp_path / "web" / "index.html").as_uri()) is None
    page.evaluate("location.hash = 'benchmark&frames=1'")
    expect(page.locator("#missing")).to_contain_text('without the part "benchmark"')


def test_optional_code_inside_a_page_of_one_file(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the disk, under the page's own security policy, which allows each script by its hash."""
    monkeypatch.setattr(bundle, "optional_names", lambda *_: ("benchmark",))
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras()[:1], tmp_path / "web", single_file=True)
    assert opened(page, (tmp_path / "web" / "index.html").as_uri()) is None
    page.evaluate("location.hash = 'benchmark&frames=1'")
    page.locator("#benchmark dd").first.wait_for()
    assert np.isfinite(page.evaluate("document.querySelector('snerg-viewer').viewer.state.zoom"))
