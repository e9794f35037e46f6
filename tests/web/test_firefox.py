"""The page in Firefox: pictures against the marcher, mouse, wheel, touch and keys. Skipped where Firefox is not installed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from scenes import make_cameras, make_forward, make_forward_cameras, make_frame, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import read_scene
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene
from snerg.tests.web.firefox import Firefox, display

Serve = Callable[[Path], str]
BINARY = shutil.which("firefox-esr") or shutil.which("firefox")
pytestmark = [
    pytest.mark.skipif(BINARY is None, reason="Firefox is not installed (Debian: firefox-esr)"),
    pytest.mark.skipif(
        not os.environ.get("DISPLAY") and not shutil.which("Xvfb"), reason="Firefox has no WebGL without a display (Debian: xvfb)"
    ),
    pytest.mark.slow,
]
VIEW = "JSON.stringify(document.querySelector('snerg-viewer').viewer.state.cameraToWorld)"
SIZE = "?width=160&height=120"


@pytest.fixture(scope="module")
def firefox(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Firefox]:
    assert BINARY
    with display() as address:
        browser = Firefox(BINARY, tmp_path_factory.mktemp("firefox"), (520, 520), address)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> str:
    folder = tmp_path_factory.mktemp("page") / "web"
    write_bundle(make_snerg(shape=(34, 30, 40)), make_cameras(), folder)
    return serve(folder)


def check(firefox: Firefox, address: str, scene: Scene, camera: int, truth: np.ndarray) -> None:
    """As test_pictures.compare, but for the texture filter of Mesa's software OpenGL, whose weights are multiples of 1/256."""
    assert firefox.open(f"{address}?camera={camera}&width={truth.shape[1]}&height={truth.shape[0]}") is None
    difference = np.abs(firefox.picture() - truth)
    assert difference.mean() < 0.8 / 255
    assert np.mean(difference.max(axis=-1) < 8 / 255) > 0.999


@pytest.mark.parametrize("index", [0, 2, 3])
def test_pictures(firefox: Firefox, made: str, index: int) -> None:
    scene = make_snerg(shape=(34, 30, 40))
    check(firefox, made, scene, index, render_scene(scene, make_cameras()[index]).over())


@pytest.mark.parametrize("kind", ["diffuse", "forward-facing", "webp", "avif"])
def test_kinds_of_scenes(firefox: Firefox, tmp_path: Path, serve: Serve, kind: str) -> None:
    scene = make_forward() if kind == "forward-facing" else make_snerg(shape=(34, 30, 40), diffuse=kind == "diffuse")
    cameras = make_forward_cameras(make_frame()) if kind == "forward-facing" else make_cameras()
    codec = CodecSettings(kind) if kind in ("webp", "avif") else CodecSettings("png")
    write_bundle(scene, cameras, tmp_path / "web", codec=codec)
    stored = read_scene(tmp_path / "web" / "scene")
    check(firefox, serve(tmp_path / "web"), stored, 0, render_scene(stored, cameras[0]).over())


def test_a_page_of_one_file(firefox: Firefox, tmp_path: Path) -> None:
    scene = make_snerg(shape=(20, 20, 20))
    write_bundle(scene, make_cameras(), tmp_path / "web", single_file=True)
    camera = make_cameras()[0]
    check(firefox, (tmp_path / "web" / "index.html").as_uri(), scene, 0, render_scene(scene, camera).over())


def moved(firefox: Firefox, act: Callable[[], None]) -> bool:
    """Whether the view changes when somebody acts."""
    before = firefox.evaluate(VIEW)
    act()
    for _ in range(30):
        if firefox.evaluate(VIEW) != before:
            return True
        firefox.wait("new Promise((resolve) => setTimeout(resolve, 100))")
    return False


def test_mouse_wheel_touch_and_keys(firefox: Firefox, made: str) -> None:
    assert firefox.open(made + SIZE) is None
    first = firefox.picture()
    assert moved(firefox, lambda: firefox.drag((80, 60), (110, 70)))
    assert moved(firefox, lambda: firefox.wheel((80, 60), -300))
    assert moved(firefox, lambda: firefox.drag((80, 60), (50, 50), "touch"))
    assert np.abs(firefox.picture() - first).mean() > 2 / 255
    firefox.press("r")
    assert np.abs(firefox.picture() - first).mean() < 0.5 / 255
    for key in ("\ue012", "\ue013", "+"):  # left, up
        assert moved(firefox, lambda key=key: firefox.press(key))  # type: ignore[misc]
    firefox.press("3")
    truth = render_scene(make_snerg(shape=(34, 30, 40)), make_cameras()[2]).over()
    assert np.abs(firefox.picture() - truth).mean() < 0.5 / 255


def test_the_benchmark(firefox: Firefox, made: str) -> None:
    assert firefox.open(made + SIZE + "#benchmark&frames=1") is None
    firefox.wait(
        "new Promise((resolve) => { const look = () => 'benchmark' in window.snerg ? resolve() : setTimeout(look, 100); look(); })"
    )
    assert firefox.evaluate("window.snerg.benchmark.fps") > 0
