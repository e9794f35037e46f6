"""The page for everybody: screen readers, keys alone, large text, small screens, high contrast."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from scenes import make_cameras, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.tests.web.conftest import ROOT, opened, picture_of

Serve = Callable[[Path], str]
AXE = """axe.run(document, { resultTypes: ['violations'] })
    .then((found) => found.violations.map((one) => [one.id, one.nodes.map((node) => node.html)]))"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("access") / "web"
    write_bundle(make_snerg(shape=(34, 30, 40)), make_cameras(), folder)
    return folder


@pytest.fixture(params=[(390, "none"), (1280, "none"), (1280, "active")], ids=["phone", "desktop", "contrast"])
def axed(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """A page that runs axe-core, which its own security policy would forbid."""
    width, colours = request.param
    context = browser.new_context(viewport={"width": width, "height": 700}, bypass_csp=True, forced_colors=colours)
    yield context.new_page()
    context.close()


def faults(page: Page) -> object:
    page.add_script_tag(path=ROOT / "node_modules" / "axe-core" / "axe.min.js")
    forced = page.evaluate("matchMedia('(forced-colors: active)').matches")
    # In high contrast the system gives the colours, which axe does not see: it compares those of the style sheet.
    page.evaluate(f"axe.configure({{ rules: [{{ id: 'color-contrast', enabled: {str(not forced).lower()} }}] }})")
    return page.evaluate(AXE)


@pytest.mark.slow
def test_axe_finds_nothing(axed: Page, made: Path, serve: Serve) -> None:
    """The rules of axe-core for accessibility, on the page in each of its states."""
    assert opened(axed, serve(made)) is None
    assert faults(axed) == []
    menu = axed.get_by_role("button", name="Menu")
    narrow = menu.is_visible()
    if narrow:
        menu.click()
        assert menu.get_attribute("aria-expanded") == "true" and faults(axed) == []
    for opens in ("Share", "Picture", "Help"):
        if narrow and menu.get_attribute("aria-expanded") == "false":
            menu.click()
        axed.get_by_role("button", name=opens, exact=True).click()
        assert faults(axed) == []
        axed.get_by_role("dialog").get_by_role("button", name="Close").click()
    axed.locator("#canvas").press("v")
    axed.locator("#canvas").press("m")
    axed.locator("#canvas").press("i")
    assert axed.locator("#stick").is_visible() and axed.locator("#readout").is_visible() and faults(axed) == []


def test_axe_finds_nothing_while_loading_and_after_an_error(axed: Page, made: Path, serve: Serve, tmp_path: Path) -> None:
    copied = Path(shutil.copytree(made, tmp_path / "web"))
    (copied / "poster.webp").unlink()
    cameras = (copied / "cameras.json").read_text()
    (copied / "cameras.json").write_text(cameras.replace('"version"', '"coarse":true,"version"', 1))  # whose files are not there
    axed.route("**/scene/rgba_001.png", lambda route: None)  # not answered
    axed.goto(serve(copied))
    axed.get_by_text("Loading the scene: ").wait_for()
    axed.get_by_role("log").get_by_text("coarse/scene.json is missing").wait_for()
    assert faults(axed) == []
    axed.unroute_all()
    (copied / "scene" / "scene.json").write_text("null")
    assert "damaged" in str(opened(axed, serve(copied)))
    assert faults(axed) == []


def heard(page: Page) -> list[str]:
    return page.evaluate("window.heard")


LISTEN = """
    window.heard = [];
    addEventListener('DOMContentLoaded', () => {
        const attach = () => {
            const spoken = document.querySelector('snerg-viewer')?.shadowRoot?.getElementById('spoken');
            if (!spoken) return setTimeout(attach, 1);
            if (spoken.textContent) window.heard.push(spoken.textContent);
            new MutationObserver(() => window.heard.push(spoken.textContent)).observe(spoken, { childList: true });
        };
        attach();
    });
"""


@pytest.mark.slow
def test_what_happens_is_said_in_words(page: Page, made: Path, serve: Serve) -> None:
    """Loading in quarters, the camera, where the view went, and how one moves."""
    page.add_init_script(LISTEN)
    assert opened(page, serve(made) + "?width=160&height=120") is None
    assert page.get_by_role("status").first.get_attribute("id") == "spoken"
    assert heard(page)[0] == "Loading the scene." and heard(page)[-1] == "The whole scene is shown. Camera Front, 1 of 7."
    assert len(heard(page)) <= 6
    canvas = page.locator("#canvas")
    for key, text in (
        ("2", "Camera Shifted, rolled, 2 of 7."),
        ("1", "Camera Front, 1 of 7."),
        ("ArrowUp", "Seen from the front, 28 degrees above."),
        ("v", "Fly: W, A, S and D move"),
        ("v", "Walk: W, A, S and D move on the level"),
        ("v", "Orbit: the camera turns around the scene."),
    ):
        canvas.press(key)
        page.get_by_text(text).first.wait_for(state="attached")
    assert heard(page).count("Camera Front, 1 of 7.") <= 2


def test_single_key_shortcuts_can_be_kept_to_the_picture(page: Page, made: Path, serve: Serve) -> None:
    """WCAG 2.1.4. Named keys stay; the choice outlives the page; and what is chosen off can be chosen on."""

    def state() -> dict[str, object]:
        return page.evaluate("document.querySelector('snerg-viewer').viewer.state")

    def choose(everywhere: bool) -> None:
        page.get_by_role("button", name="Help").click()
        page.get_by_role("checkbox", name="Single-key shortcuts").set_checked(everywhere)
        page.get_by_role("button", name="Close").click()

    assert opened(page, serve(made) + "?width=80&height=60") is None
    page.emulate_media(reduced_motion="reduce")  # cameras change at once
    page.keyboard.press("2")
    assert state()["camera"] == "Shifted, rolled"
    choose(False)
    for focused in ("help", None):
        page.evaluate("document.querySelector('snerg-viewer').shadowRoot.activeElement?.blur()")
        if focused:
            page.locator(f"#{focused}").focus()
        for key in ("3", "v", "n", "-", "c"):
            page.keyboard.press(key)
        assert (state()["camera"], state()["mode"], state()["atCamera"]) == ("Shifted, rolled", "orbit", True)
    page.locator("#help").press("ArrowUp")
    assert state()["atCamera"] is False, "an arrow is no character"
    page.locator("#canvas").press("1")
    assert state()["camera"] == "Front"
    page.reload()
    assert page.evaluate("window.snerg.ready")
    page.locator("#canvas").press("1")
    page.locator("#help").press("2")
    assert state()["camera"] == "Front"
    choose(True)
    page.locator("#help").press("2")
    assert state()["camera"] == "Shifted, rolled"


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390, 820, 1280])
@pytest.mark.parametrize("text", [100, 200])
def test_everything_fits_and_is_large_enough_to_hit(browser: Browser, made: Path, serve: Serve, width: int, text: int) -> None:
    """Nothing is cut off, nothing lies over another thing, and targets have 44 pixels, also where text is twice as large."""
    context = browser.new_context(viewport={"width": width, "height": 640})
    page = context.new_page()
    assert opened(page, serve(made)) is None
    page.evaluate(f"document.documentElement.style.fontSize = '{text}%'")
    menu = page.get_by_role("button", name="Menu")
    if menu.is_visible():
        menu.click()
    boxes = []
    for control in page.locator("#bar").locator("button, select, label").all():
        if not control.is_visible():
            continue
        control.scroll_into_view_if_needed()
        box = control.bounding_box()
        assert box and box["width"] >= 44 and box["height"] >= 44, control.evaluate("one => one.outerHTML")
        assert box["x"] >= 0 and box["x"] + box["width"] <= width + 0.5, control.evaluate("one => one.outerHTML")
        boxes.append(box)
    assert len(boxes) >= 13
    for a, b in itertools.combinations(boxes, 2):
        apart_x = a["x"] + a["width"] <= b["x"] + 0.5 or b["x"] + b["width"] <= a["x"] + 0.5
        assert apart_x or a["y"] + a["height"] <= b["y"] + 0.5 or b["y"] + b["height"] <= a["y"] + 0.5
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for name, closes in (("share", "close"), ("picture", "cancel"), ("help", "close-help")):
        page.locator(f"#{name}").evaluate("button => button.click()")
        dialog = page.locator("dialog[open]")
        assert dialog.evaluate("one => one.scrollWidth <= one.clientWidth")
        button = page.locator(f"#{closes}")
        button.scroll_into_view_if_needed()
        box = button.bounding_box()
        assert box and box["y"] >= 0 and box["y"] + box["height"] <= 640
        button.click()
    context.close()


