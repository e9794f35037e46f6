"""The page's image against a float64 march of the same camera: equal within 8 bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from oracle import dense_march
from scenes import (
    empty_snerg,
    looking,
    make_cameras,
    make_forward,
    make_forward_cameras,
    make_frame,
    make_roots,
    make_snerg,
    random_network,
    snerg_from_volume,
)
from snerg.core.errors import SnergError
from snerg.core.export.bundle import write_bundle
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import opened, picture

Serve = Callable[[Path], str]
BLACK = (0.0, 0.0, 0.0)
TURNED = (0.2, 0.3, 0.5)
FAR = (1e6, -2e6, 5e5)
NAMES = [camera.name for camera in make_cameras()]
FORWARD = [camera.name for camera in make_forward_cameras(make_frame())]


def compare(page: Page, address: str, scene: Scene, camera: Camera, name: str | int) -> None:
    """The mean difference is below half a level; only pixels at the network's threshold may differ visibly."""
    assert opened(page, f"{address}?camera={name}&width={camera.width}&height={camera.height}") is None
    shown = picture(page)
    for truth in (dense_march(scene, camera).over(), render_scene(scene, camera).over()):
        difference = np.abs(shown - truth)
        assert difference.mean() < 0.5 / 255
        assert np.mean(difference.max(axis=-1) < 2 / 255) > 0.999


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> tuple[Scene, str, Path]:
    scene = make_snerg(angles=TURNED)
    folder = tmp_path_factory.mktemp("turned") / "web"
    write_bundle(scene, make_cameras(), folder)
    return scene, serve(folder), folder


@pytest.mark.hard_case(10, 33, 34, 36, 37, 41, 42, 43)
@pytest.mark.parametrize("index", range(len(NAMES)), ids=NAMES)
def test_turned_box(page: Page, turned: tuple[Scene, str, Path], index: int) -> None:
    scene, address, _ = turned
    compare(page, address, scene, make_cameras()[index], index)


@pytest.mark.parametrize(
    ("centre", "size"), [(FAR, 2.0), ((3.0, 1.0, -2.0), 1e-3), ((0.0, 0.0, 0.0), 5e3)], ids=["far from the origin", "tiny", "huge"]
)
@pytest.mark.hard_case(6, 74)
def test_any_place_and_size(page: Page, tmp_path: Path, serve: Serve, centre: tuple[float, float, float], size: float) -> None:
    scene = make_snerg(angles=TURNED, centre=centre, size=size)
    cameras = make_cameras(centre, size)
    write_bundle(scene, cameras, tmp_path / "web")
    address = serve(tmp_path / "web")
    for index in (0, 2):
        compare(page, address, scene, cameras[index], index)
    page.mouse.move(60, 60)
    page.mouse.down()
    page.mouse.move(90, 60, steps=3)
    page.mouse.up()
    moved = picture(page)
    assert np.abs(moved - render_scene(scene, cameras[2]).over()).mean() > 2 / 255, "the picture turns with the mouse"
    assert np.mean(moved < 0.99) > 0.1, "and the scene stays in it"


@pytest.mark.hard_case(34, 78)
@pytest.mark.parametrize("diffuse", [False, True], ids=["network", "diffuse"])
def test_thin_fog(page: Page, tmp_path: Path, serve: Serve, diffuse: bool) -> None:
    """Square roots are squared before they are interpolated, on the page as in the marcher."""
    scene = make_roots((44, 40, 57), angles=TURNED, diffuse=diffuse)
    write_bundle(scene, make_cameras(), tmp_path / "web")
    for index in (0, 2):
        compare(page, serve(tmp_path / "web"), scene, make_cameras()[index], index)


