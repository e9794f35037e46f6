"""The scene in an emulated headset: the picture of each eye against a march, and how hands and sticks move."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from scenes import make_cameras, make_forward, make_forward_cameras, make_frame, make_snerg, rotation
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.export.world_units import WorldUnits
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import ROOT, opened, picture_of

pytestmark = pytest.mark.slow

Serve = Callable[[Path], str]
WIDTH, HEIGHT = 200, 112  # of both eyes
EYES = 0.064  # metres between them
HEAD = (0.05, 1.62, 0.03)
UPRIGHT = rotation((-np.pi / 2, 0, 0))  # Blender's Z up to the headset's Y up
EMULATE = f"""
    window.device = new IWER.XRDevice(IWER.metaQuest3, {{ stereoEnabled: true, ipd: {EYES}, fovy: 1.2 }});
    window.device.installRuntime({{ forceInstall: true }});
    window.device.position.set({", ".join(map(str, HEAD))});
    for (const hand of ["left", "right"]) window.device.controllers[hand].position.set(0.2, 1.2, 1); // behind the head
"""


def enter(page: Page, folder: Path, serve: Serve, scene: Scene, cameras: tuple[Camera, ...], metres: float, single: bool = False) -> None:
    write_bundle(scene, cameras, folder / "web", page=PageSettings(vr=True, units=WorldUnits(metres)), single_file=single)
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.add_init_script(path=ROOT / "node_modules" / "iwer" / "build" / "iwer.min.js")
    page.add_init_script(EMULATE)
    address = (folder / "web" / "index.html").as_uri() if single else serve(folder / "web")
    assert opened(page, address) is None
    page.get_by_role("button", name="Enter VR", include_hidden=True).evaluate("e => e.click()")
    frames(page, 3)


def frames(page: Page, count: int) -> None:
    page.evaluate(
        "count => new Promise(go => { const next = () => count-- ? device.activeSession.requestAnimationFrame(next) : go(); next(); })",
        count,
    )


def placed(scene: Scene, camera: Camera, metres: float) -> np.ndarray:
    """[4, 4]: where the scene stands by the documented rule."""
    forward = UPRIGHT @ -camera.camera_to_world[:3, 2]
    heading = np.arctan2(forward[0], -forward[2])
    result = np.eye(4)
    result[:3, :3] = metres * rotation((0, heading, 0)) @ UPRIGHT
    corners = scene.box.corners() @ result[:3, :3].T
    radius = metres * scene.voxel_size * np.linalg.norm(scene.shape) / 2
    if scene.ndc is None and radius < 1:
        result[:3, 3] = np.array([0, 1.2, -0.6 - 2 * radius]) - corners.mean(axis=0)
        return result
    eye = result[:3, :3] @ camera.camera_to_world[:3, 3]
    result[:3, 3] = -eye[0], -corners[:, 1].min() if scene.ndc is None else 1.6 - eye[1], -eye[2]
    return result


def eye_camera(room: np.ndarray, side: int, head: tuple[float, float, float] = HEAD) -> Camera:
    """The camera of an eye (-1: left, 1: right) in Blender's world."""
    scale = np.cbrt(np.linalg.det(room[:3, :3]))
    pose = np.eye(4)
    pose[:3, :3] = room[:3, :3].T / scale
    pose[:3, 3] = (np.linalg.inv(room) @ [head[0] + side * EYES / 2, head[1], head[2], 1])[:3]
    focal = HEIGHT / 2 / np.tan(1.2 / 2)
    return Camera(WIDTH // 2, HEIGHT, (focal, focal), (WIDTH / 4, HEIGHT / 2), pose, near=0.05 / scale)


def both_eyes(scene: Scene, room: np.ndarray) -> np.ndarray:
    return np.concatenate([render_scene(scene, eye_camera(room, side)).over() for side in (-1, 1)], axis=1)


def compare(shown: np.ndarray, expected: np.ndarray) -> None:
    difference = np.abs(shown - expected)
    assert difference.mean() < 0.5 / 255 and np.mean(difference.max(axis=-1) < 3 / 255) > 0.997
    assert np.mean(expected < 0.9) > 0.02, "the scene is in the picture"
    assert np.abs(expected[:, : WIDTH // 2] - expected[:, WIDTH // 2 :]).mean() > 1 / 255, "each eye sees its own picture"


def cases() -> dict[str, tuple[Scene, tuple[Camera, ...], float]]:
    box = make_snerg((34, 30, 40), angles=(0.1, 0.2, 0.3))
    return {
        "an object": (box, make_cameras(), 0.2),
        "a room": (box, make_cameras()[1:], 2.0),
        "forward-facing": (make_forward(), make_forward_cameras(make_frame()), 1.0),
    }


@pytest.mark.parametrize("name", cases())
def test_each_eye_sees_what_a_march_renders(page: Page, tmp_path: Path, serve: Serve, name: str) -> None:
    scene, cameras, metres = cases()[name]
    enter(page, tmp_path, serve, scene, cameras, metres)
    compare(picture_of(page), both_eyes(scene, placed(scene, cameras[0], metres)))


def stick(page: Page, hand: str, x: float, y: float) -> None:
    page.evaluate(f"device.controllers.{hand}.updateAxes('thumbstick', {x}, {y})")


def test_moving_turning_holding_and_leaving(page: Page, tmp_path: Path, serve: Serve) -> None:
    scene, cameras, metres = cases()["an object"]
    enter(page, tmp_path, serve, scene, cameras, metres, single=True)
    room = placed(scene, cameras[0], metres)
    stick(page, "right", 1, 0)
    frames(page, 3)
    stick(page, "right", 0, 0)
    frames(page, 2)
    turn, head = np.eye(4), np.eye(4)
    turn[:3, :3], head[:3, 3] = rotation((0, np.pi / 6, 0)), HEAD
    turned = head @ turn @ np.linalg.inv(head) @ room
    compare(picture_of(page), both_eyes(scene, turned))
    page.evaluate("device.controllers.right.updateButtonValue('trigger', 1)")
    frames(page, 2)
    page.evaluate("device.controllers.right.position.set(0.6, 1.3, 1.1)")
    frames(page, 2)
    page.evaluate("device.controllers.right.updateButtonValue('trigger', 0)")
    frames(page, 2)
    held = turned.copy()
    held[:3, 3] += (0.4, 0.1, 0.1)
    shown = picture_of(page)
    compare(shown, both_eyes(scene, held))
    stick(page, "left", 0, -0.5)
    frames(page, 3)
    stick(page, "left", 0, 0)
    frames(page, 2)
    assert np.mean(picture_of(page) < 0.9) > 1.03 * np.mean(shown < 0.9), "a step forward: the scene is larger"
    page.evaluate("device.controllers.right.updateButtonValue('b-button', 1)")
    expect(page.get_by_role("button", name="Enter VR", include_hidden=True)).to_have_count(1)
    page.set_viewport_size({"width": 500, "height": 400})
    page.evaluate("window.snerg.settled()")
    assert page.evaluate("window.snerg.problem") is None
    state: Any = page.evaluate("document.querySelector('snerg-viewer').viewer.state")
    assert state["atCamera"] and np.mean(picture_of(page) < 0.9) > 0.02, "the page shows the scene again"


def test_without_a_headset_there_is_no_button(page: Page, tmp_path: Path, serve: Serve) -> None:
    write_bundle(make_snerg((20, 20, 20)), make_cameras()[:1], tmp_path / "web", page=PageSettings(vr=True))
    assert opened(page, serve(tmp_path / "web")) is None
    page.wait_for_timeout(300)
    assert page.get_by_role("button", name="Share").count() == 1 and page.get_by_role("button", name="VR").count() == 0


def test_a_headset_that_does_not_open_says_so(page: Page, tmp_path: Path, serve: Serve) -> None:
    page.add_init_script("""
        Object.defineProperty(navigator, "xr", { value: {
            isSessionSupported: async () => true,
            requestSession: async () => { throw new Error("no headset answers"); },
        } });
    """)
    write_bundle(make_snerg((20, 20, 20)), make_cameras()[:1], tmp_path / "web", page=PageSettings(vr=True))
    assert opened(page, serve(tmp_path / "web")) is None
    page.get_by_role("button", name="Enter VR").click()
    expect(page.locator(".vr-said")).to_have_text("The headset did not open (no headset answers). Check that it is connected and awake.")
