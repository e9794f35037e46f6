"""Moving the page's camera by mouse, fingers, pen and keys."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, CDPSession, Page

from scenes import looking, make_cameras, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.tests.web.conftest import opened

Serve = Callable[[Path], str]
SIZE = (160, 120)
MIDDLE = (80, 60)
BALL = (84, 62)  # a point of the page where the first camera sees the scene


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a camera that is rolled, and one that looks straight down."""
    front = make_cameras()[0]
    rolled = replace(front, camera_to_world=looking((1.0, -4.2, 1.8), (0, 0, 0), 0.5), name="Rolled")
    down = replace(front, camera_to_world=looking((0.1, 0.2, 4.0), (0.1, 0.2, 0.0)), name="Down")
    folder = tmp_path_factory.mktemp("hands") / "web"
    write_bundle(make_snerg(shape=(34, 30, 40)), (*make_cameras(), rolled, down), folder)
    return folder


@pytest.fixture
def touched(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 390, "height": 600}, has_touch=True)
    yield context.new_page()
    context.close()


def show(page: Page, address: str, camera: str = "Front", scale: int = 1) -> None:
    assert opened(page, f"{address}?width={scale * SIZE[0]}&height={scale * SIZE[1]}&camera={camera}") is None


def viewer(page: Page, what: str) -> object:
    return page.evaluate(f"document.querySelector('snerg-viewer').viewer.{what}")


def pose(page: Page) -> NDArray[np.float64]:
    """Camera-to-world when everything has come to rest."""
    page.evaluate("window.snerg.settled()")
    return np.array(viewer(page, "state.cameraToWorld"))


def middle(page: Page, at: tuple[int, int] = MIDDLE) -> NDArray[np.float64]:
    """The point of the scene that is seen there."""
    found = viewer(page, f"pick([{list(at)}])[0]")
    assert isinstance(found, dict)
    return np.array(found["position"])


def roll(matrix: NDArray[np.float64]) -> float:
    """Of a camera around its view axis, in degrees: 0 where its x axis is level."""
    level = np.cross((0, 0, 1), matrix[:3, 2])
    x = matrix[:3, 0]
    return float(np.rad2deg(np.arctan2(np.dot(np.cross(level, x), matrix[:3, 2]), np.dot(level, x))))


def drag(page: Page, to: tuple[int, int], button: str = "left", key: str | None = None, begin: tuple[int, int] = MIDDLE) -> None:
    if key:
        page.keyboard.down(key)
    page.mouse.move(*begin)
    page.mouse.down(button=button)
    page.mouse.move(*to, steps=5)
    page.mouse.up(button=button)
    if key:
        page.keyboard.up(key)


class Fingers:
    """Touches of the screen, as the browser takes them from its hardware."""

    def __init__(self, page: Page) -> None:
        self.session: CDPSession = page.context.new_cdp_session(page)

    def send(self, kind: str, *points: tuple[float, float]) -> None:
        touches = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    def move(self, begin: list[tuple[float, float]], end: list[tuple[float, float]], steps: int = 6) -> None:
        self.send("touchStart", *begin)
        for step in range(1, steps + 1):
            part = step / steps
            self.send("touchMove", *((a + part * (c - a), b + part * (d - b)) for (a, b), (c, d) in zip(begin, end, strict=True)))
        self.send("touchEnd")


def test_a_mouse_orbits_slides_and_rolls(page: Page, made: Path, serve: Serve) -> None:
    show(page, serve(made))
    first = pose(page)
    drag(page, (100, 70))
    orbited = pose(page)
    assert roll(orbited) == pytest.approx(roll(first), abs=1e-3)
    assert not np.allclose(orbited[:3, :3], first[:3, :3])
    for button, key in (("right", None), ("middle", None), ("left", "Shift")):
        before = pose(page)
        drag(page, (100, 60), button, key)
        slid = pose(page)
        assert np.allclose(slid[:3, :3], before[:3, :3])
        assert (slid - before)[:3, 3] @ before[:3, 0] < -0.01  # the scene goes along with the hand
    before = pose(page)
    page.mouse.move(120, 60)
    page.keyboard.down("Alt")
    page.mouse.down()
    for degrees in range(5, 95, 5):
        page.mouse.move(80 + 40 * np.cos(np.deg2rad(degrees)), 60 + 40 * np.sin(np.deg2rad(degrees)))
    page.mouse.up()
    page.keyboard.up("Alt")
    assert np.allclose(pose(page)[:3, 2], before[:3, 2])  # it looks the same way
    assert abs(roll(pose(page)) - roll(before)) > 80


