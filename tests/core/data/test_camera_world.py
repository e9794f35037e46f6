"""Cameras of other tools in the world in which a capture is trained."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import apply, moved, ring, similarity, thing, write_colmap, write_nerfstudio

from scenes import make_snerg
from snerg.core.commands.bundle import bundle_scene
from snerg.core.data import camera_world
from snerg.core.data.camera_world import CaptureWorld
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.data.readers.path_files import read_path
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.camera_path import CameraPath

APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])  # as ns-process-data turns COLMAP's world
SQUARE = [replace(c, focal=(26.0, 26.0), centre=(12, 9)) for c in ring(8)]


def rigid(seed: int) -> np.ndarray:
    """[4, 4] without a scale."""
    matrix = similarity(seed)
    matrix[:3, :3] /= np.cbrt(np.linalg.det(matrix[:3, :3]))
    return matrix


def write_path(file, cameras) -> None:
    """A camera path of nerfstudio's viewer."""
    angle = 2 * np.degrees(np.arctan(cameras[0].height / 2 / cameras[0].focal[1]))
    steps = [{"camera_to_world": c.camera_to_world.ravel().tolist(), "fov": angle, "aspect": 1.3} for c in cameras]
    value = {"render_width": cameras[0].width, "render_height": cameras[0].height, "camera_type": "perspective", "camera_path": steps}
    file.write_text(json.dumps(value))


@pytest.mark.parametrize("kind", ["nerfstudio", "colmap"])
def test_a_camera_path_shows_what_the_photographs_show(tmp_path, kind):
    """The path goes through the capture's own cameras, in nerfstudio's world, which is scale * transform * that of the poses. It stores the
    transform and the scale from before applied_transform and applied_scale."""
    applied, by, transform, scale = np.eye(4), 1.0, rigid(8), 0.37
    poses = moved(SQUARE, similarity(5))
    if kind == "colmap":
        points, colours = thing(30, 0)
        folder = write_colmap(tmp_path / "scan", poses, apply(similarity(5), points), colours, "PINHOLE")
    else:
        applied, by = np.vstack([APPLIED, [0, 0, 0, 1]]), 2.0
        folder = write_nerfstudio(tmp_path / "scan", poses, applied_scale=by, applied_transform=APPLIED.tolist())
    write_path(tmp_path / "path.json", moved(poses, np.diag([scale, scale, scale, 1.0]) @ transform))
    with pytest.raises(SnergError, match=r"dataparser_transforms\.json"):
        CaptureWorld(folder).moved_cameras(read_cameras(tmp_path / "path.json"), tmp_path / "path.json")
    stored = {"transform": (transform @ applied)[:3].tolist(), "scale": scale * by}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(stored))
    found = CaptureWorld(folder).moved_cameras(read_cameras(tmp_path / "path.json"), tmp_path / "path.json")
    expected = read_dataset(folder, options=DatasetOptions(0)).cameras
    for camera, other in zip(found, expected, strict=True):
        assert np.allclose(camera.camera_to_world, other.camera_to_world, atol=1e-6) and np.allclose(camera.focal, other.focal)
    path = CaptureWorld(folder).moved_path(read_path(tmp_path / "path.json"), tmp_path / "path.json")
    assert np.allclose(path.camera_at(3).camera_to_world, expected[2].camera_to_world, atol=1e-6) and path.end == len(expected)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": [[1, 2]], "scale": 0}))
    with pytest.raises(SnergError, match="copy it again"):
        CaptureWorld(folder).moved_cameras(found, tmp_path / "path.json")


def test_the_cameras_of_a_transforms_file_of_the_capture(tmp_path):
    folder = write_nerfstudio(tmp_path / "scan", moved(SQUARE, similarity(5)))
    file = folder / "transforms.json"
    for camera, other in zip(
        CaptureWorld(folder).moved_cameras(read_cameras(file), file), read_dataset(folder, options=DatasetOptions(0)).cameras, strict=True
    ):
        assert np.allclose(camera.camera_to_world, other.camera_to_world)


def test_a_page_reads_its_capture_once(tmp_path, monkeypatch):
    """For cameras, path and annotations together, and not at all where none is given."""
    folder = write_nerfstudio(tmp_path / "scan", moved(SQUARE, similarity(5)))
    write_scene(make_snerg((20, 20, 20), diffuse=True), tmp_path / "scene")
    (tmp_path / "notes.json").write_text(json.dumps({"annotations": [{"text": "A", "position": [0.5, 0.25, 1.0]}]}))
    read = []
    monkeypatch.setattr(camera_world, "read_dataset", lambda path: read.append(path) or read_dataset(path))
    files = {"cameras": folder / "transforms.json", "path": folder / "transforms.json", "annotations": tmp_path / "notes.json"}
    bundle_scene(tmp_path / "scene", tmp_path / "web", dataset=folder, **files)
    assert read == [folder]
    to_world = read_dataset(folder).source_to_world
    note = json.loads((tmp_path / "web" / "annotations.json").read_text())["annotations"][0]
    assert np.allclose(note["position"], apply(to_world, np.array([[0.5, 0.25, 1.0]]))[0])
    path = CameraPath.from_json(json.loads((tmp_path / "web" / "path.json").read_text()))
    listed = json.loads((tmp_path / "web" / "cameras.json").read_text())["cameras"]
    assert np.allclose(path.camera_at(2).camera_to_world, listed[1]["camera_to_world"], atol=1e-6)
    bundle_scene(tmp_path / "scene", tmp_path / "plain", dataset=folder)
    assert read == [folder]
