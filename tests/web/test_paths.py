"""Camera paths in the page: the same poses as in Python, the same pictures as the march, and the controls that play them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from scipy.spatial.transform import Rotation

from scenes import make_cameras, make_snerg
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.render import render_views
from snerg.core.errors import SnergError
from snerg.core.export.bundle import write_bundle
from snerg.core.export.page_settings import PageSettings
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.camera_path import CameraPath, Shot, path_bytes
from snerg.core.io.images import read_image
from snerg.core.rendering.render import render_scene
from snerg.tests.web.conftest import ROOT, opened, picture
from snerg.tests.web.test_access import AXE
from snerg.tests.web.test_modules import node

pytestmark = pytest.mark.slow

Serve = Callable[[Path], str]
FAR = (1e6, -2e6, 5e5)
SHAPE = (34, 30, 40)
VIEWER = "document.querySelector('snerg-viewer').viewer"


def posed(angles: tuple[float, float, float], distance: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A camera that looks at a point from a distance, turned by Euler angles in degrees."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zxz", angles, degrees=True).as_matrix()
    pose[:3, 3] = distance * pose[:3, 2] + at
    return pose


def make_path(at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> CameraPath:
    """Over the pole and on, rolling, with a zoom and a shift; then, after a cut, an orthographic camera."""
    lens = {"width": 160, "height": 120, "near": 0.01}
    one = Camera(focal=(150, 150), centre=(80, 60), camera_to_world=posed((10, 60, 0), 3.2, at), name="Over", **lens)
    two = replace(one, camera_to_world=posed((70, -40, 120), 2.6, at), focal=(220, 220), centre=(92, 52), far=50.0)
    other = replace(one, camera_to_world=posed((200, 75, 15), 3.0, at), projection="orthographic", focal=(60, 60), name="Flat")
    last = replace(other, camera_to_world=posed((170, 95, 15), 3.4, at), focal=(85, 85))
    return CameraPath((Shot((1.0, 25.0), (one, two), (3.2, 2.6)), Shot((25.0, 49.0), (other, last))), 1, 48, 24.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene and a path as files, and the page of both."""
    folder = tmp_path_factory.mktemp("path")
    write_scene(make_snerg(SHAPE), folder / "scene")
    (folder / "path.json").write_bytes(path_bytes(make_path()))
    bundle_scene(folder / "scene", folder / "web", path=folder / "path.json")
    return folder


def on_curves(path: CameraPath) -> CameraPath:
    """The path with a curve from each key to the next, whose velocities are of all kinds, and once between opposite quaternions."""
    random = np.random.default_rng(8)
    curves = [(random.uniform(-0.04, 0.04, (2, 11)) * [1, 1, 1, 2, 2, 2, 0.5, 0.5, 20, 20, 1],) for _ in path.shots]
    first, last = (replace(shot, curves=curve) for shot, curve in zip(path.shots, curves, strict=True))
    turned = [posed((angle, 0, 0), 3.0, tuple(c.position)) for angle, c in zip((170, 190), last.cameras, strict=True)]
    cameras = tuple(replace(c, camera_to_world=pose) for c, pose in zip(last.cameras, turned, strict=True))
    return replace(path, shots=(first, replace(last, cameras=cameras)))


@pytest.mark.parametrize("curves", [False, True], ids=["lines", "curves"])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), FAR], ids=["at the origin", "far from it"])
def test_the_page_has_the_poses_of_python(at: tuple[float, float, float], curves: bool) -> None:
    data = json.loads(path_bytes(on_curves(make_path(at)) if curves else make_path(at)))
    assert data["version"] == 1 + curves
    path, frames = CameraPath.from_json(data), [float(frame) for frame in np.linspace(-1, 52, 107)]
    cameras = node(f"""
        import {{ CameraPath }} from "./optional/path/path";
        const path = new CameraPath({json.dumps(data)});
        console.log(JSON.stringify({json.dumps(frames)}.map((frame) => path.at(frame))));
    """)
    for frame, found in zip(frames, cameras, strict=True):
        camera = path.camera_at(frame)
        assert (found["name"], found["projection"]) == (camera.name, camera.projection)
        assert np.allclose(Rotation.from_quat(found["rotation"]).as_matrix(), camera.camera_to_world[:3, :3], rtol=0, atol=1e-6)
        assert np.allclose(found["position"], camera.position, rtol=0, atol=1e-6)
        assert np.allclose(found["focal"], camera.focal, rtol=1e-9) and np.allclose(found["centre"], camera.centre, rtol=1e-9)
        assert found["near"] == pytest.approx(camera.near) and found.get("far", np.inf) == pytest.approx(camera.far)


