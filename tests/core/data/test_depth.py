"""Depth images of other tools: their units, what they measure along, their sizes; and what is wrong with some."""

import json
import re

import numpy as np
import pytest
from captures import apply, moved, ring, write_nerfstudio
from PIL import Image

from snerg.core.commands.info import info
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.io.exr import read_channels, write_channels

SMALLER = np.diag([0.6, 0.6, 0.6, 1.0])  # the source's world; ours puts the cameras 4 units away from what they look at
POINT = np.array([0.3, -0.2, 0.1])  # of a plane through it that faces each camera's axis: depth along the axis is constant


def capture(folder, write, suffix: str, **top):
    """A nerfstudio capture with a depth image for each frame that `write(path, depth [H, W] along the axis)` makes."""
    cameras = moved(ring(6), SMALLER)
    folder.mkdir()
    write_nerfstudio(folder, cameras, **top)
    path = folder / "transforms.json"
    value = json.loads(path.read_text())
    (folder / "depth").mkdir()
    for index, (frame, camera) in enumerate(zip(value["frames"], cameras, strict=True)):
        pose = np.array(frame["transform_matrix"])
        along = float((POINT - pose[:3, 3]) @ -pose[:3, 2])
        write(folder / f"depth/{index}{suffix}", np.full((camera.height, camera.width), along, np.float32))
        frame["depth_file_path"] = f"depth/{index}{suffix}"
    path.write_text(json.dumps(value))
    return folder


def millimetres(path, depth) -> None:
    Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(path)


def units(path, depth) -> None:
    write_channels(path, {"Z": depth})


def truth(dataset, index: int) -> float:
    """The depth of POINT along the axis in the dataset's world."""
    camera = dataset.cameras[index]
    point = apply(dataset.source_to_world, POINT[None])[0]
    return float((point - camera.position) @ -camera.camera_to_world[:3, 2])


def scaled(by: float):
    return lambda path, depth: Image.fromarray(np.rint(depth * by).astype(np.uint16)).save(path)