@pytest.mark.slow
def test_the_wheel_goes_to_the_pointer(page: Page, made: Path, serve: Serve) -> None:
    """What is under the pointer at the pivot's depth stays there, also where the camera may not come nearer."""
    show(page, serve(made))
    ray = "(() => { const v = document.querySelector('snerg-viewer').viewer; return v.project(%s); })()"
    before = pose(page)
    page.mouse.move(120, 30)
    drag(page, (81, 60))
    point = None
    for _ in range(3):
        page.mouse.move(*BALL)
        seen = middle(page, BALL)
        page.mouse.wheel(0, -100)
        pose(page)
        projected = page.evaluate(ray % list(seen))
        point = (projected["x"] - BALL[0], projected["y"] - BALL[1])
        assert np.hypot(*point) < 4
    assert np.linalg.norm(pose(page)[:3, 3] - seen) < np.linalg.norm(before[:3, 3] - seen)


def test_a_double_click_sets_the_pivot(page: Page, made: Path, serve: Serve) -> None:
    """The point comes to the middle, the camera stays where it is, and turns around that point afterwards."""
    show(page, serve(made))
    first, point = pose(page), middle(page, (95, 80))
    page.mouse.dblclick(95, 80)
    turned = pose(page)
    assert np.allclose(turned[:3, 3], first[:3, 3], atol=1e-6)
    toward = point - turned[:3, 3]
    assert np.allclose(toward / np.linalg.norm(toward), -turned[:3, 2], atol=1e-6)
    page.locator("#canvas").press("ArrowRight")
    orbited = pose(page)
    assert np.linalg.norm(orbited[:3, 3] - point) == pytest.approx(np.linalg.norm(toward))
    page.mouse.dblclick(3, 3)
    assert np.allclose(pose(page), orbited) and page.locator("#spoken").inner_text() == "There is nothing at this place."


@pytest.mark.slow
def test_keys_do_what_a_mouse_does(page: Page, made: Path, serve: Serve) -> None:
    show(page, serve(made))
    canvas = page.locator("#canvas")
    for key in ("ArrowLeft", "ArrowUp", "+", "-", "<", ">", "Shift+ArrowLeft", "Shift+ArrowDown"):
        before = pose(page)
        canvas.press(key)
        assert not np.allclose(pose(page), before), key
    page.locator("#canvas").press("r")
    first, point = pose(page), middle(page)
    canvas.press("c")
    canvas.press("ArrowRight")
    assert np.linalg.norm(pose(page)[:3, 3] - point) == pytest.approx(np.linalg.norm(first[:3, 3] - point))


@pytest.mark.parametrize("camera", ["Rolled", "Down"])
def test_a_rolled_camera_stays_rolled(page: Page, made: Path, serve: Serve, camera: str) -> None:
    show(page, serve(made), camera)
    first = pose(page)
    page.locator("#canvas").press("ArrowLeft")
    page.locator("#canvas").press("ArrowRight")
    assert np.allclose(pose(page), first, atol=1e-4)
    drag(page, (110, 60))
    turned = pose(page)
    assert np.allclose(np.linalg.det(turned[:3, :3]), 1)
    if camera == "Rolled":
        assert abs(roll(first)) > 20 and roll(turned) == pytest.approx(roll(first), abs=1e-3)