def test_flights_turn_the_shorter_way_and_keep_their_distance() -> None:
    """Between opposite sides, over a pole, and between rolled cameras; far from the origin, too."""
    poses = [posed(angles, 3.0, FAR) for angles in ((0, 80, 0), (180, 80, 0), (0, 5, 30), (20, -60, 170))]
    script = """
        import { Matrix4 } from "three";
        import { between, eased } from "./viewer/flight";
        const camera = (pose) => ({ projection: "perspective", width: 100, height: 80, focal: [100, 100], centre: [50, 40], near: 0,
          cameraToWorld: new Matrix4().set(...pose.flat()) });
        const parts = Array.from({ length: 11 }, (_, i) => i / 10);
        const found = POSES.map((from, i) => POSES.slice(i + 1).map((to) => parts.map(
          (part) => Array.from(between(camera(from), { ...camera(to), focal: [400, 400] }, part, [3, 3]).cameraToWorld.elements))));
        console.log(JSON.stringify({ found, eased: parts.map(eased),
          focal: parts.map((part) => between(camera(POSES[0]), { ...camera(POSES[1]), focal: [400, 400] }, part, [3, 3]).focal[0]) }));
    """.replace("POSES", json.dumps([pose.tolist() for pose in poses]))
    said = node(script)
    assert np.allclose(said["focal"], 100 * 4 ** np.linspace(0, 1, 11))
    assert said["eased"][0] == 0 and said["eased"][-1] == 1 and (np.diff(said["eased"]) > 0).all() and said["eased"][1] < 0.02
    for i, flights in enumerate(said["found"]):
        for j, flight in enumerate(flights, i + 1):
            way = np.array(flight).reshape(-1, 4, 4).transpose(0, 2, 1)
            assert np.allclose(way[0], poses[i], rtol=0, atol=1e-6) and np.allclose(way[-1], poses[j], rtol=0, atol=1e-6)
            assert np.allclose(np.linalg.norm(way[:, :3, 3] - FAR, axis=1), 3.0, rtol=0, atol=1e-6), "round the middle, not through it"
            turns = Rotation.from_matrix(way[:, :3, :3])
            whole = (turns[0].inv() * turns[-1]).magnitude()
            assert np.allclose((turns[:-1].inv() * turns[1:]).magnitude(), whole / 10, atol=1e-6), "evenly, the shorter way"


@pytest.mark.parametrize("frame", [1, 13.5, 24, 25, 40])
def test_a_frame_of_the_path_is_the_march(page: Page, made: Path, serve: Serve, frame: float) -> None:
    assert opened(page, f"{serve(made / 'web')}?width=160&height=120#frame={frame}") is None
    shown, truth = picture(page), render_scene(make_snerg(SHAPE), make_path().camera_at(frame)).over()
    assert np.abs(shown - truth).mean() < 0.5 / 255 and np.mean(np.abs(shown - truth).max(axis=-1) < 2 / 255) > 0.999
    assert truth.std() > 0.03


def test_a_frame_far_from_the_origin_is_the_march(page: Page, serve: Serve, tmp_path: Path) -> None:
    scene, path = make_snerg(SHAPE, centre=FAR), make_path(FAR)
    write_bundle(scene, (), tmp_path / "web", path=path)
    assert opened(page, f"{serve(tmp_path / 'web')}?width=160&height=120#frame=13") is None
    shown, truth = picture(page), render_scene(scene, CameraPath.from_json(json.loads(path_bytes(path))).camera_at(13)).over()
    assert np.abs(shown - truth).mean() < 0.5 / 255 and truth.std() > 0.03


