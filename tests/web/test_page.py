"""The page's controls, and its error messages."""

from __future__ import annotations

import html
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route

from scenes import make_cameras, make_roots, make_snerg
from snerg.core.errors import SnergError
from snerg.core.export import bundle
from snerg.core.export.bundle import write_bundle
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.page_settings import PageSettings
from snerg.core.geometry.distortion import Distortion
from snerg.core.rendering.render import render_scene
from snerg.core.scene.coarse import coarse_scene
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import opened, picture

Serve = Callable[[Path], str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page") / "web"
    write_bundle(make_snerg(shape=(34, 30, 40)), make_cameras(), folder)
    return folder


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "web"))


def truth(index: int) -> np.ndarray:
    return render_scene(make_snerg(shape=(34, 30, 40)), make_cameras()[index]).over()


def near(shown: np.ndarray, expected: np.ndarray) -> bool:
    return bool(np.abs(shown - expected).mean() < 0.5 / 255)


def test_cameras_backgrounds_and_orbit(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made) + "?width=160&height=120&background=grey") is None
    first = truth(0)
    scene, camera = make_snerg(shape=(34, 30, 40)), make_cameras()[0]
    assert near(picture(page), render_scene(scene, camera).over((128 / 255,) * 3))
    page.get_by_role("radio", name="White background").check()
    assert near(picture(page), first)

    page.get_by_role("combobox", name="Camera").select_option("Parallel")
    assert near(picture(page), truth(2))
    page.wait_for_url("**#*camera=Parallel*")  # once the view stands still
    assert parse_qs(urlsplit(page.url).fragment) == {"camera": ["Parallel"], "background": ["white"]}
    page.get_by_role("button", name="Next camera").click()
    assert near(picture(page), truth(3))
    page.locator("#canvas").press("1")
    assert near(picture(page), first)

    page.mouse.move(80, 60)
    page.mouse.down()
    page.mouse.move(110, 70, steps=4)
    page.mouse.up()
    turned = picture(page)
    assert np.abs(turned - first).mean() > 2 / 255
    page.mouse.wheel(0, -300)
    assert np.abs(picture(page) - turned).mean() > 1 / 255
    page.get_by_role("button", name="Reset view").click()
    assert near(picture(page), first)
    page.locator("#canvas").press("ArrowLeft")
    assert np.abs(picture(page) - first).mean() > 1 / 255