def test_a_move_eases_out_and_ends(page: Page, made: Path, serve: Serve) -> None:
    """The camera goes on after a key press, and when it has come to rest nothing is drawn any more."""
    show(page, serve(made))
    first = pose(page)
    # The frames after a key press, in one call: another one would be too slow.
    places = page.evaluate("""async () => {
        const { viewer } = document.querySelector('snerg-viewer');
        viewer.turn(0.5, 0);
        const places = [];
        for (let i = 0; i < 5; i++) {
            await new Promise(requestAnimationFrame);
            places.push(viewer.state.cameraToWorld[0][3]);
        }
        return places;
    }""")
    last = pose(page)[0, 3]
    ways = np.abs(np.array(places) - last)
    assert (np.diff(ways) < 0).all() and ways[-1] > 0 and ways[0] < abs(first[0, 3] - last)
    frames = page.evaluate("window.snerg.frames")
    page.wait_for_timeout(300)
    assert page.evaluate("window.snerg.frames") == frames


@pytest.mark.slow
def test_the_pace_does_not_depend_on_the_frame_rate(page: Page, made: Path, serve: Serve) -> None:
    """How far a move has come after a time is the same where frames are rare."""
    ways = []
    for every in (1, 4):
        page.add_init_script("""
            const request = window.requestAnimationFrame;
            window.every = 1;
            window.requestAnimationFrame = (act) => {
                let left = window.every;
                const wait = (time) => (--left > 0 ? request(wait) : act(time));
                return request(wait);
            };
        """)
        show(page, serve(made))
        first = pose(page)
        came, seconds = page.evaluate(f"""async () => {{
            const {{ viewer }} = document.querySelector('snerg-viewer');
            window.every = {every};
            viewer.turn(1, 0);
            const began = performance.now();
            let at = began;
            while (at - began < 90) {{
                const before = JSON.stringify(viewer.state.cameraToWorld);
                while (JSON.stringify(viewer.state.cameraToWorld) === before) await new Promise((done) => setTimeout(done, 1));
                at = performance.now();
            }}
            return [viewer.state.cameraToWorld, (at - began) / 1000];
        }}""")
        angle = np.arccos(np.clip((np.trace(first[:3, :3].T @ np.array(came)[:3, :3]) - 1) / 2, -1, 1))
        whole = np.arccos(np.clip((np.trace(first[:3, :3].T @ pose(page)[:3, :3]) - 1) / 2, -1, 1))
        ways.append(np.log(1 - angle / whole) / seconds)
    assert ways[0] == pytest.approx(ways[1], rel=0.35)


def test_less_motion_moves_at_once(browser: Browser, made: Path, serve: Serve) -> None:
    context = browser.new_context(viewport={"width": 500, "height": 400}, reduced_motion="reduce")
    page = context.new_page()
    show(page, serve(made))
    moved, rested = page.evaluate("""async () => {
        const { viewer } = document.querySelector('snerg-viewer');
        viewer.turn(0.5, 0);
        const seen = [];
        for (let i = 0; i < 8; i++) {
            await new Promise(requestAnimationFrame);
            seen.push(JSON.stringify(viewer.state.cameraToWorld));
        }
        return [seen[2], seen[7]];
    }""")
    assert moved == rested
    context.close()


def test_fingers(touched: Page, made: Path, serve: Serve) -> None:
    """One orbits; two pinch, slide and twist, each alone; a double tap sets the pivot."""
    show(touched, serve(made))
    fingers = Fingers(touched)
    first = pose(touched)
    fingers.move([(80, 60)], [(110, 66)])
    assert not np.allclose(pose(touched)[:3, :3], first[:3, :3])

    before, seen = pose(touched), middle(touched)
    fingers.move([(60, 60), (100, 60)], [(40, 60), (120, 60)])
    nearer = pose(touched)
    assert np.allclose(nearer[:3, :3], before[:3, :3], atol=1e-6)
    assert np.linalg.norm(nearer[:3, 3] - seen) < 0.9 * np.linalg.norm(before[:3, 3] - seen)

    fingers.move([(60, 60), (100, 60)], [(80, 50), (120, 50)])
    slid = pose(touched)
    assert np.allclose(slid[:3, :3], nearer[:3, :3], atol=1e-6)
    assert (slid - nearer)[:3, 3] @ nearer[:3, 0] < -0.01 and (slid - nearer)[:3, 3] @ nearer[:3, 1] < 0

    fingers.send("touchStart", (40, 60), (120, 60))
    for degrees in range(0, 65, 5):
        x, y = 40 * np.cos(np.deg2rad(degrees)), 40 * np.sin(np.deg2rad(degrees))
        fingers.send("touchMove", (80 - x, 60 - y), (80 + x, 60 + y))
    fingers.send("touchEnd")
    twisted = pose(touched)
    assert 30 < roll(twisted) - roll(slid) < 61
    assert np.allclose(twisted[:3, 2], slid[:3, 2], atol=1e-6)

    touched.locator("#canvas").press("r")
    first, point = pose(touched), middle(touched, (95, 80))
    for _ in range(2):
        fingers.send("touchStart", (95, 80))
        fingers.send("touchEnd")
    turned = pose(touched)
    toward = (point - turned[:3, 3]) / np.linalg.norm(point - turned[:3, 3])
    assert np.allclose(turned[:3, 3], first[:3, 3], atol=1e-6) and np.allclose(toward, -turned[:3, 2], atol=1e-4)


