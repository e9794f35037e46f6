"""Measuring in the page: lengths of a scene that is known, by mouse and by keys, in the scene's units."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from oracle import halfway_depth
from scenes import looking, make_forward, make_forward_cameras, make_frame, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.export.world_units import WorldUnits
from snerg.core.geometry.camera import Camera
from snerg.tests.web.conftest import ROOT, opened
from snerg.tests.web.test_access import AXE
from snerg.tests.web.test_modules import node

Serve = Callable[[Path], str]
VOXEL = 0.02
CAMERA = Camera(400, 300, (500.0, 500.0), (200.0, 150.0), looking((0.3, -3.0, 1.2), (0.4, 0.3, 0.2)), name="Front")


def plate():
    """An opaque box, 0.8 x 0.6 x 0.4 units."""
    values = np.zeros((40, 30, 20, 4), np.uint8)
    values[:] = 90, 140, 200, 255
    return snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=VOXEL)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> str:
    folder = tmp_path_factory.mktemp("measure") / "web"
    page = PageSettings(measures=True, units=WorldUnits(0.01, "metric"))
    write_bundle(plate(), [CAMERA], folder, page=page)
    return serve(folder)


def begin(page: Page, address: str) -> tuple[float, float]:
    """Open the page and begin to measure; returns where the canvas lies."""
    assert opened(page, f"{address}?width={CAMERA.width}&height={CAMERA.height}") is None
    if page.get_by_role("button", name="Menu").is_visible():
        page.get_by_role("button", name="Menu").click()
    page.get_by_role("button", name="Measure").click()
    box = page.locator("#canvas").bounding_box()
    assert box
    return box["x"], box["y"]


def place(point: tuple[float, float, float]) -> tuple[int, int]:
    """The pixel of a point of the world."""
    local = (np.array(point) - CAMERA.camera_to_world[:3, 3]) @ CAMERA.camera_to_world[:3, :3]
    x, y = np.array(CAMERA.focal) * local[:2] / -local[2] * [1, -1] + CAMERA.centre
    return round(x), round(y)


def lengths(page: Page) -> list[str]:
    return page.locator(".measure .length").all_inner_texts()


def test_the_length_of_an_edge(page: Page, address: str) -> None:
    """0.7 units along the upper front edge are 7 mm; a drag between two clicks turns the view and sets no point."""
    left, top = begin(page, address)
    status = page.locator(".tool .status")
    for point in ((0.05, 0.02, 0.4), (0.75, 0.02, 0.4)):
        x, y = place(point)
        page.mouse.click(left + x, top + y)
    expect(status).to_contain_text("Choose the first point of another length")
    (text,) = lengths(page)
    value, error = map(float, re.fullmatch(r"([\d.]+) mm ± ([\d.]+) mm", text).groups())  # type: ignore[union-attr]
    assert value == pytest.approx(7.0, abs=0.2) and error == pytest.approx(np.sqrt(2) * 10 * VOXEL, abs=0.01)
    page.mouse.move(left + 300, top + 250)
    page.mouse.down()
    page.mouse.move(left + 320, top + 250, steps=3)
    page.mouse.up()
    expect(status).to_contain_text("Choose the first point of another length")
    assert lengths(page) == [text], "the measure stays while the view turns"


def test_the_points_are_those_of_a_march(page: Page, address: str) -> None:
    left, top = begin(page, address)
    depths = halfway_depth(plate(), CAMERA)
    ends = []
    for pixel in ((150, 150), (230, 190)):
        page.mouse.click(left + pixel[0] + 0.5, top + pixel[1] + 0.5)
        depth = depths[pixel[1], pixel[0]]
        local = np.array([(pixel[0] + 0.5 - 200) / 500, (150 - pixel[1] - 0.5) / 500, -1]) * depth
        ends.append(CAMERA.camera_to_world[:3, :3] @ local + CAMERA.camera_to_world[:3, 3])
    value = float(lengths(page)[0].split()[0])
    assert np.isfinite(ends).all() and value == pytest.approx(10 * np.linalg.norm(ends[0] - ends[1]), abs=0.11)


def test_by_keys_alone(page: Page, address: str) -> None:
    assert opened(page, f"{address}?width={CAMERA.width}&height={CAMERA.height}") is None
    before = page.evaluate("document.querySelector('snerg-viewer').viewer.state.cameraToWorld")
    page.get_by_role("button", name="Measure").focus()
    page.keyboard.press("Enter")
    status = page.locator(".tool .status")
    page.keyboard.press("Enter")
    expect(status).to_have_text("Choose the second point.")
    for key in ("ArrowRight",) * 4 + ("Shift+ArrowDown",) * 3:
        page.keyboard.press(key)
    page.keyboard.press("Enter")
    assert len(lengths(page)) == 1
    for _ in range(40):
        page.keyboard.press("ArrowUp")
    page.keyboard.press("Enter")
    expect(status).to_contain_text("There is nothing here")
    page.keyboard.press("Delete")
    assert lengths(page) == []
    assert page.evaluate("document.querySelector('snerg-viewer').viewer.state.cameraToWorld") == before, "arrows moved the cross alone"
    page.keyboard.press("Escape")
    assert not page.locator(".tool").is_visible()
    page.locator("#canvas").focus()
    page.keyboard.press("ArrowRight")
    page.evaluate("window.snerg.settled()")
    assert page.evaluate("document.querySelector('snerg-viewer').viewer.state.cameraToWorld") != before, "and turn the view again"


def test_several_measures_and_their_removal(browser: Browser, address: str) -> None:
    context = browser.new_context(viewport={"width": 500, "height": 420}, bypass_csp=True)
    page = context.new_page()
    left, top = begin(page, address)
    for pixel in ((160, 150), (240, 150), (165, 180), (225, 183), (160, 165), (160, 190)):
        page.mouse.click(left + pixel[0], top + pixel[1])
    texts = lengths(page)
    assert len(texts) == 3
    boxes = [item.bounding_box() for item in page.locator(".measure li").all()]
    for i, a in enumerate(boxes):
        for b in boxes[i + 1 :]:
            assert a and b and (a["y"] + a["height"] <= b["y"] or b["y"] + b["height"] <= a["y"]), "no label lies over another"
    page.add_script_tag(path=ROOT / "node_modules" / "axe-core" / "axe.min.js")
    assert page.evaluate(AXE) == []
    page.get_by_role("button", name=f"Remove {texts[1]}").click()
    assert lengths(page) == [texts[0], texts[2]]
    page.get_by_role("button", name="Done").click()
    assert lengths(page) == [texts[0], texts[2]], "they stay in the picture"
    page.get_by_role("button", name="Menu").click()
    page.get_by_role("button", name="Measure").click()
    page.get_by_role("button", name="Clear").click()
    assert lengths(page) == []
    context.close()


@pytest.mark.parametrize(
    ("length", "error", "units", "text"),
    [
        (1.23456, 0.012, WorldUnits(), "1.235 m ± 0.012 m"),
        (0.5, 0.004, WorldUnits(), "50.00 cm ± 0.40 cm"),
        (2500, 3, WorldUnits(), "2.5000 km ± 0.0030 km"),
        (3.0, 0.02, WorldUnits(0.001), "3.000 mm ± 0.020 mm"),
        (1.0, 0.01, WorldUnits(1.0, "imperial"), "3.281 ft ± 0.033 ft"),
        (0.1, 0.001, WorldUnits(1.0, "imperial"), "3.937 in ± 0.039 in"),
        (12.5, 0.3, WorldUnits(0.01, "none"), "12.50 ± 0.30 units"),
        (0, 0.01, WorldUnits(), "0 µm ± 10000 µm"),
    ],
)
def test_lengths_as_text(length: float, error: float, units: WorldUnits, text: str) -> None:
    assert text == node(f"""
        import {{ lengthText }} from "./optional/measure/length";
        console.log(JSON.stringify(lengthText({length}, {error}, {json.dumps(units.to_json())})));
    """)


def test_units_that_cannot_be_used() -> None:
    for values in ({"metres": 0.0}, {"metres": float("nan")}, {"system": "cubits"}):
        with pytest.raises(SnergError, match=r"metres|cubits"):
            replace(WorldUnits(), **values)  # type: ignore[arg-type]


def test_a_forward_facing_point_tells_its_own_voxel(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Far away a voxel of device coordinates is longer."""
    scene, camera = make_forward(), make_forward_cameras(make_frame(), 160, 120)[0]
    write_bundle(scene, [camera], tmp_path / "web", page=PageSettings(measures=True))
    assert opened(page, f"{serve(tmp_path / 'web')}?width=160&height=120") is None
    picked = page.evaluate("""() => {
        const places = Array.from({ length: 12 * 9 }, (_, i) => [(i % 12) * 13 + 6, Math.floor(i / 12) * 13 + 6]);
        return document.querySelector('snerg-viewer').viewer.pick(places).filter((point) => point);
    }""")
    depths, voxels = np.array([[point["depth"], point["voxel"]] for point in picked]).T
    assert len(depths) > 20 and depths.max() > 1.5 * depths.min()
    frame = scene.ndc
    assert frame is not None
    expected = scene.voxel_size * np.maximum(depths**2 / (2 * frame.near), depths / min(frame.focal))
    assert voxels == pytest.approx(expected, rel=1e-4)