def test_rendering_the_frames_of_a_path(page: Page, made: Path, serve: Serve, tmp_path: Path) -> None:
    """The files are the page's pictures of whole frames."""
    short = tmp_path / "short.json"
    short.write_bytes(path_bytes(replace(make_path(), start=23, end=26)))
    result = render_views(made / "scene", None, tmp_path / "frames", width=80, path=short)
    assert result["files"] == [f"frame_00{frame}.png" for frame in (23, 24, 25, 26)]
    assert opened(page, f"{serve(made / 'web')}?width=80&height=60") is None
    for frame in (24, 25):
        image = np.asarray(read_image(tmp_path / "frames" / f"frame_00{frame}.png")) / 255
        page.evaluate(f"{VIEWER}.path.seek({frame})")
        over = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
        assert np.abs(picture(page) - over).mean() < 0.7 / 255
    with pytest.raises(SnergError, match="one of both"):
        render_views(made / "scene", short, tmp_path / "none", path=short)


def state(page: Page) -> dict[str, float]:
    return dict(page.evaluate(f"{VIEWER}.state.path"))


def wait_for(page: Page, condition: str) -> None:
    """Until a condition of the path's state `p` holds."""
    holds = f"(() => {{ const p = {VIEWER}.state.path; return {condition}; }})"
    page.evaluate(f"new Promise((done) => {{ const ask = () => ({holds}() ? done() : setTimeout(ask, 10)); ask(); }})")


def test_the_path_is_played_by_mouse_and_keys(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made / "web") + "?width=40&height=30") is None
    assert not state(page)["playing"], "it waits for a person"
    page.get_by_role("button", name="Play").click()
    wait_for(page, "p.playing && p.frame > 3")
    page.get_by_role("button", name="Pause").click()
    stopped = state(page)
    assert not stopped["playing"] and stopped["shown"]
    page.wait_for_timeout(200)
    assert state(page)["frame"] == stopped["frame"]
    canvas, time = page.locator("#canvas"), page.get_by_role("slider", name="Time")
    canvas.press(" ")
    wait_for(page, "p.playing")
    canvas.press(" ")
    time.focus()
    time.evaluate("slider => { slider.value = 13.5; slider.dispatchEvent(new Event('input')); }")
    assert state(page)["frame"] == 13.5
    for key, frame in (("ArrowRight", 14), ("ArrowRight", 15), ("ArrowLeft", 14), ("PageUp", 38), ("PageUp", 48), ("PageDown", 24)):
        time.press(key)
        assert state(page)["frame"] == frame
    canvas.press(",")
    canvas.press(",")
    canvas.press(".")
    assert state(page)["frame"] == 23 and time.get_attribute("aria-valuetext") == "0.9 of 2.0 seconds"
    page.wait_for_url("**#*frame=23*")  # the address follows


def test_a_path_ends_begins_again_and_is_left(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made / "web") + "?width=40&height=30#frame=23") is None
    canvas = page.locator("#canvas")
    page.get_by_role("combobox", name="Speed").select_option("4")
    assert state(page)["speed"] == 4
    canvas.press("l")
    assert page.get_by_role("button", name="Loop").get_attribute("aria-pressed") == "false"
    page.get_by_role("button", name="Play").click()
    wait_for(page, "!p.playing && p.frame === 48")
    page.get_by_role("button", name="Loop").click()
    page.get_by_role("button", name="Play").click()
    wait_for(page, "p.playing && p.frame < 40")  # it began again
    page.mouse.move(20, 15)
    page.mouse.down()
    page.mouse.move(30, 15, steps=3)
    page.mouse.up()
    left = state(page)
    assert not left["playing"] and not left["shown"], "a person who moves the view stops the path"
    page.wait_for_url("**#*view=*")
    assert "frame" not in parse_qs(urlsplit(page.url).fragment)
    page.get_by_role("button", name="Play").click()
    assert state(page)["frame"] >= left["frame"] or state(page)["frame"] < 20


def test_the_interface_plays_pauses_and_tells(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made / "web") + "?width=40&height=30") is None
    page.evaluate(f"window.told = []; {VIEWER}.on('path', (state) => window.told.push(state)); {VIEWER}.play()")
    wait_for(page, "p.frame > 2")
    page.evaluate(f"{VIEWER}.pause()")
    told = page.evaluate("window.told")
    assert told[0]["playing"] and not told[-1]["playing"]
    assert all(later["frame"] >= earlier["frame"] for earlier, later in pairwise(told))
    page.evaluate(f"{VIEWER}.path.seek(1e9)")
    assert state(page)["frame"] == 48 and page.evaluate(f"{VIEWER}.state.camera") == "Flat"