PEN = """(canvas, [type, id, x, y, button]) => canvas.dispatchEvent(new PointerEvent(type, {
    pointerId: id, pointerType: id === 7 ? 'pen' : 'touch', clientX: x, clientY: y, button, buttons: 1, bubbles: true, composed: true }))"""


@pytest.mark.slow
def test_a_pen_draws_the_camera_and_the_hand_beside_it_does_not(page: Page, made: Path, serve: Serve) -> None:
    """The browser's own input has no pen; its events are made here, without the capture that only a real one has."""
    page.add_init_script("Element.prototype.setPointerCapture = () => {};")
    show(page, serve(made))
    canvas = page.locator("#canvas")
    first = pose(page)
    for event in (("pointerdown", 7, 80, 60, 0), ("pointerdown", 8, 20, 90, 0), ("pointermove", 8, 30, 100, -1)):
        canvas.evaluate(PEN, list(event))
    assert np.allclose(pose(page), first)
    canvas.evaluate(PEN, ["pointermove", 7, 110, 60, -1])
    canvas.evaluate(PEN, ["pointerup", 7, 110, 60, 0])
    orbited = pose(page)
    assert not np.allclose(orbited[:3, :3], first[:3, :3])
    for event in (("pointerdown", 7, 80, 60, 2), ("pointermove", 7, 110, 60, -1), ("pointerup", 7, 110, 60, 2)):  # its button
        canvas.evaluate(PEN, list(event))
    assert np.allclose(pose(page)[:3, :3], orbited[:3, :3]) and not np.allclose(pose(page), orbited)


@pytest.mark.slow
def test_flying_and_walking(page: Page, made: Path, serve: Serve) -> None:
    """Keys move as long as they are held, along what the camera sees; who walks stays on the level."""
    show(page, serve(made), scale=2)
    canvas = page.locator("#canvas")
    first = pose(page)
    canvas.press("v")
    assert viewer(page, "mode") == "fly" and np.allclose(pose(page), first)
    assert page.get_by_role("combobox", name="How to move").input_value() == "fly"
    directions = {"w": -first[:3, 2], "s": first[:3, 2], "d": first[:3, 0], "a": -first[:3, 0], "e": first[:3, 1], "q": -first[:3, 1]}
    for key, direction in directions.items():
        before = pose(page)
        canvas.press(key, delay=120)
        way = (pose(page) - before)[:3, 3]
        assert way @ direction == pytest.approx(np.linalg.norm(way), rel=1e-6) and way @ direction > 0.02, key
    before = pose(page)
    drag(page, (220, 60), begin=(160, 60))
    looked = pose(page)
    assert np.allclose(looked[:3, 3], before[:3, 3]) and looked[:3, 2] @ before[:3, 0] < -0.05  # to the right
    canvas.press("ArrowLeft")
    assert np.allclose(pose(page)[:3, 3], before[:3, 3])

    page.get_by_role("combobox", name="How to move").select_option("walk")
    before = pose(page)
    assert abs(before[2, 2]) > 0.1  # it looks down
    canvas.press("w", delay=120)
    way = (pose(page) - before)[:3, 3]
    assert abs(way[2]) < 1e-9 and np.linalg.norm(way) > 0.02
    canvas.press("v")
    assert viewer(page, "mode") == "orbit"
    canvas.press("w")
    assert np.allclose(pose(page)[:3, 3], (before[:3, 3] + way))


