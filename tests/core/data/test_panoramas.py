"""Panoramas and fisheyes past 180 degrees as datasets: read from each tool, oriented, written and read again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import apply, moved, pictures, similarity, thing, write_colmap, write_nerfstudio

from scenes import looking
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import read_cameras, write_transforms
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion

ALL = DatasetOptions(0)
OPENCV = np.diag([1.0, -1, -1, 1])  # from OpenGL's axes and back
SIZE = (40, 20)


def panoramas(count: int = 8) -> tuple[Camera, ...]:
    """Upright panoramas within a room, which look all the same way, as cameras on a stick do."""
    draw = np.random.default_rng(2)
    places = draw.uniform(-1, 1, (count, 3)) * [1, 1, 0.2]
    focal, centre = panorama_focal(*SIZE), (SIZE[0] / 2, SIZE[1] / 2)
    return tuple(
        Camera(*SIZE, focal, centre, looking(tuple(p), tuple(p + np.array([0.2, 5, 0]))), "equirectangular", f"{i:03d}")
        for i, p in enumerate(places)
    )


def write_frames(folder: Path, cameras, **top: object) -> Path:
    """Frames with poses alone, under the keys of the file that `top` gives."""
    pictures(folder / "images", cameras)
    frames = [{"file_path": f"images/{c.name}.png", "transform_matrix": c.camera_to_world.tolist()} for c in cameras]
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    return folder


def write_spherical(folder: Path, cameras) -> Path:
    """As Metashape exports spherical cameras: a sensor without a calibration."""
    pictures(folder / "images", cameras)
    shots = "".join(
        f'<camera sensor_id="0" label="{c.name}"><transform>{" ".join(map(repr, (c.camera_to_world @ OPENCV).ravel().tolist()))}'
        "</transform></camera>"
        for c in cameras
    )
    sensor = f'<sensor id="0" type="spherical"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/></sensor>'
    (folder / "a.xml").write_text(f"<document><chunk><sensors>{sensor}</sensors><cameras>{shots}</cameras></chunk></document>")
    return folder


def nerfstudio(folder: Path, cameras) -> Path:
    return write_frames(folder, cameras, camera_model="EQUIRECTANGULAR", fl_x=20, fl_y=20, cx=20, cy=10, w=40, h=20)


def instant_ngp(folder: Path, cameras) -> Path:
    return write_frames(folder, cameras, latlong=True, fl_x=5, w=40, h=20)


@pytest.mark.parametrize("write", [nerfstudio, instant_ngp, write_spherical])
def test_panoramas_of_each_tool(tmp_path, write):
    by = similarity(4)
    written = moved(panoramas(), by)
    dataset = read_dataset(write(tmp_path / "capture", written), options=ALL)
    assert not dataset.remarks()
    for found, camera in zip(dataset.cameras, moved(written, dataset.source_to_world), strict=True):
        assert np.allclose(found.rays()[1], camera.rays()[1], atol=1e-9) and found.projection == "equirectangular"
    up = dataset.source_to_world[:3, :3] @ by[:3, :3] @ [0, 0, 1]
    assert up[2] / np.linalg.norm(up) > 0.999  # z is up again
    middle = np.mean([c.position for c in dataset.cameras], axis=0)
    assert np.linalg.norm(middle) < 1 and dataset.box.contains(np.stack([c.position for c in dataset.cameras])).all()
    assert dataset.box.size.min() > 4 * np.ptp([c.position for c in dataset.cameras], axis=0).max()  # the room, not the cameras


def test_what_is_no_whole_panorama_is_left_out_or_refused(tmp_path):
    cameras = panoramas()
    folder = nerfstudio(tmp_path / "a", cameras)
    pictures(folder / "images", [replace(cameras[2], width=30, height=20)])
    dataset = read_dataset(folder, options=ALL)
    assert len(dataset.views) == 7 and "40 x 20" in dataset.notes[0]
    folder = write_frames(tmp_path / "b", cameras, equirectangular=True, fl_x=5, w=40, h=20)
    with pytest.raises(SnergError, match=r"equirectangular.*equal-area"):
        read_dataset(folder, options=ALL)


def test_a_panorama_among_photographs(tmp_path):
    """Both are trained on; each has rays of its own kind."""
    panorama = panoramas(3)
    photographs = [Camera(24, 18, (20.0, 20.0), (12, 9), looking((2, -3, 1), (0, 0, 0)), name=f"p{i}") for i in range(3)]
    folder = write_nerfstudio(tmp_path / "capture", photographs)
    pictures(folder / "images", panorama)
    value = json.loads((folder / "transforms.json").read_text())
    value["frames"] += [
        {"file_path": f"images/{c.name}.png", "camera_model": "EQUIRECTANGULAR", "transform_matrix": c.camera_to_world.tolist()}
        for c in panorama
    ]
    (folder / "transforms.json").write_text(json.dumps(value))
    assert [c.projection for c in read_dataset(folder, options=ALL).cameras] == ["perspective"] * 3 + ["equirectangular"] * 3


def test_fisheyes_past_180_degrees(tmp_path):
    """OpenCV's fisheye, of nerfstudio and of COLMAP, where the picture reaches behind the camera."""
    lens = Distortion("fisheye", (0.02, -0.003, 0.0001, 0.0))
    poses = [looking((4 * math.cos(a), 4 * math.sin(a), 1.5), (0, 0, 0)) for a in np.linspace(0, 5, 6)]
    cameras = [Camera(24, 18, (7.0, 7.5), (12, 9), pose, name=f"{i:03d}", distortion=lens) for i, pose in enumerate(poses)]
    points, colours = thing(40, 0)
    by = similarity(6)
    for kind in ("nerfstudio", "colmap"):
        written = moved(cameras, by)
        if kind == "nerfstudio":
            folder = write_nerfstudio(tmp_path / kind, written, camera_model="OPENCV_FISHEYE")
        else:
            folder = write_colmap(tmp_path / kind, written, apply(by, points), colours, "OPENCV_FISHEYE")
        dataset = read_dataset(folder, options=ALL)
        first = dataset.cameras[0]
        assert first.projection == "fisheye" and first.valid_pixels() is None
        corner = first.rays(np.array([[0, 0]]))[1][0] @ first.camera_to_world[:3, :3]
        assert corner[2] > 0  # behind the camera
        expected = moved([c.widened() for c in written], dataset.source_to_world)
        assert all(np.allclose(a.rays()[1], b.rays()[1], atol=1e-9) for a, b in zip(dataset.cameras, expected, strict=True))


def test_wide_cameras_are_written_and_read(tmp_path):
    """Also a part of a panorama, and a fisheye's circle, as Blender's cameras have them."""
    one, two = panoramas(2)
    part = replace(two, focal=(9.0, 12.0), centre=(13.0, 8.0))
    circle = replace(one, projection="fisheye", focal=(11.0, 8.0), widest=1.2, distortion=Distortion("fisheye", (0.01,)))
    write_transforms(tmp_path / "t.json", [one, part, circle], ["a.png", "b.png", "c.png"])
    for found, camera in zip(read_cameras(tmp_path / "t.json"), (one, part, circle), strict=True):
        assert np.allclose(found.rays()[1], camera.rays()[1]) and found.widest == camera.widest and found.projection == camera.projection