def test_a_path_that_plays_at_once_does_not_under_reduced_motion(browser: Browser, tmp_path: Path, serve: Serve) -> None:
    write_bundle(make_snerg((20, 20, 20)), make_cameras(), tmp_path / "web", page=PageSettings(play=True), path=make_path())
    address = serve(tmp_path / "web") + "?width=40&height=30"
    for motion, plays in (("no-preference", True), ("reduce", False)):
        context = browser.new_context(viewport={"width": 300, "height": 300}, reduced_motion=motion)
        page = context.new_page()
        assert opened(page, address) is None
        page.wait_for_timeout(100)
        assert state(page)["playing"] == plays
        page.get_by_role("combobox", name="Camera").select_option("Shifted, rolled")
        assert page.evaluate(f"{VIEWER}.state.atCamera") == (not plays), "without motion, a flight is a cut"
        picture(page)
        assert page.evaluate(f"{VIEWER}.state.atCamera") and not state(page)["playing"]
        if not plays:
            page.get_by_role("button", name="Play").click()  # who asks for it gets it
            wait_for(page, "p.playing && p.frame > 2")
        context.close()


def test_a_flight_ends_at_the_camera_and_a_person_may_end_it(page: Page, made: Path, serve: Serve, tmp_path: Path) -> None:
    scene, cameras = make_snerg(SHAPE), make_cameras()
    write_bundle(scene, cameras, tmp_path / "web")
    assert opened(page, serve(tmp_path / "web") + "?width=160&height=120") is None
    assert page.evaluate(f"{VIEWER}.state.path") is None and page.locator("#path").count() == 0
    page.evaluate(f"window.done = {VIEWER}.goTo(1, {{ duration: 0.4 }}).then(() => performance.now()); window.began = performance.now()")
    page.wait_for_timeout(100)
    assert not page.evaluate(f"{VIEWER}.state.atCamera")
    shown = picture(page)
    assert page.evaluate("window.done.then((done) => done - window.began)") >= 400
    assert np.abs(shown - render_scene(scene, cameras[1]).over()).mean() < 0.5 / 255
    page.evaluate(f"void {VIEWER}.goTo(0, {{ duration: 5 }})")
    page.wait_for_timeout(100)
    page.locator("#canvas").press("ArrowLeft")
    page.evaluate("window.snerg.settled()")
    assert not page.evaluate(f"{VIEWER}.state.atCamera")
    pose = page.evaluate(f"{VIEWER}.state.cameraToWorld")
    page.wait_for_timeout(100)
    assert pose == page.evaluate(f"{VIEWER}.state.cameraToWorld"), "it stays where the person put it"


def test_only_a_page_with_a_path_holds_its_code(page: Page, made: Path, tmp_path: Path) -> None:
    """Beside the page, and inside it under a policy that allows each script by its hash."""
    scene = make_snerg((20, 20, 20))
    write_bundle(scene, make_cameras(), tmp_path / "without")
    write_bundle(scene, make_cameras(), tmp_path / "alone", single_file=True)
    assert not {"path.js", "path.json"} & {path.name for path in (tmp_path / "without").rglob("*")}
    for text in ((tmp_path / "without" / name).read_text() for name in ("index.html", "viewer.js", "cameras.json")):
        assert 'aria-label="Time"' not in text
    assert 'aria-label="Time"' in (made / "web" / "optional" / "path.js").read_text()
    write_bundle(scene, make_cameras(), tmp_path / "one", single_file=True, path=make_path())
    assert [path.name for path in (tmp_path / "one").iterdir() if path.name != ".snerg"] == ["index.html"]
    more = (tmp_path / "one" / "index.html").stat().st_size - (tmp_path / "alone" / "index.html").stat().st_size
    assert 5_000 < more < 20_000
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    assert opened(page, (tmp_path / "one" / "index.html").as_uri() + "?width=160&height=120#frame=13.5") is None
    truth = render_scene(scene, make_path().camera_at(13.5)).over()
    assert np.abs(picture(page) - truth).mean() < 0.5 / 255 and said == []