@pytest.fixture(scope="module")
def forward(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> tuple[Scene, str]:
    scene = make_forward()
    folder = tmp_path_factory.mktemp("forward") / "web"
    write_bundle(scene, make_forward_cameras(make_frame(), 160, 120), folder)
    return scene, serve(folder)


@pytest.mark.hard_case(9, 33, 34)
@pytest.mark.parametrize("index", range(len(FORWARD)), ids=FORWARD)
def test_forward_facing(page: Page, forward: tuple[Scene, str], index: int) -> None:
    scene, address = forward
    compare(page, address, scene, make_forward_cameras(make_frame(), 160, 120)[index], index)


@pytest.mark.hard_case(6, 74)
@pytest.mark.parametrize(("scale", "position"), [(1.0, FAR), (1e-3, (3.0, 1.0, -2.0)), (5e3, (0.0, 0.0, 0.0))], ids=["far", "tiny", "huge"])
def test_forward_facing_at_any_place_and_size(
    page: Page, tmp_path: Path, serve: Serve, scale: float, position: tuple[float, float, float]
) -> None:
    """Without cameras the page opens at the frame; it turns with the mouse and keeps the scene."""
    scene = make_forward(True, scale, position)
    write_bundle(scene, (), tmp_path / "web")
    camera = replace(make_forward_cameras(make_frame(scale, position), 160, 122)[0], focal=(128, 128))  # pixels are square
    compare(page, serve(tmp_path / "web"), scene, camera, 0)
    page.mouse.move(60, 60)
    page.mouse.down()
    page.mouse.move(70, 62, steps=3)
    page.mouse.up()
    moved = picture(page)
    assert np.abs(moved - render_scene(scene, camera).over()).mean() > 2 / 255, "the picture turns with the mouse"
    assert np.mean(moved < 0.99) > 0.1, "and the scene stays in it"


def test_only_forward_facing_scenes_have_ndc_code(page: Page, forward: tuple[Scene, str], turned: tuple[Scene, str, Path]) -> None:
    page.add_init_script("""
        const give = WebGL2RenderingContext.prototype.shaderSource;
        window.sources = "";
        WebGL2RenderingContext.prototype.shaderSource = function (shader, text) { window.sources += text; give.call(this, shader, text); };
    """)
    for address, there in ((forward[1], True), (turned[1], False)):
        assert opened(page, f"{address}?width=40&height=30") is None
        assert ("void toGrid" in page.evaluate("window.sources")) == there


def test_diffuse_scene_fetches_no_features(page: Page, tmp_path: Path, serve: Serve) -> None:
    scene = make_snerg(diffuse=True)
    write_bundle(scene, make_cameras(), tmp_path / "web")
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    address = serve(tmp_path / "web")
    compare(page, address, scene, make_cameras()[0], "Front")
    assert requests and all(url.startswith((address, "data:")) for url in requests), "nothing comes from elsewhere"
    assert not any("feature" in url for url in requests)


@pytest.mark.hard_case(51)
@pytest.mark.parametrize("diffuse", [False, True], ids=["view-dependent", "diffuse"])
def test_thin_fog_is_exact(page: Page, tmp_path: Path, serve: Serve, diffuse: bool) -> None:
    draw = np.random.default_rng(5)
    shape = (60, 40, 50)
    alpha = draw.integers(0, 4, (*shape, 1))
    values = np.concatenate([draw.integers(0, 256, (*shape, 3 if diffuse else 7)) % (alpha + 1), alpha], axis=-1).astype(np.uint8)
    scene = snerg_from_volume(values, None if diffuse else random_network(3), grid_to_world=np.eye(4), voxel_size=0.05)
    cameras = make_cameras((1.5, 1.0, 1.25), 2.0)
    write_bundle(scene, cameras, tmp_path / "web")
    compare(page, serve(tmp_path / "web"), scene, cameras[0], 0)


def test_features_of_empty_voxels_count(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Scenes that other programs baked may have features where alpha is 0: the page reads them there, as the marcher does."""
    scene = make_snerg((40, 45, 50), fog=False)
    cells = scene.cells.copy()
    alpha = cells[..., 7]
    cells[..., 3:7] = np.where((alpha == 0)[..., None], np.random.default_rng(2).integers(0, 9, (*alpha.shape, 4)), cells[..., 3:7])
    scene = replace(scene, cells=cells.astype(np.uint8))
    write_bundle(scene, make_cameras(), tmp_path / "web")
    compare(page, serve(tmp_path / "web"), scene, make_cameras()[0], 0)


@pytest.mark.hard_case(51, 58)
@pytest.mark.parametrize("diffuse", [False, True], ids=["view-dependent", "diffuse"])
@pytest.mark.parametrize("name", ["webp", "jpeg", "avif"])
def test_codecs(page: Page, tmp_path: Path, serve: Serve, name: str, diffuse: bool) -> None:
    """The page agrees with Python on the same files, except that decoders round differently; empty space stays empty."""
    codec = CodecSettings(name, 60)
    scene = make_snerg(angles=TURNED, shape=(40, 45, 50), diffuse=diffuse)
    write_bundle(scene, make_cameras(), tmp_path / "web", single_file=diffuse, codec=codec)
    write_scene(scene, tmp_path / "scene", codec=codec)
    back = read_scene(tmp_path / "scene")
    address = (tmp_path / "web" / "index.html").as_uri() if diffuse else serve(tmp_path / "web")
    camera = make_cameras()[0]
    assert opened(page, f"{address}?camera=0&width={camera.width}&height={camera.height}&background=black") is None
    shown = picture(page)
    difference = np.abs(shown - render_scene(back, camera).over(BLACK))
    assert difference.mean() < 0.6 / 255 and np.mean(difference.max(axis=-1) < 6 / 255) > 0.999
    if codec.lossless:
        assert np.abs(shown - dense_march(scene, camera).over(BLACK)).mean() < 0.5 / 255
    else:
        assert (shown[render_scene(scene, camera).alpha == 0] == 0).all(), "no haze"


@pytest.mark.parametrize("name", ["png", "webp", "avif"])
def test_features_at_half_the_resolution(page: Page, tmp_path: Path, serve: Serve, name: str) -> None:
    scene, codec = make_snerg(angles=TURNED, shape=(40, 45, 50)), CodecSettings(name, 90, half_features=True)
    write_bundle(scene, make_cameras(), tmp_path / "web", codec=codec)
    back = read_scene(tmp_path / "web" / "scene")
    assert (back.cells[..., 3:7] != scene.cells[..., 3:7]).any()
    compare(page, serve(tmp_path / "web"), back, make_cameras()[0], 0)


@pytest.mark.parametrize("known", [False, True], ids=["webp", "jxl"])
def test_a_browser_loads_jpeg_xl_where_it_decodes_it(launch: Callable[..., Browser], tmp_path: Path, serve: Serve, known: bool) -> None:
    """Chromium 147 decodes it behind a flag; without, the page loads WebP. Both are lossless."""
    pytest.importorskip("pillow_jxl")
    scene = make_snerg(angles=TURNED, shape=(40, 45, 50))
    write_bundle(scene, make_cameras(), tmp_path / "web", codec=CodecSettings("jxl"))
    browser = launch(*(["--enable-features=JXLImageFormat"] if known else []))
    page = browser.new_page(viewport={"width": 500, "height": 400})
    requests: list[str] = []
    page.on("request", lambda request: "/scene/" in request.url and requests.append(request.url.rpartition(".")[2]))
    compare(page, serve(tmp_path / "web"), scene, make_cameras()[0], 0)
    browser.close()
    assert ("jxl" in requests, "webp" in requests) == (known, not known)


@pytest.mark.hard_case(54)
def test_more_blocks_than_eight_bits_count(page: Page, tmp_path: Path, serve: Serve) -> None:
    values = np.zeros((30 * 256 + 20, 12, 4, 4), np.uint8)
    values[::3] = 60, 120, 30, 160
    values[-60:] = 200, 20, 60, 220
    values[:60] = 20, 20, 200, 220
    values[300:7300] = 0
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.01)
    for index, at in enumerate((1.5, 75.3)):
        pose = looking((at, -2.0, 0.8), (at, 0.06, 0.02))
        camera = Camera(160, 90, (120, 120), (80, 45), pose, name="There")
        write_bundle(scene, [camera], tmp_path / str(index))
        compare(page, serve(tmp_path / str(index)), scene, camera, 0)
        assert picture(page).std() > 0.05


@pytest.mark.hard_case(55)
def test_a_grid_of_more_blocks_than_a_device_holds_says_so(page: Page, tmp_path: Path, serve: Serve) -> None:
    values = np.zeros((30 * 65, 4, 4, 4), np.uint8)
    values[-2:] = 200
    write_bundle(snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.01), (), tmp_path / "web")
    page.add_init_script(mocked_limit(64))
    problem = opened(page, serve(tmp_path / "web"))
    assert problem == "The scene's grid is too large for this device: 65 x 1 x 1 blocks, and it holds 64 a side."


@pytest.mark.parametrize("name", ["h264", "float"])
def test_what_browsers_do_not_show_is_refused(tmp_path: Path, name: str) -> None:
    scene = make_snerg((20, 20, 20))
    if name == "float":
        scene = replace(scene, cells=(scene.cells / 255).astype(np.float32))
    with pytest.raises(SnergError, match=r"Browsers decode no H.264|a web page holds 8 bits"):
        write_bundle(scene, (), tmp_path / "web", codec=CodecSettings("png" if name == "float" else name))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.hard_case(57)
def test_empty_and_opaque_scenes_open(page: Page, tmp_path: Path, serve: Serve) -> None:
    write_bundle(empty_snerg(), (), tmp_path / "empty")
    assert opened(page, serve(tmp_path / "empty") + "?width=80&height=60") is None
    assert (picture(page) == 1).all()
    opaque = snerg_from_volume(np.full((31, 31, 31, 4), 255, np.uint8), None, grid_to_world=np.eye(4), voxel_size=1 / 31)
    opaque = replace(opaque, cells=opaque.cells // np.array([1, 2, 1, 1], np.uint8))
    camera = make_cameras((0.5, 0.5, 0.5), 1.0)[0]
    write_bundle(opaque, [camera], tmp_path / "opaque")
    compare(page, serve(tmp_path / "opaque"), opaque, camera, 0)


def test_single_file_from_the_disk(page: Page, tmp_path: Path) -> None:
    scene = make_snerg(angles=TURNED, shape=(40, 45, 50))
    result = write_bundle(scene, make_cameras(), tmp_path / "web", single_file=True)
    files = [path.name for path in (tmp_path / "web").iterdir() if not path.name.startswith(".")]
    assert files == ["index.html"]
    assert result == {"files": 1, "bytes": (tmp_path / "web" / "index.html").stat().st_size}
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    compare(page, (tmp_path / "web" / "index.html").as_uri(), scene, make_cameras()[1], "Shifted, rolled")
    assert len([url for url in requests if not url.startswith("data:")]) == 1


@pytest.mark.hard_case(55)
@pytest.mark.parametrize("limit", [64, 256, 2048])
def test_texture_limits(page: Page, turned: tuple[Scene, str, Path], limit: int) -> None:
    """30 cells: one texture holds them at 256; at 64 they need four."""
    page.add_init_script(mocked_limit(limit))
    scene, address, _ = turned
    compare(page, address, scene, make_cameras()[0], 0)


def mocked_limit(limit: int) -> str:
    return f"""
        const ask = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {{
          return name === WebGL2RenderingContext.MAX_3D_TEXTURE_SIZE ? {limit} : ask.call(this, name);
        }};
        const allocate = WebGL2RenderingContext.prototype.texStorage3D;
        WebGL2RenderingContext.prototype.texStorage3D = function (target, levels, format, ...size) {{
          if (Math.max(...size) > {limit}) throw new Error("over the limit");
          return allocate.call(this, target, levels, format, ...size);
        }};
    """


def test_a_device_too_small_says_so(page: Page, turned: tuple[Scene, str, Path]) -> None:
    page.add_init_script(mocked_limit(32))
    problem = opened(page, turned[1])
    assert problem and problem.startswith("The scene's texture is too large for this device: it has 30 blocks")
