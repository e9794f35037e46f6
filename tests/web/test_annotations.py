"""Labels in the page: where they lie, what hides them, and that they are text."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from scenes import make_cameras, make_snerg
from snerg.core.export.annotations import Annotation
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.tests.web.conftest import ROOT, opened
from snerg.tests.web.test_access import AXE
from snerg.tests.web.test_modules import node

pytestmark = pytest.mark.slow

Serve = Callable[[Path], str]
CAMERAS = make_cameras()
WIDTH = 560
HOSTILE = '<img src=x onerror="window.hurt=1"></script><script>window.hurt=1</script>'
NOTES = (
    Annotation("The window, right through the ball", (0.1, -0.66, 0.2), "Shifted, rolled"),
    Annotation("A rod", (0.8, -0.2, 0.9)),
    Annotation("The sheet behind the ball", (0.0, 0.84, 0.0), "Front"),
    Annotation("The floor", (-0.9, -0.9, -1.22)),
    Annotation(HOSTILE, (0.1, -0.62, 0.25)),
)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> str:
    folder = tmp_path_factory.mktemp("notes") / "web"
    write_bundle(make_snerg((37, 33, 48)), CAMERAS, folder, page=PageSettings(annotations=NOTES))
    return serve(folder)


def boxes(page: Page, only: str = "") -> np.ndarray:
    """[N, 4] left, top, right and bottom of labels."""
    found = page.locator(f".notes .label{only}").evaluate_all("all => all.map(e => e.getBoundingClientRect().toJSON())")
    return np.array([[box[side] for side in ("left", "top", "right", "bottom")] for box in found])


def show(page: Page, address: str) -> None:
    page.set_viewport_size({"width": WIDTH, "height": 480})
    assert opened(page, address) is None
    page.wait_for_selector(".notes .label")
    page.evaluate("window.snerg.settled()")
    page.wait_for_selector(".notes .label.away, .notes .label.behind", state="attached")


def test_labels_lie_at_their_points_and_not_over_one_another(page: Page, address: str) -> None:
    show(page, address)
    points = page.locator(".notes .anchor").evaluate_all("all => all.map(e => [+e.getAttribute('cx'), +e.getAttribute('cy')])")
    camera, height = CAMERAS[0], page.locator("#canvas").bounding_box()["height"]  # type: ignore[index]
    scale = min(WIDTH / camera.width, height / camera.height)
    local = (np.array([note.position for note in NOTES]) - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    expected = np.array(camera.focal) * local[:, :2] / -local[:, 2:] * [1, -1] * scale + [WIDTH / 2, height / 2]
    assert np.abs(np.array(points) - expected).max() < 0.1
    shown = boxes(page, ":not(.away)")
    assert len(shown) == len(NOTES)
    for i, a in enumerate(shown):
        assert a[0] >= 0 and a[1] >= 0 and a[2] <= WIDTH and a[3] <= height, "inside of the picture"
        for b in shown[i + 1 :]:
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], "no label lies over another"


def test_what_lies_behind_the_scene_fades(page: Page, address: str) -> None:
    show(page, address)
    faded = page.locator(".notes .label.behind").all_inner_texts()
    assert faded == ["The sheet behind the ball"]
    page.evaluate("document.querySelector('snerg-viewer').viewer.turn(Math.PI, 0)")
    page.evaluate("window.snerg.settled()")
    expect(page.locator(".notes .label", has_text="The sheet")).not_to_have_class("label behind")
    expect(page.locator(".notes .label", has_text="The window")).to_have_class("label behind")


def test_texts_stay_texts(page: Page, address: str) -> None:
    show(page, address)
    assert HOSTILE in page.locator(".notes .label").all_inner_texts()
    assert page.evaluate("window.hurt") is None and page.locator(".notes img, .notes script").count() == 0


def test_keys_and_screen_readers_reach_them(page: Page, address: str) -> None:
    show(page, address)
    names = [note.text for note in NOTES]
    reached = []
    page.locator("#canvas").focus()
    for _ in names:
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.querySelector('snerg-viewer').shadowRoot.activeElement.textContent"))
    assert reached == names
    page.locator(".notes .label").first.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#camera")).to_have_value("1")
    for _ in range(100):
        state = page.evaluate("document.querySelector('snerg-viewer').viewer.state")
        if state["camera"] == "Shifted, rolled" and state["atCamera"]:
            break
        page.wait_for_timeout(100)
    else:
        pytest.fail("it does not fly to the label's camera")
    page.get_by_role("button", name="Menu").click()
    page.get_by_role("button", name="Notes").click()
    assert not page.locator(".notes").is_visible()


def test_axe_finds_nothing(browser: Browser, address: str) -> None:
    context = browser.new_context(bypass_csp=True)
    page = context.new_page()
    show(page, address)
    page.add_script_tag(path=ROOT / "node_modules" / "axe-core" / "axe.min.js")
    assert page.evaluate(AXE) == []
    context.close()


def test_a_label_outside_of_the_picture_shows_when_it_is_focused(page: Page, address: str) -> None:
    show(page, f"{address}?camera=Inside")
    away = page.locator(".notes .label.away").first
    assert float(away.evaluate("e => getComputedStyle(e).opacity")) == 0
    away.focus()
    expect(away).to_have_css("opacity", "1")
    box = away.bounding_box()
    assert box and box["x"] >= 0 and box["x"] + box["width"] <= WIDTH


def test_only_pages_with_annotations_hold_their_code(page: Page, tmp_path: Path, serve: Serve) -> None:
    scene = make_snerg(shape=(20, 20, 20))
    write_bundle(scene, CAMERAS[:1], tmp_path / "plain")
    assert not list((tmp_path / "plain").rglob("*annotations*")) and not list((tmp_path / "plain").rglob("measure.js"))
    assert "parts" not in json.loads((tmp_path / "plain" / "cameras.json").read_text())
    result = write_bundle(scene, CAMERAS[:1], tmp_path / "single", single_file=True, page=PageSettings(annotations=NOTES))
    assert result["files"] == 1
    page.goto((tmp_path / "single" / "index.html").as_uri())
    expect(page.locator(".notes .label", has_text="The floor")).to_have_count(1)
    write_bundle(scene, CAMERAS[:1], tmp_path / "broken", page=PageSettings(annotations=NOTES))
    (tmp_path / "broken" / "annotations.json").write_text('{"annotations": [{"text": 3}]}')
    assert opened(page, serve(tmp_path / "broken")) is None, "the scene is shown"
    expect(page.locator("#missing")).to_contain_text("annotations.json is damaged")


def test_many_labels_take_turns() -> None:
    """What finds no room is marked; the rest lies apart, and stays where it was while the view moves a little."""
    draw = np.random.default_rng(3)
    labels = [{"x": x, "y": y, "width": 90, "height": 30, "place": -1} for x, y in draw.uniform(0, 1, (60, 2)) * [500, 300]]
    first, second = node(f"""
        import {{ placeLabels }} from "./optional/annotations/layout";
        const labels = {json.dumps(labels)};
        const first = placeLabels(labels, 500, 300);
        const moved = labels.map((label, i) => ({{ ...label, x: label.x + 1, place: first[i].place }}));
        console.log(JSON.stringify([first, placeLabels(moved, 500, 300)]));
    """)
    shown = np.array([[place["left"], place["top"]] for place in first if not place["crowded"]])
    assert 4 < len(shown) < 60
    for i, a in enumerate(shown):
        assert (np.abs(shown[i + 1 :] - a) >= [90, 30]).any(axis=1).all()
    assert np.mean([a["place"] == b["place"] for a, b in zip(first, second, strict=True) if not a["crowded"]]) > 0.8
