"""Camera paths in the page: the same poses as in Python, the same pictures as the march, and the controls that play them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page
from scipy.spatial.transform import Rotation

from scenes import make_snerg
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.render import render_views
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.camera_path import CameraPath, Shot, path_bytes
from snerg.core.io.images import read_image
from snerg.core.rendering.render import render_scene
from snerg.tests.web.conftest import opened, picture
from snerg.tests.web.test_modules import node

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


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), FAR], ids=["at the origin", "far from it"])
def test_the_page_has_the_poses_of_python(at: tuple[float, float, float]) -> None:
    data = json.loads(path_bytes(make_path(at)))
    path, frames = CameraPath.from_json(data), [float(frame) for frame in np.linspace(-1, 52, 107)]
    cameras = node(f"""
        import {{ CameraPath }} from "./viewer/path";
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