@pytest.mark.slow
@pytest.mark.parametrize("colours", ["none", "active"])
def test_the_focus_is_seen_everywhere(browser: Browser, made: Path, serve: Serve, colours: str) -> None:
    """Every stop of the Tab key looks different with the focus than without."""
    context = browser.new_context(viewport={"width": 1280, "height": 500}, forced_colors=colours)
    page = context.new_page()
    assert opened(page, serve(made)) is None
    page.evaluate("window.snerg.settled()")
    stops = set()
    for _ in range(20):
        page.keyboard.press("Tab")
        focused = page.evaluate("document.querySelector('snerg-viewer').shadowRoot.activeElement?.id ?? ''")
        if page.evaluate("document.activeElement === document.body"):
            break
        outline = page.evaluate("""(() => {
            const style = getComputedStyle(document.querySelector('snerg-viewer').shadowRoot.activeElement);
            return style.outlineStyle !== 'none' && parseFloat(style.outlineWidth);
        })()""")
        assert outline >= 2, focused
        stops.add(focused)
    assert {"canvas", "previous", "camera", "next", "reset", "mode", "colour", "share", "picture", "fullscreen", "help"} <= stops
    page.locator("#canvas").focus()
    page.keyboard.press("Shift")  # the focus came by key
    ringed = page.locator("#canvas").screenshot()
    page.locator("#canvas").evaluate("canvas => canvas.blur()")
    assert ringed != page.locator("#canvas").screenshot()
    context.close()