@pytest.mark.slow
def test_the_speed_of_a_flight(page: Page, made: Path, serve: Serve) -> None:
    """The wheel and the keys for zooming change it, and Shift hurries."""
    show(page, serve(made), scale=2)
    canvas = page.locator("#canvas")
    canvas.press("v")

    def speed(key: str) -> float:
        began = pose(page)
        spent = page.evaluate("performance.now()")
        canvas.press(key, delay=200)
        spent = page.evaluate("performance.now()") - spent
        return float(np.linalg.norm((pose(page) - began)[:3, 3]) / spent)

    usual = speed("d")
    assert speed("Shift+A") > 2 * usual
    page.mouse.move(160, 60)
    for _ in range(5):
        page.mouse.wheel(0, 100)
    page.get_by_text("Speed: 0.37").first.wait_for(state="attached")
    assert speed("d") < 0.7 * usual
    for _ in range(5):
        canvas.press("+")
    assert page.locator("#spoken").inner_text() == "Speed: 1.0"


@pytest.mark.slow
def test_a_stick_flies_for_fingers(touched: Page, made: Path, serve: Serve) -> None:
    show(touched, serve(made), scale=2)
    touched.get_by_role("button", name="Menu").click()
    touched.get_by_role("combobox", name="How to move").select_option("fly")
    fingers = Fingers(touched)
    box = touched.locator("#stick").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = pose(touched)
    fingers.send("touchStart", (x, y))
    fingers.send("touchMove", (x, y - 40))
    touched.wait_for_timeout(200)
    fingers.send("touchEnd")
    flown = pose(touched)
    assert (flown - before)[:3, 3] @ -before[:3, 2] > 0.02 and np.allclose(flown[:3, :3], before[:3, :3])
    fingers.move([(60, 40)], [(90, 40)])
    looked = pose(touched)
    assert np.allclose(looked[:3, 3], flown[:3, 3]) and looked[:3, 2] @ flown[:3, 0] > 0.05  # a finger takes the picture along
    fingers.move([(60, 40), (90, 40)], [(40, 40), (110, 40)])
    assert (pose(touched) - looked)[:3, 3] @ -looked[:3, 2] > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["orbit", "fly", "walk"])
def test_limits_hold_in_every_mode(page: Page, tmp_path: Path, serve: Serve, mode: str) -> None:
    """How far the camera stands from what it looked at, and how high above it."""
    settings = PageSettings(distance=(1.5, 3), elevation=(10, 40), mode=mode)
    write_bundle(make_snerg(shape=(20, 20, 20)), make_cameras()[:1], tmp_path / "web", page=settings)
    show(page, serve(tmp_path / "web"))
    assert viewer(page, "mode") == mode
    first = pose(page)
    pivot = first[:3, 3] - (first[:3, 3] @ first[:3, 2]) * first[:3, 2]  # the point of the axis nearest to the centre, the origin
    for key in ("ArrowUp", "ArrowDown", "e", "q", "w", "s"):
        for _ in range(12):
            page.locator("#canvas").press(f"Shift+{key.upper()}" if len(key) == 1 else key, delay=40 if len(key) == 1 else 0)
        away = pose(page)[:3, 3] - pivot
        assert 1.49 < np.linalg.norm(away) < 3.01
        assert 9.9 < np.rad2deg(np.arcsin(away[2] / np.linalg.norm(away))) < 40.1


def test_a_hand_ends_a_flight_between_cameras(page: Page, made: Path, serve: Serve) -> None:
    show(page, serve(made))
    page.evaluate("void document.querySelector('snerg-viewer').viewer.goTo('Inside', { duration: 30 })")
    time.sleep(0.2)
    page.mouse.move(*MIDDLE)
    drag(page, (90, 60))
    first = pose(page)
    page.wait_for_timeout(200)
    assert np.array_equal(pose(page), first)


def test_full_screen_has_the_bar(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made)) is None
    page.locator("#canvas").press("f")
    page.get_by_role("button", name="Leave full screen").click()
    page.get_by_role("button", name="Full screen", exact=True).wait_for()
    assert page.evaluate("document.fullscreenElement === null")