def test_the_page_says_what_it_shows(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Titles are text, whatever they hold; the poster is the first camera's picture, there before any slice is."""
    title, text = 'Stone "head" <b>&amp;</b>', "Photographed' in <i>Rome</i>"
    settings = PageSettings(title, text, "https://example.org/head", background="black")
    write_bundle(make_snerg(shape=(34, 30, 40)), make_cameras(), tmp_path / "web", page=settings)
    page.route("**/scene/*.png", lambda route: None)  # never answered
    page.goto(serve(tmp_path / "web"))
    poster = page.locator("#poster")
    poster.wait_for(state="visible")
    assert page.title() == title
    assert page.locator("meta[name=description]").get_attribute("content") == text
    assert page.locator("meta[property='og:image']").get_attribute("content") == "https://example.org/head/poster.webp"
    with Image.open(tmp_path / "web" / "poster.webp") as image:
        shown = np.asarray(image.convert("RGB")) / 255
    scene, camera = make_snerg(shape=(34, 30, 40)), make_cameras()[0]
    assert np.abs(shown - render_scene(scene, camera).over((0.0, 0.0, 0.0))).mean() < 3 / 255
    page.unroute_all()
    assert opened(page, serve(tmp_path / "web")) is None and poster.is_hidden()


@pytest.mark.parametrize("make", [make_snerg, pytest.param(make_roots, marks=pytest.mark.slow)])
def test_the_coarse_scene_comes_first(page: Page, tmp_path: Path, serve: Serve, make: Callable[..., Scene]) -> None:
    """While the slices are on their way, the poster shows the first view, and the coarse scene every other one; of thin fog, too."""
    scene = make(shape=(131, 122, 122))
    write_bundle(scene, make_cameras(), tmp_path / "web")
    page.route("**/scene/rgba_*.png", lambda route: None)  # not answered for now
    page.goto(serve(tmp_path / "web") + "?width=160&height=120")
    page.get_by_role("combobox", name="Camera").wait_for()
    assert page.locator("#poster").is_visible() and page.locator("#loading").is_visible()
    page.get_by_role("combobox", name="Camera").select_option("Parallel")
    shown, expected = picture(page), render_scene(coarse_scene(scene), make_cameras()[2]).over()
    assert np.abs(shown - expected)[:60].mean() < 1 / 255  # the progress lies over the picture's foot; as a stand-in it is smoother
    assert expected[:60].std() > 0.05
    assert page.locator("#poster").is_hidden()
    page.unroute("**/scene/rgba_*.png")  # lets what was held go on
    assert page.evaluate("window.snerg.ready") and page.evaluate("window.snerg.problem") is None
    assert near(picture(page), render_scene(scene, make_cameras()[2]).over())
    assert page.locator("#loading").is_hidden()


@pytest.mark.slow
def test_the_picture_grows(page: Page, tmp_path: Path, serve: Serve) -> None:
    """While later layers are on their way, the first view is whole already, another one has no holes, and a lost context is mended."""
    scene = make_snerg(shape=(131, 122, 122))
    solid = scene.cells.copy()
    solid[..., -1] = 255
    scene = replace(scene, cells=solid)
    write_bundle(scene, make_cameras(), tmp_path / "web")
    layers = json.loads((tmp_path / "web" / "cameras.json").read_text())["layers"]
    assert layers["order"] == sorted(layers["order"]) and 0 < layers["seen"] < len(layers["order"])
    held = f"**/scene/rgba_{8 * layers['seen'] + 3:03}.png"
    page.route(held, lambda route: None)  # the layers behind what the camera sees are not answered for now
    page.goto(serve(tmp_path / "web") + "?width=160&height=120")
    page.locator("#poster").wait_for(state="hidden")  # all is there that the first camera sees
    clear = slice(0, 48)  # rows above the progress
    assert near(picture(page)[clear], truth_of(scene, 0)[clear]) and page.get_by_role("status").is_visible()
    page.get_by_role("combobox", name="Camera").select_option("Parallel")
    grown, coarse, whole = picture(page), render_scene(coarse_scene(scene), make_cameras()[2]).over(), truth_of(scene, 2)
    assert np.abs(grown - whole)[clear].mean() < 0.5 * np.abs(coarse - whole)[clear].mean()
    page.locator("#canvas").evaluate(LOSE)
    page.unroute(held)
    assert page.evaluate("window.snerg.ready") and page.evaluate("window.snerg.problem") is None
    assert near(picture(page), whole)


def truth_of(scene: Scene, index: int) -> np.ndarray:
    return render_scene(scene, make_cameras()[index]).over()


def test_a_poster_lies_inside_a_single_file(page: Page, tmp_path: Path) -> None:
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras(), tmp_path / "web", single_file=True)
    page.goto((tmp_path / "web" / "index.html").as_uri())
    assert page.locator("#poster").evaluate("poster => poster.decode().then(() => poster.naturalWidth)") == make_cameras()[0].width


def test_the_orbit_stays_within_its_limits(page: Page, tmp_path: Path, serve: Serve) -> None:
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras(), tmp_path / "web", page=PageSettings(elevation=(0, 30), distance=(2, 3)))
    assert opened(page, serve(tmp_path / "web") + "?width=80&height=60") is None
    for key, turns, bounds in (("ArrowUp", 40, (0.4, 0.51)), ("ArrowDown", 40, (-0.01, 0.1))):
        for _ in range(turns):
            page.locator("#canvas").press(key)
        backward = page.evaluate("document.querySelector('snerg-viewer').viewer.state.cameraToWorld.map((row) => row[2])")
        assert bounds[0] < backward[2] < bounds[1]  # the sine of the elevation


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"background": "pink"}, "no background 'pink'"),
        ({"address": "example.org"}, "begins with https://"),
        ({"distance": (3.0, 2.0)}, "the smaller one first"),
        ({"distance": (0.0, 2.0)}, "above 0"),
        ({"elevation": (-91.0, 2.0)}, "from -90 to 90"),
        ({"elevation": (float("nan"), 2.0)}, "from -90 to 90"),
    ],
)
def test_page_settings_are_checked(settings: dict, words: str) -> None:
    with pytest.raises(SnergError, match=words):
        PageSettings(**settings)