KINDS = {
    "millimetres": (millimetres, ".png", {}),
    "nerfstudio's unit": (scaled(4000), ".png", {"depth_unit_scale_factor": 1 / 4000}),
    "instant-ngp's unit": (scaled(500), ".png", {"integer_depth_scale": 1 / 500}),
    "float TIFF": (lambda path, depth: Image.fromarray(depth).save(path), ".tiff", {}),
    "EXR": (units, ".exr", {}),
    "half EXR": (lambda path, depth: write_channels(path, {"R": depth, "G": depth, "B": depth}, half=True), ".exr", {}),
    "Blender's layers": (lambda path, depth: write_channels(path, {"Normal.Z": -depth, "ViewLayer.Depth.Z": depth}), ".exr", {}),
    "npy": (lambda path, depth: np.save(path, depth[..., None].astype(np.float64)), ".npy", {}),
    "integers in npy": (lambda path, depth: np.save(path, np.rint(depth * 1000).astype(np.int32)), ".npy", {}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_depth_of_other_tools_is_in_world_units(tmp_path, kind):
    """Photographs are moved and scaled to a world of their own; depth follows."""
    write, suffix, top = KINDS[kind]
    folder = capture(tmp_path / "set", write, suffix, **top)
    train = read_dataset(folder)
    assert abs(train.scale - 1) > 0.05
    for index, camera in enumerate(train.cameras):
        depth = train.depth(index)
        assert depth.shape == (camera.height, camera.width) and depth.dtype == np.float32
        assert np.abs(depth - truth(train, index)).max() < 2e-3 * train.scale
    described = info(folder)["depth"]
    assert described["views"] == 6 and described["missing"] == 0 and described["stored"] == "along the axis"


def test_depth_along_the_ray_is_turned_into_depth_along_the_axis(tmp_path):
    camera = ring(6)[0]
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (columns + 0.5 - camera.centre[0]) / camera.focal[0], (rows + 0.5 - camera.centre[1]) / camera.focal[1]
    longer = np.sqrt(1 + x**2 + y**2).astype(np.float32)
    folder = capture(tmp_path / "set", lambda path, depth: units(path, depth * longer), ".exr", is_euclidean_depth=True)
    train = read_dataset(folder)
    assert np.abs(train.depth(0) - truth(train, 0)).max() < 1e-4
    assert info(folder)["depth"]["stored"] == "along the ray"


@pytest.mark.hard_case(73)
def test_what_was_not_measured_is_nan(tmp_path):
    def write(path, depth) -> None:
        depth[0, :4] = [0, np.nan, np.inf, 1e10]
        units(path, depth)

    train = read_dataset(capture(tmp_path / "set", write, ".exr"))
    assert np.isnan(train.depth(0)[0, :4]).all() and np.isfinite(train.depth(0)[1:]).all()


def test_a_smaller_depth_image_is_enlarged_and_a_reduced_view_has_no_depth_between_surfaces(tmp_path):
    def write(path, depth) -> None:
        depth[:, : depth.shape[1] // 2] *= 2
        millimetres(path, depth[::2, ::2])

    folder = capture(tmp_path / "set", write, ".png")
    for factor in (1, 3):
        train = read_dataset(folder, options=DatasetOptions(downscale=factor))
        far, near = 2 * truth(train, 0), truth(train, 0)
        depth = train.depth(0)
        assert depth.shape == (train.cameras[0].height, train.cameras[0].width)
        assert np.minimum(np.abs(depth - far), np.abs(depth - near)).max() < 2e-3
        assert np.abs(depth[:, 0] - far).max() < 2e-3 and np.abs(depth[:, -1] - near).max() < 2e-3


@pytest.mark.parametrize(
    "write, suffix, top, words",
    [
        (lambda path, depth: units(path, -depth), ".exr", {}, "negative"),
        (lambda path, depth: units(path, depth[:, : depth.shape[1] // 2]), ".exr", {}, "same proportions"),
        (lambda path, depth: Image.fromarray(depth.astype(np.uint8)).save(path), ".png", {}, "8 bits"),
        (lambda path, depth: Image.new("RGB", depth.shape[::-1]).save(path), ".png", {}, "channels R, G, B"),
        (lambda path, depth: path.write_bytes(b"no picture"), ".png", {}, "cannot be read"),
        (lambda path, depth: path.write_bytes(b"no picture"), ".exr", {}, "damaged"),
        (lambda path, depth: write_channels(path, {"N": depth}), ".exr", {}, "no channel Z or Y but N"),
        (lambda path, depth: np.save(path, np.array([{}])), ".npy", {}, "damaged"),
        (lambda path, depth: np.save(path, np.stack([depth, depth])), ".npy", {}, "not one number a pixel"),
        (millimetres, ".png", {"depth_unit_scale_factor": "mm"}, "not a number above 0"),
        (millimetres, ".png", {"depth_unit_scale_factor": 0}, "not a number above 0"),
    ],
    ids=["negative", "other shape", "8 bits", "colours", "no PNG", "no EXR", "other channels", "pickled", "two planes", "unit", "no unit"],
)
def test_what_is_wrong_is_said(tmp_path, write, suffix, top, words):
    """Only where depth is asked for: the dataset can be trained on without it."""
    folder = capture(tmp_path / "set", write, suffix, **top)
    train = read_dataset(folder)
    assert train.read(0).shape[0] == train.cameras[0].height
    with pytest.raises(SnergError, match=words):
        train.depth(0)
    assert re.search(words, info(folder)["depth"]["problem"])


def test_missing_depth_is_counted_and_a_file_outside_is_missing(tmp_path):
    folder = capture(tmp_path / "set", millimetres, ".png")
    (folder / "depth/2.png").unlink()
    described = info(folder)["depth"]
    assert (described["views"], described["missing"]) == (5, 1)
    path = folder / "transforms.json"
    (folder / "depth/1.png").rename(tmp_path / "1.png")
    path.write_text(path.read_text().replace("depth/1.png", "../1.png").replace("depth/3.png", "/somewhere/else/3.png"))
    described = info(folder)["depth"]
    assert (described["views"], described["missing"]) == (3, 3)
    with pytest.raises(SnergError, match="does not exist"):
        read_dataset(folder, options=DatasetOptions(holdout=0)).depth(1)


def test_channels_come_back_as_they_were_written(tmp_path):
    values = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    write_channels(tmp_path / "a.exr", {"Y": values})
    write_channels(tmp_path / "b.exr", {"Y": values})
    assert np.array_equal(read_channels(tmp_path / "a.exr")["Y"], values)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "b.exr"]
