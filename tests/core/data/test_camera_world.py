"""Cameras of other tools in the world in which a capture is trained."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import apply, moved, ring, similarity, thing, write_colmap, write_nerfstudio

from snerg.core.data.camera_world import in_training_world, placed_path
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.data.readers.path_files import read_path
from snerg.core.errors import SnergError

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
        in_training_world(read_cameras(tmp_path / "path.json"), tmp_path / "path.json", folder)
    stored = {"transform": (transform @ applied)[:3].tolist(), "scale": scale * by}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(stored))
    found = in_training_world(read_cameras(tmp_path / "path.json"), tmp_path / "path.json", folder)
    expected = read_dataset(folder, options=DatasetOptions(0)).cameras
    for camera, other in zip(found, expected, strict=True):
        assert np.allclose(camera.camera_to_world, other.camera_to_world, atol=1e-6) and np.allclose(camera.focal, other.focal)
    path = placed_path(read_path(tmp_path / "path.json"), tmp_path / "path.json", folder)
    assert np.allclose(path.camera_at(3).camera_to_world, expected[2].camera_to_world, atol=1e-6) and path.end == len(expected)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": [[1, 2]], "scale": 0}))
    with pytest.raises(SnergError, match="copy it again"):
        in_training_world(found, tmp_path / "path.json", folder)


def test_the_cameras_of_a_transforms_file_of_the_capture(tmp_path):
    folder = write_nerfstudio(tmp_path / "scan", moved(SQUARE, similarity(5)))
    file = folder / "transforms.json"
    for camera, other in zip(
        in_training_world(read_cameras(file), file, folder), read_dataset(folder, options=DatasetOptions(0)).cameras, strict=True
    ):
        assert np.allclose(camera.camera_to_world, other.camera_to_world)