def test_a_page_of_a_path_alone_opens_at_its_first_frame(page: Page, made: Path, serve: Serve) -> None:
    assert opened(page, serve(made / "web") + "?width=160&height=120") is None
    assert np.abs(picture(page) - render_scene(make_snerg(SHAPE), make_path().camera_at(1)).over()).mean() < 0.5 / 255
    assert (made / "web" / "poster.webp").is_file()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("optional/path.js", None, "The file optional/path.js did not arrive. Upload the whole folder of the page."),
        ("path.json", None, "The file path.json is missing from the server. Upload the whole folder of the page."),
        ("path.json", "{}", "The file path.json is damaged: it is not a camera path. Export the page again."),
        (
            "path.json",
            '{"format": "snerg-path", "version": 3}',
            "The file path.json is damaged: it is not a camera path. Export the page again.",
        ),
    ],
)
def test_what_is_missing_or_damaged_is_named(
    page: Page, made: Path, serve: Serve, tmp_path: Path, name: str, text: str | None, words: str
) -> None:
    shutil.copytree(made / "web", tmp_path / "web")
    if text is None:
        (tmp_path / "web" / name).unlink()
    else:
        (tmp_path / "web" / name).write_text(text)
    assert opened(page, serve(tmp_path / "web")) is None, "the scene is shown"
    assert page.locator("#missing-list p").all_inner_texts() == [words]
    assert page.locator("#path").count() == 0


def test_damaged_keys_are_not_a_path() -> None:
    """Every change that Python refuses, the page refuses too."""
    data = json.loads(path_bytes(make_path()))
    changes = [
        ("frame", 1),
        ("rotation", [0, 0, 0, 0]),
        ("position", [0, None, 0]),
        ("focal", [-1, 1]),
        ("far", 0),
        ("near", -1),
        ("distance", -1),
        ("curve", [[0] * 11] * 2),  # of the last key
    ]
    damaged = []
    for key, value in changes:
        other = json.loads(json.dumps(data))
        other["shots"][0]["keys"][1][key] = value
        damaged.append(other)
        with pytest.raises(SnergError):
            CameraPath.from_json(other)
    for curve in ([[0] * 10] * 2, [[0] * 11], [[0] * 10 + [None]] * 2, 7):
        other = json.loads(json.dumps(data))
        other["shots"][0]["keys"][0]["curve"] = curve
        damaged.append(other)
        with pytest.raises(SnergError):
            CameraPath.from_json(other)
    for key, value in (("version", 3), ("shots", []), ("fps", 0), ("end", 0), ("width", 0.5)):
        damaged.append(data | {key: value})
        with pytest.raises(SnergError):
            CameraPath.from_json(damaged[-1])
    refused = node(f"""
        import {{ pathOf }} from "./optional/path/path";
        console.log(JSON.stringify({json.dumps([data, *damaged])}.map((value) => pathOf(value) === null)));
    """)
    assert refused == [False, *[True] * len(damaged)]


def test_axe_finds_nothing_on_a_phone(browser: Browser, tmp_path: Path, serve: Serve) -> None:
    """The rules of axe-core on a page with a path and thumbnails, while it plays and with the cameras open; targets of 44 pixels."""
    write_bundle(make_snerg((20, 20, 20)), make_cameras(), tmp_path / "web", page=PageSettings(thumbnails=3), path=make_path())
    context = browser.new_context(viewport={"width": 390, "height": 700}, bypass_csp=True)
    page = context.new_page()
    assert opened(page, serve(tmp_path / "web")) is None
    page.add_script_tag(path=ROOT / "node_modules" / "axe-core" / "axe.min.js")
    page.get_by_role("button", name="Play").click()
    assert page.evaluate(AXE) == []
    page.get_by_role("button", name="Pause").click()
    for control in page.locator("#path button, #path input, #path select, #gallery-open").all():
        box = control.bounding_box()
        assert box and box["height"] >= 44 and box["width"] >= 44 and box["x"] >= 0 and box["x"] + box["width"] <= 390
    page.get_by_role("button", name="Camera: ").click()
    assert page.evaluate(AXE) == []
    context.close()