@pytest.mark.parametrize("camera", ["Front", "Parallel"])
def test_a_view_is_shared(page: Page, browser: Browser, made: Path, serve: Serve, camera: str) -> None:
    """A link to a view that somebody turned and zoomed to shows the same picture elsewhere, and what else it says stays."""
    assert opened(page, serve(made) + f"?width=160&height=120&camera={camera}#from=letter") is None
    page.locator("#canvas").press("ArrowLeft")
    page.locator("#canvas").press("ArrowUp")
    page.mouse.move(80, 60)
    page.mouse.wheel(0, -300)
    page.get_by_role("radio", name="Black background").check()
    turned = picture(page)
    page.wait_for_url("**&view=*")
    assert "from=letter&" in page.url
    page.get_by_role("button", name="Share").click()
    link = page.get_by_role("textbox", name="Link").input_value()
    assert link == page.url
    embed = page.get_by_role("textbox", name="To put it into a page").input_value()
    assert html.unescape(embed.split('src="')[1].split('"')[0]) == link
    other = browser.new_page()
    assert opened(other, link) is None
    assert np.abs(picture(other) - turned).max() < 2 / 255
    other.get_by_role("button", name="Reset view").click()
    assert near(picture(other), render_scene(make_snerg(shape=(34, 30, 40)), make_cameras()[0 if camera == "Front" else 2]).over((0, 0, 0)))
    other.close()


def test_the_address_names_cameras_by_number_too(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made) + "?width=160&height=120") is None
    page.evaluate("location.hash = 'camera=2'")
    page.wait_for_url("**#*camera=Parallel*")
    assert near(picture(page), truth(2))


def test_a_viewer_that_is_closed_reads_nothing_more(page: Page, made: Path, serve: Serve) -> None:
    """Also where its first scene is still on its way."""
    asked: list[str] = []

    def hold(route: Route) -> None:
        asked.append(route.request.url)  # and never answered

    page.route("**/scene/rgba_*.png", hold)
    page.goto(serve(made))
    while not asked:
        page.wait_for_timeout(50)
    with page.expect_event("requestfailed", lambda request: request.url == asked[0]):
        page.evaluate("document.querySelector('snerg-viewer').remove()")


def test_keys_zoom(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made) + "?width=160&height=120") is None
    first = picture(page)
    page.locator("#canvas").press("+")
    assert np.abs(picture(page) - first).mean() > 1 / 255
    page.locator("#canvas").press("-")
    assert np.abs(picture(page) - first).mean() < 1 / 255


def test_the_wheel_scrolls_the_page_around_a_frame(page: Page, made: Path, serve: Serve) -> None:
    """It zooms with Ctrl alone, and a hint says so."""
    (made / "around.html").write_text('<iframe src="index.html?width=160&height=120" width="300" height="200"></iframe>')
    page.goto(serve(made) + "around.html")
    (made / "around.html").unlink()
    inside = page.frames[1]
    inside.wait_for_load_state()
    assert inside.evaluate("window.snerg.ready")
    place = "JSON.stringify(document.querySelector('snerg-viewer').viewer.state.cameraToWorld)"
    before = inside.evaluate(place)
    page.mouse.move(60, 60)
    page.mouse.wheel(0, -300)
    inside.get_by_text("Hold Ctrl").wait_for(state="visible")
    assert inside.evaluate(place) == before
    page.keyboard.down("Control")
    page.mouse.wheel(0, -300)
    page.keyboard.up("Control")
    for _ in range(30):
        page.wait_for_timeout(100)
        if inside.evaluate(place) != before:
            return
    pytest.fail("Ctrl and the wheel do not zoom")


@pytest.mark.parametrize("view", ["1,2,3", "a,b,c,d,e,f,g", "0,0,0,0,0,0,0", "1e999,0,0,0,0,0,1", ""])
def test_a_damaged_link_shows_the_camera(page: Page, made: Path, serve: Serve, view: str) -> None:
    assert opened(page, serve(made) + f"?width=160&height=120#view={view}&zoom=-3&background=pink") is None
    assert near(picture(page), truth(0))


