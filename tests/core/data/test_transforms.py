"""Datasets on disk: read back as written, and one clear sentence for each way that they can be broken."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from captures import huge_png

from scenes import make_cameras, make_dataset
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import read_cameras, write_transforms
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.io.images import linear_to_srgb, png_bytes, read_image, read_size, srgb_to_linear, write_png


@pytest.fixture
def folder(tmp_path) -> Path:
    return make_dataset(tmp_path / "data", train=3, test=1, size=12)


def edit(folder: Path, change) -> None:
    file = folder / "transforms_train.json"
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))


def test_cameras_come_back_as_written(tmp_path):
    cameras = make_cameras(width=20, height=14)
    write_transforms(tmp_path / "cameras.json", cameras, [f"./{i}" for i in range(len(cameras))])
    for one, other in zip(cameras, read_cameras(tmp_path / "cameras.json"), strict=True):
        assert np.allclose(one.camera_to_world, other.camera_to_world)
        assert (one.width, one.height, one.focal, one.centre, one.projection, one.near) == (
            other.width,
            other.height,
            other.focal,
            other.centre,
            other.projection,
            other.near,
        )


def test_a_dataset_as_nerf_synthetic_writes_it(folder):
    def plain(value):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "snerg_box"):
            value.pop(key, None)
            for frame in value["frames"]:
                frame.pop(key, None)

    before = read_dataset(folder)
    edit(folder, plain)
    after = read_dataset(folder)
    assert before.box is not None and after.box is None
    for one, other in zip(before.cameras, after.cameras, strict=True):
        assert np.allclose(one.focal, other.focal) and np.allclose(one.centre, other.centre)
    assert after.read(0).shape == (12, 12, 4)
    assert read_dataset(folder, "test").split == "test"


def test_intrinsics_for_another_size_are_scaled(folder):
    def double(value):
        for frame in value["frames"]:
            frame.update(w=24, h=24, fl_x=frame["fl_x"] * 2, fl_y=frame["fl_y"] * 2, cx=frame["cx"] * 2, cy=frame["cy"] * 2)

    before = read_dataset(folder).cameras[0]
    edit(folder, double)
    assert np.allclose(read_dataset(folder).cameras[0].focal, before.focal)


def drop_frames(value):
    value["frames"] = []


def missing_image(value):
    value["frames"][1]["file_path"] = "./train/none"


def no_pose(value):
    del value["frames"][0]["transform_matrix"]


def nan_pose(value):
    value["frames"][0]["transform_matrix"][0][0] = float("nan")


def flat_pose(value):
    value["frames"][0]["transform_matrix"] = np.diag([1.0, 1, 0, 1]).tolist()


def outside(value):
    value["frames"][0]["file_path"] = "../../etc/passwd"


def absolute(value):
    value["frames"][0]["file_path"] = "/etc/passwd"


def no_focal(value):
    value.pop("camera_angle_x")
    for frame in value["frames"]:
        frame.pop("fl_x")
        frame.pop("fl_y")


def negative_focal(value):
    value["frames"][0]["fl_x"] = -4


def no_box(value):
    value["snerg_box"] = {"sides": 3}


def text_for_a_number(value):
    value["frames"][0]["fl_x"] = "wide"


@pytest.mark.hard_case(62)
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (drop_frames, "no frames"),
        (missing_image, "does not exist"),
        (outside, "outside"),
        (absolute, "outside"),
        (no_focal, "camera_angle_x"),
        (no_box, "box"),
    ],
)
def test_what_is_wrong_is_said(folder, change, says):
    edit(folder, change)
    with pytest.raises(SnergError, match=says) as error:
        read_dataset(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (no_pose, "transform_matrix"),
        (nan_pose, "pose"),
        (flat_pose, "pose"),
        (negative_focal, "focal"),
        (text_for_a_number, "numbers"),
    ],
)
def test_a_frame_that_cannot_be_used_is_left_out_and_said(folder, change, says):
    whole = len(read_dataset(folder).views)
    edit(folder, change)
    dataset = read_dataset(folder)
    assert len(dataset.views) == whole - 1 and says in dataset.remarks()[0]


def test_a_missing_dataset_and_a_missing_split(folder, tmp_path):
    with pytest.raises(SnergError, match="does not exist"):
        read_dataset(tmp_path / "nowhere")
    with pytest.raises(SnergError, match="test, train"):
        read_dataset(folder, "val")
    (folder / "transforms_train.json").write_text("{")
    with pytest.raises(SnergError, match="not valid JSON"):
        read_dataset(folder)


def test_a_damaged_image(folder):
    path, opened = folder / "train" / "0.png", read_dataset(folder)
    data = path.read_bytes()
    for bad in (data[:60], b"not a picture"):
        path.write_bytes(bad)
        with pytest.raises(SnergError, match=r"0\.png"):
            opened.read(0)
        again = read_dataset(folder)
        assert len(again.views) == len(opened.views) - 1 and "0.png" in again.remarks()[0]
    path.write_bytes(data + bytes(10000))  # another program's data may follow
    assert not read_dataset(folder).remarks()


def test_an_image_of_another_size(folder):
    write_png(folder / "train" / "0.png", np.zeros((6, 6, 4), np.uint8))
    small = read_dataset(folder)  # a smaller copy of the pictures works: intrinsics follow them
    assert small.cameras[0].width == 6 and small.cameras[0].focal[0] * 2 == pytest.approx(small.cameras[1].focal[0])
    write_png(folder / "train" / "0.png", np.zeros((9, 5, 4), np.uint8))
    assert "turned or cropped" in read_dataset(folder).remarks()[0]


@pytest.mark.hard_case(61)
def test_a_small_file_that_claims_to_be_huge(tmp_path):
    for width, height in ((60000, 60000), (13000, 13000)):  # past what Pillow refuses, and past what we do
        (tmp_path / "a.png").write_bytes(huge_png(width, height))
        tracemalloc.start()
        for read in (read_size, read_image):
            with pytest.raises(SnergError, match=f"{width} x {height}|{width * height} pixels"):
                read(tmp_path / "a.png")
        assert tracemalloc.get_traced_memory()[1] < 2**22
        tracemalloc.stop()


def test_png_round_trip_keeps_colour_under_no_alpha(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    pixels[0, :, 3] = 0
    (tmp_path / "a.png").write_bytes(png_bytes(pixels))
    assert np.array_equal(read_image(tmp_path / "a.png"), pixels)


def test_srgb_there_and_back():
    x = np.linspace(0, 1, 101)
    assert np.abs(srgb_to_linear(linear_to_srgb(x)) - x).max() < 1e-6
    assert linear_to_srgb(np.array(0.2140)) == pytest.approx(0.5, abs=1e-3)


def test_boxes_in_every_form(tmp_path):
    box = Box.from_json({"min": [0, 0, 0], "max": [2, 1, 1]})
    same = Box.from_json({"matrix": [[1, 0, 0, 1], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]]})
    assert np.allclose(box.size, same.size) and np.allclose(box.box_to_world, same.box_to_world)
    again = Box.from_json(json.loads(json.dumps(box.to_json())))
    assert np.allclose(again.corners(), box.corners())
    for bad in ({"min": [0, 0, 0], "max": [1, 1, 0]}, {"matrix": np.zeros((4, 4)).tolist()}, [], {"min": [0], "max": [1]}, 3):
        with pytest.raises(SnergError):
            Box.from_json(bad)