@pytest.mark.slow
def test_chosen_backgrounds_are_seen_in_high_contrast(browser: Browser, made: Path, serve: Serve) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 500}, forced_colors="active")
    page = context.new_page()
    assert opened(page, serve(made)) is None
    seen = []
    for name in ("White", "Black"):
        page.get_by_role("radio", name=f"{name} background").check()
        page.locator("#canvas").evaluate("canvas => canvas.focus()")
        seen.append(page.locator("[name=background][value=white]").locator("..").screenshot())
    assert seen[0] != seen[1]
    assert np.ptp(picture_of(page)) > 0.5  # the picture keeps its colours
    context.close()


def test_names_are_text(page: Page, made: Path, serve: Serve, tmp_path: Path) -> None:
    """Whatever a camera is called, it is shown and said as it is written."""
    copied = Path(shutil.copytree(made, tmp_path / "web"))
    hostile = "<img src=x onerror=document.title='hacked'></select><script>document.title='hacked'</script>"
    cameras = (copied / "cameras.json").read_text()
    (copied / "cameras.json").write_text(cameras.replace('"Front"', '"' + hostile + '"'))
    title = "SNeRG"
    assert opened(page, serve(copied) + "?width=160&height=120") is None
    assert page.locator("#camera option").first.inner_text() == hostile
    page.locator("#canvas").press("2")
    page.locator("#canvas").press("1")
    page.get_by_text("Camera <img").first.wait_for(state="attached")
    assert page.locator("#spoken").inner_text().endswith(f"Camera {hostile}, 1 of 7.")
    assert page.title() == title and page.locator("#spoken *").count() == 0