@pytest.mark.parametrize("alpha", [False, True])
def test_a_picture_is_saved_at_any_size(page: Page, made: Path, serve: Serve, tmp_path: Path, alpha: bool) -> None:
    assert opened(page, serve(made)) is None
    page.get_by_role("button", name="Picture").click()
    page.get_by_role("spinbutton", name="Width").fill("320")
    page.get_by_role("spinbutton", name="Height").fill("240")
    page.get_by_role("checkbox", name="Without the background").set_checked(alpha)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save PNG").click()
    download.value.save_as(tmp_path / "saved.png")
    assert download.value.suggested_filename == "Front.png"
    with Image.open(tmp_path / "saved.png") as image:
        saved = np.asarray(image) / 255
    expected = render_scene(make_snerg(shape=(34, 30, 40)), make_cameras()[0].resized(320, 240))
    assert saved.shape == (240, 320, 4)
    assert np.abs(saved[..., 3] - (expected.alpha if alpha else 1)).mean() < 0.5 / 255
    shown = saved[..., :3] * saved[..., 3:] + (1 - saved[..., 3:])
    assert near(shown, expected.over())
    assert page.locator("#readout").is_hidden()


@pytest.mark.parametrize("word", ["constructor", "__proto__", "toString", "hasOwnProperty", "pink", ""])
def test_the_address_may_hold_any_word(page: Page, made: Path, serve: Serve, word: str) -> None:
    """Names of properties that every JavaScript object has are no backgrounds, cameras or keys: the page shows the defaults."""
    assert opened(page, serve(made) + f"?width=80&height=60&background={word}&camera={word}&ui={word}") is None
    assert page.locator("[name=background][value=white]").is_checked()
    canvas = page.locator("#canvas")
    for event in (
        f"KeyboardEvent('keydown', {{ ...up, key: {json.dumps(word)} }})",
        "Event('keydown', up)",
    ):  # the second: a form is filled in
        canvas.evaluate(f"canvas => {{ const up = {{ bubbles: true, composed: true }}; canvas.dispatchEvent(new {event}); }}")
    assert page.evaluate("window.snerg.problem") is None


@pytest.mark.parametrize("name", [{"toString": 1}, [], 7, None, "__proto__"])
def test_a_camera_may_have_any_name(page: Page, copied: Path, serve: Serve, name: object) -> None:
    path = copied / "cameras.json"
    value = json.loads(path.read_text())
    value["cameras"][0]["name"] = name
    path.write_text(json.dumps(value))
    assert opened(page, serve(copied) + "?width=80&height=60") is None
    assert page.locator("#camera option").first.inner_text() == (name if isinstance(name, str) else "View 1")


def test_a_level_camera_stays_where_it_is_when_touched(page: Page, made: Path, serve: Serve) -> None:
    """The orbit starts at the camera's own view: a small turn and back changes nothing."""
    address = serve(made)
    for index in (0, 2, 4):
        camera = make_cameras()[index]
        assert opened(page, f"{address}?camera={index}&width={camera.width}&height={camera.height}") is None
        page.locator("#canvas").press("ArrowLeft")
        page.locator("#canvas").press("ArrowRight")
        assert np.abs(picture(page) - truth(index)).mean() < 1 / 255, camera.name


def test_nothing_is_drawn_while_nothing_moves(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made)) is None
    page.evaluate("window.snerg.settled()")
    before = page.evaluate("window.snerg.frames")
    page.wait_for_timeout(500)
    assert page.evaluate("window.snerg.frames") == before > 0


def test_the_frame_fits_a_page_of_another_shape(page: Page, made: Path, serve: Serve) -> None:
    """A page twice as wide shows the camera's frame in its middle."""
    assert opened(page, serve(made) + "?camera=Front&width=320&height=120") is None
    page.locator("#frame").evaluate("frame => frame.remove()")
    assert near(picture(page)[:, 80:240], truth(0))


def test_opens_from_the_disk_with_a_hint(page: Page, made: Path) -> None:
    problem = opened(page, (made / "index.html").as_uri())
    assert problem and "python3 -m http.server" in problem and "single file" in problem


@pytest.mark.parametrize(
    "name", ["scene/scene.json", "scene/indirection.png", "scene/rgba_003.png", "scene/feature_001.png", "cameras.json"]
)
def test_a_missing_file_is_named(page: Page, copied: Path, serve: Serve, name: str) -> None:
    (copied / name).unlink()
    problem = opened(page, serve(copied))
    assert problem and problem.startswith(f"The file {name} is missing from the server")


def test_a_missing_viewer_is_named(page: Page, copied: Path, serve: Serve) -> None:
    (copied / "viewer.js").unlink()
    page.goto(serve(copied))
    page.get_by_text("viewer.js is missing").wait_for(state="visible")


def damage_scene(key: str, value: object) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), key: value}).encode()


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("scene/scene.json", lambda data: data[: len(data) // 2], "it is not JSON"),
        ("scene/scene.json", lambda data: b"\xff\xfe", "it is not JSON"),
        ("scene/scene.json", lambda data: b"null", "does not describe a SNeRG scene"),
        ("scene/scene.json", damage_scene("version", 9), "has version 9"),
        ("scene/scene.json", damage_scene("voxel_size", 0), '"voxel_size"'),
        ("scene/scene.json", damage_scene("shape", [34, 30]), '"shape"'),
        ("scene/scene.json", damage_scene("network", {"weights_0": [[1]]}), '"network"'),
        ("scene/scene.json", damage_scene("cells", 10**9), '"cells"'),
        ("scene/scene.json", damage_scene("fill_holes", None), '"fill_holes"'),
        ("scene/scene.json", damage_scene("ndc", {"focal": [1, 1], "near": 1}), '"ndc"'),
        ("scene/scene.json", damage_scene("codec", {"name": "h264", "quality": 90}), '"codec"'),
        ("scene/rgba_002.png", lambda data: data[: len(data) // 2], "cut short"),
        ("scene/rgba_002.png", lambda data: data[:60] + bytes(20) + data[80:], "cannot be read"),
        ("scene/feature_002.png", lambda data: b"<!doctype html>", "it is not a PNG"),
        ("scene/indirection.png", lambda data: data[:16] + b"\0\0\0\x09" + data[20:], "that belongs here"),
        ("cameras.json", lambda data: b'{"cameras": [{"name": "A"}]}', "not a list of cameras"),
    ],
)
def test_a_damaged_file_is_named(page: Page, copied: Path, serve: Serve, name: str, damage: Callable[[bytes], bytes], words: str) -> None:
    data = (copied / name).read_bytes()
    (copied / name).write_bytes(damage(data))
    problem = opened(page, serve(copied))
    assert problem and problem.startswith(f"The file {name} ") and words in problem


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("scene/rgb_001.avif", lambda data: data[: len(data) // 2], "damaged, or this browser knows no image/avif"),
        ("scene/feature_001.avif", lambda data: b"", "damaged, or this browser knows no image/avif"),
        ("scene/alpha_001.png", lambda data: data[: len(data) // 2], "cut short"),
    ],
)
def test_a_damaged_picture_of_another_codec_is_named(
    page: Page, tmp_path: Path, serve: Serve, name: str, damage: Callable[[bytes], bytes], words: str
) -> None:
    write_bundle(make_snerg(shape=(20, 20, 20)), (), tmp_path / "web", codec=CodecSettings("avif"))
    path = tmp_path / "web" / name
    path.write_bytes(damage(path.read_bytes()))
    problem = opened(page, serve(tmp_path / "web"))
    assert problem and problem.startswith(f"The file {name} ") and words in problem


def test_a_browser_that_hides_canvases_says_so(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Protection against fingerprinting returns noise from a canvas."""
    page.add_init_script("""
        const noise = (x, y, w, h) => new ImageData(new Uint8ClampedArray(4 * w * h).fill(9), w);
        OffscreenCanvasRenderingContext2D.prototype.getImageData = noise;
    """)
    write_bundle(make_snerg(shape=(20, 20, 20)), (), tmp_path / "web", codec=CodecSettings("jpeg"))
    problem = opened(page, serve(tmp_path / "web"))
    assert problem and "fingerprinting" in problem


def test_a_camera_with_distortion_is_labelled(page: Page, tmp_path: Path, serve: Serve) -> None:
    plain = make_cameras()[0]
    bent = replace(plain, distortion=Distortion("opencv", (0.1,)), name="Phone")
    write_bundle(make_snerg(shape=(20, 20, 20)), [plain, bent], tmp_path / "web")
    assert opened(page, serve(tmp_path / "web")) is None
    assert page.locator("#camera option").all_inner_texts() == ["Front", "Phone (lens not shown)"]


def test_no_webgl(launch: Callable[..., Browser], made: Path, serve: Serve) -> None:
    browser = launch("--disable-3d-apis")
    problem = opened(browser.new_page(), serve(made))
    browser.close()
    assert problem and "no WebGL 2" in problem


LOSE = """async canvas => {
    const lost = canvas.getContext('webgl2').getExtension('WEBGL_lose_context');
    lost.loseContext();
    await new Promise((resolve) => setTimeout(resolve, 100));
    lost.restoreContext();
}"""


def test_a_lost_context_is_rebuilt(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made) + "?width=160&height=120") is None
    picture(page)
    frames = page.evaluate("window.snerg.frames")
    page.locator("#canvas").evaluate(LOSE)
    while page.evaluate("window.snerg.frames") == frames:  # the page's security policy forbids wait_for_function
        page.wait_for_timeout(100)
    assert page.evaluate("window.snerg.problem") is None and near(picture(page), truth(0))


def test_a_lost_context_where_files_have_gone_says_so(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made)) is None
    page.route("**/scene/rgba*", lambda route: route.fulfill(status=404))
    page.locator("#canvas").evaluate(LOSE)
    page.get_by_role("alert").wait_for()
    assert "graphics driver was reset" in page.get_by_role("alert").inner_text()


def test_a_refused_shader(page: Page, made: Path, serve: Serve) -> None:
    page.add_init_script("""
        const source = WebGL2RenderingContext.prototype.shaderSource;
        WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {
          return source.call(this, shader, text.replace("void main() {", "void main() { nonsense;"));
        };
    """)
    problem = opened(page, serve(made))
    assert problem and problem.startswith("The graphics driver refuses the viewer's shader") and "nonsense" in problem


def test_a_texture_that_memory_does_not_hold(page: Page, made: Path, serve: Serve) -> None:
    page.add_init_script("""
        let refused = false;
        const storage = WebGL2RenderingContext.prototype.texStorage3D;
        WebGL2RenderingContext.prototype.texStorage3D = function () { refused = true; };
        const error = WebGL2RenderingContext.prototype.getError;
        WebGL2RenderingContext.prototype.getError = function () {
          const result = refused ? WebGL2RenderingContext.OUT_OF_MEMORY : error.call(this);
          refused = false;
          return result;
        };
    """)
    problem = opened(page, serve(made))
    assert problem and "graphics memory does not hold its" in problem


def test_without_a_built_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "VIEWER", tmp_path / "nowhere")
    with pytest.raises(SnergError, match="make setup"):
        write_bundle(make_snerg(shape=(8, 8, 8)), (), tmp_path / "web")
    assert not (tmp_path / "web").exists()


@pytest.mark.parametrize("single_file", [False, True])
def test_cancelled_or_refused_leaves_nothing(tmp_path: Path, single_file: bool) -> None:
    def stop(fraction: float, what: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_bundle(make_snerg(shape=(8, 8, 8)), (), tmp_path / "web", single_file, stop)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "thesis.txt").write_text("mine")
    with pytest.raises(SnergError, match="holds other files"):
        write_bundle(make_snerg(shape=(8, 8, 8)), (), tmp_path / "web", single_file)


def test_the_licence_of_three_stays_with_it(made: Path, tmp_path: Path) -> None:
    write_bundle(make_snerg(shape=(8, 8, 8)), (), tmp_path / "one", single_file=True)
    for script in (made / "viewer.js", tmp_path / "one" / "index.html"):
        text = script.read_text(encoding="utf-8")
        assert "three.js authors" in text and "WITHOUT WARRANTY OF ANY KIND" in text
