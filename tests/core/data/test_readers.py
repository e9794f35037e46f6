"""Captures of every kind: the same cameras, points and pictures come back from each, upright and near the origin."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import (
    FISHEYE,
    LENS,
    MODELS,
    apply,
    colmap_cameras,
    facing,
    moved,
    ring,
    similarity,
    thing,
    write_colmap,
    write_llff,
    write_nerfstudio,
    write_ngp,
)

from scenes import make_dataset, rotation
from snerg.core.data.dataset import Dataset, DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.orient import upward
from snerg.core.errors import SnergError
from snerg.core.geometry.distortion import Distortion
from snerg.core.io.images import write_png

ALL = DatasetOptions(holdout=0)


def check_cameras(dataset: Dataset, cameras, by: np.ndarray, turned: float | None = 1e-3) -> None:
    """That the dataset's cameras, whatever its world, see what `cameras` (before `by`) saw; and z is up, 4 away."""
    back = dataset.source_to_world @ by  # from the cameras' first world
    points = thing(50, 0)[0]
    assert len(dataset.cameras) == len(cameras)
    for found, camera in zip(dataset.cameras, cameras, strict=True):
        pixels, depth = found.project(apply(back, points))
        expected, before = camera.project(points)
        scale = np.array([found.width / camera.width, found.height / camera.height])
        assert np.abs(pixels - expected * scale).max() < 1e-6 and (depth > 0).all() and (before > 0).all()
    if turned is not None:
        up = back[:3, :3] @ [0, 0, 1]
        assert up[2] / np.linalg.norm(up) > 1 - turned


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("arc", [2 * np.pi, np.pi, 1.2])
def test_photographs_come_back_upright(tmp_path, seed, arc):
    cameras, by = ring(20, LENS, arc), similarity(seed)
    dataset = read_dataset(write_nerfstudio(tmp_path / "a", moved(cameras, by)), options=ALL)
    check_cameras(dataset, cameras, by)
    back = dataset.source_to_world @ by
    assert np.abs(back[:3, 3]).max() < 1e-6  # the object, once at the origin, is there again
    assert np.cbrt(np.linalg.det(back[:3, :3])) == pytest.approx(1, rel=1e-6)  # and the cameras are 4 away again
    assert dataset.box.contains(apply(back, thing(100, 0)[0])).all()


def test_some_pictures_may_be_turned():
    turn = np.eye(4)
    turn[:3, :3] = rotation((0, 0, np.pi / 2))
    cameras = [replace(c, camera_to_world=c.camera_to_world @ turn) if i % 5 == 0 else c for i, c in enumerate(ring(20))]
    assert upward(cameras)[2] > 0.999


def test_pictures_that_agree_on_no_up():
    draw = np.random.default_rng(0)
    cameras = []
    for camera in ring(30):
        turn = np.eye(4)
        turn[:3, :3] = rotation((0, 0, draw.uniform(-np.pi, np.pi)))
        cameras.append(replace(camera, camera_to_world=camera.camera_to_world @ turn))
    assert upward(cameras)[2] > 0.9


@pytest.mark.parametrize("lens", [None, LENS, FISHEYE])
def test_instant_ngp(tmp_path, lens):
    cameras, by = ring(lens=lens), similarity()
    offset = (0.5 - 0.33 * by[:3, 3]).tolist()  # the cube stands round the object
    folder = write_ngp(tmp_path / "a", moved(cameras, by), suffix=".png" if lens else "", offset=offset)
    dataset = read_dataset(folder, options=ALL)
    check_cameras(dataset, cameras, by)
    assert dataset.cameras[0].distortion == lens and dataset.kind == "transforms" and dataset.read(3)[0, 0, 0] == 37
    scale = np.cbrt(np.linalg.det(dataset.source_to_world[:3, :3]))
    assert dataset.box.size[0] == pytest.approx(2 / 0.33 * scale)  # aabb_scale 2
    assert np.allclose(dataset.box.box_to_world[:3, 3], 0, atol=1e-6)


@pytest.mark.parametrize("large", [32, 128])
def test_a_large_aabb_scale_is_an_upper_bound(tmp_path, large):
    boxes = []
    for name, top in (("large", {"aabb_scale": large}), ("none", {})):
        folder = write_ngp(tmp_path / name, ring(), **top)
        value = json.loads((folder / "transforms.json").read_text())
        if not top:
            del value["aabb_scale"]
        (folder / "transforms.json").write_text(json.dumps(value))
        source = read_dataset(folder, options=ALL)
        boxes.append(source.box)
    assert boxes[1] is not None and np.allclose(boxes[0].corners(), boxes[1].corners())
    assert (boxes[0].size <= 16).all()


def test_photographs_that_instant_ngp_threw_away(tmp_path):
    folder = write_ngp(tmp_path / "a", ring())
    (folder / "images" / "004.png").unlink()
    dataset = read_dataset(folder, options=ALL)
    assert len(dataset.views) == 11 and dataset.skipped_frames == 1 and [c.name for c in dataset.cameras][3:5] == ["003", "005"]
    value = json.loads((folder / "transforms.json").read_text())
    del value["aabb_scale"]
    (folder / "transforms.json").write_text(json.dumps(value))
    with pytest.raises(SnergError, match=r"images/004\.png"):
        read_dataset(folder)


def test_masks_hide_pixels(tmp_path):
    folder = write_nerfstudio(tmp_path / "a", ring())
    value = json.loads((folder / "transforms.json").read_text())
    half = np.zeros((18, 24), np.uint8)
    half[:, 12:] = 255
    write_png(folder / "masks" / "0.png", half)
    write_png(folder / "images" / "dynamic_mask_001.png", half)
    write_png(folder / "masks" / "2.png", half[::2, ::2])
    for index in (0, 2):
        value["frames"][index]["mask_path"] = f"masks/{index}.png"
    (folder / "transforms.json").write_text(json.dumps(value))
    dataset = read_dataset(folder, options=ALL)
    assert np.array_equal(dataset.mask(0), half > 0) and np.array_equal(dataset.mask(1), half == 0)
    assert np.array_equal(dataset.mask(2), half > 0) and dataset.mask(3) is None
    small = read_dataset(folder, options=DatasetOptions(0, 5))
    assert small.mask(0).shape == small.read(0).shape[:2] == (3, 4)
    assert small.mask(0)[0].tolist() == [False, False, False, True]  # a pixel that is hidden in part is hidden
    write_png(folder / "masks" / "0.png", half.T)
    with pytest.raises(SnergError, match="mask"):
        dataset.mask(0)


def test_pixels_past_a_lens_fold_are_not_learned_from(tmp_path):
    folded = Distortion("opencv", (-0.6,))
    folder = write_nerfstudio(tmp_path / "a", [replace(c, focal=(13.0, 13.0), distortion=folded) for c in ring()])
    mask = read_dataset(folder, options=ALL).mask(0)
    assert mask is not None and mask[9, 12] and not mask[0, 0]


def test_splits_by_file_names(tmp_path):
    listed = {"train_filenames": [f"images/{i:03d}.png" for i in (0, 2, 4)], "val_filenames": ["./images/001.png"]}
    folder = write_nerfstudio(tmp_path / "a", moved(ring(), similarity()), **listed)
    train, val = read_dataset(folder), read_dataset(folder, "val")
    assert [c.name for c in train.cameras] == ["000", "002", "004"] and [c.name for c in val.cameras] == ["001"]
    assert train.splits() == ("train", "val") and np.array_equal(train.source_to_world, val.source_to_world)
    with pytest.raises(SnergError, match="train, val"):
        read_dataset(folder, "test")


def test_every_nth_view_is_held_out(tmp_path):
    folder = write_ngp(tmp_path / "a", ring(20))
    train, val = read_dataset(folder), read_dataset(folder, "val")
    assert [c.name for c in val.cameras] == ["000", "008", "016"] and len(train.cameras) == 17
    assert train.splits() == ("train", "val") and len(read_dataset(folder, "test").views) == 3
    assert np.array_equal(train.source_to_world, val.source_to_world)
    assert len(read_dataset(folder, options=DatasetOptions(3)).views) == 13
    with pytest.raises(SnergError, match="split"):
        read_dataset(folder, "val", ALL)
    for bad in ({"holdout": 1}, {"holdout": -2}, {"downscale": 0}, {"downscale": 2.5}):
        with pytest.raises(SnergError):
            DatasetOptions(**bad)


def test_downscaling_keeps_the_rays(tmp_path):
    cameras = ring(4, LENS)
    folder = write_nerfstudio(tmp_path / "a", cameras)
    pixels = np.random.default_rng(0).integers(0, 256, (18, 24, 4), dtype=np.uint8)
    pixels[:5, :5] = [255, 0, 0, 0]
    pixels[0, 0] = [0, 255, 0, 200]
    write_png(folder / "images" / "000.png", pixels)
    one, small = (read_dataset(folder, options=DatasetOptions(0, n)) for n in (1, 5))
    assert (small.cameras[0].width, small.cameras[0].height) == (4, 3)
    corner, middle = small.cameras[0].rays(np.array([[0, 0]]))[1], one.cameras[0].rays(np.array([[2, 2]]))[1]
    assert np.allclose(corner, middle)  # the middle of five pixels
    found = small.read(0)
    assert found.shape == (3, 4, 4) and found[0, 0].tolist() == [0, 255, 0, 8]  # what is clear does not colour
    assert np.abs(found[1, 1].astype(float)[3] - pixels[5:10, 5:10, 3].mean()) <= 1
    with pytest.raises(SnergError, match="dividing by 30"):
        read_dataset(folder, options=DatasetOptions(0, 30))


def test_llff_facing_forward(tmp_path):
    cameras, by = facing(), similarity(5)
    scale = np.cbrt(np.linalg.det(by[:3, :3]))
    folder = write_llff(tmp_path / "a", moved(cameras, by), np.tile([2.0, 12.0], (8, 1)) * scale)
    dataset = read_dataset(folder, options=ALL)
    check_cameras(dataset, cameras, by, 1e-2)
    assert dataset.kind == "llff" and dataset.bounds.shape == (8, 2)
    assert dataset.bounds[0, 1] / dataset.bounds[0, 0] == pytest.approx(6)
    axes = np.mean([-c.camera_to_world[:3, 2] for c in dataset.cameras], axis=0)
    assert axes[1] > 0.999  # ahead is +y
    low, high = dataset.box.corners().min(axis=0), dataset.box.corners().max(axis=0)
    assert low[1] < dataset.cameras[0].position[1] + dataset.bounds[0, 0] and high[1] > 0
    assert read_dataset(folder / "poses_bounds.npy", options=ALL).cameras[0].focal == dataset.cameras[0].focal


def test_llff_all_round_and_smaller_pictures(tmp_path):
    cameras, by = [replace(c, focal=(26.0, 26.0), centre=(12, 9)) for c in ring()], similarity(6)
    folder = write_llff(tmp_path / "a", moved(cameras, by), np.tile([2.0, 6.0], (12, 1)), shrink=3)
    dataset = read_dataset(folder, options=ALL)
    assert (dataset.cameras[0].width, dataset.cameras[0].focal[0]) == (8, pytest.approx(26 / 3))
    check_cameras(dataset, cameras, by)
    assert np.abs((dataset.source_to_world @ by)[:3, 3]).max() < 1e-6
    assert read_dataset(folder, options=DatasetOptions(0, 6)).cameras[0].width == 4  # of images_3, halved
    assert read_dataset(folder, options=DatasetOptions(0, 2)).cameras[0].width == 8  # there is nothing larger


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", MODELS)
def test_colmap(tmp_path, model, binary):
    cameras, by = colmap_cameras(model, ring()), similarity(7)
    points, colours = thing()
    folder = write_colmap(tmp_path / "a", moved(cameras, by), apply(by, points), colours, model, binary)
    dataset = read_dataset(folder, options=ALL)
    check_cameras(dataset, cameras, by)
    assert dataset.kind == "colmap" and [c.name for c in dataset.cameras] == [c.name for c in cameras]
    assert dataset.read(3)[0, 0, 0] == 37  # sorted by name, although the model is not
    back = dataset.source_to_world @ by
    assert np.allclose(dataset.points, apply(back, points), atol=1e-4) and np.array_equal(dataset.colours, colours)
    inliers = apply(back, points)[2:]
    assert dataset.box.contains(inliers).all() and dataset.box.size.max() < 16  # two points a thousand away do not count
    assert ((dataset.bounds[:, 0] > 2) & (dataset.bounds[:, 0] < 4)).all() and (dataset.bounds[:, 1] > 4).all()


def test_colmap_folders(tmp_path):
    points, colours = thing()
    folder = write_colmap(tmp_path / "a", ring(lens=LENS), points, colours, shrink=2)
    whole = read_dataset(folder, options=ALL)
    assert whole.cameras[0].width == 12 and len(read_dataset(folder).views) == 10
    write_png(folder / "masks" / "002.png.png", np.zeros((9, 12), np.uint8))
    for path in (folder / "sparse" / "0", folder / "sparse"):
        other = read_dataset(path, options=ALL)
        assert np.allclose(other.cameras[5].camera_to_world, whole.cameras[5].camera_to_world)
        assert not other.mask(2).any() and other.mask(1) is None and other.root == folder.resolve()
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    bare = read_dataset(folder, options=ALL)
    assert bare.points is None and bare.bounds is None and bare.box.contains(np.zeros((1, 3))).all()


@pytest.mark.parametrize("text", [True, False])
def test_points_of_nerfstudio(tmp_path, text):
    points, colours = thing(40, 0)
    by = similarity()
    folder = write_nerfstudio(tmp_path / "a", moved(ring(), by), ply_file_path="points.ply")
    assert read_dataset(folder).points is None  # a copy without the points opens
    kind = "ascii" if text else "binary_little_endian"
    header = f"ply\nformat {kind} 1.0\ncomment x\nelement vertex 40\n"
    header += "".join(f"property double {a}\n" for a in "xyz") + "".join(f"property uchar {a}\n" for a in ("red", "green", "blue"))
    placed = apply(by, points)
    if text:
        body = "".join(
            f"{' '.join(map(repr, p))} {' '.join(map(str, c))}\n" for p, c in zip(placed.tolist(), colours.tolist(), strict=True)
        )
        data = (header + "end_header\n" + body).encode()
    else:
        rows = np.zeros(40, [("xyz", "<f8", 3), ("rgb", "u1", 3)])
        rows["xyz"], rows["rgb"] = placed, colours
        data = (header + "element face 0\nproperty list uchar int vertex_indices\nend_header\n").encode() + rows.tobytes()
    (folder / "points.ply").write_bytes(data)
    dataset = read_dataset(folder)
    assert np.allclose(dataset.points, apply(dataset.source_to_world @ by, points)) and np.array_equal(dataset.colours, colours)
    for bad in (data[:200], data[:-30], data.replace(b"vertex 40", b"vertex 4000000000"), b"ply\n", data.replace(b"double", b"real")):
        (folder / "points.ply").write_bytes(bad)
        with pytest.raises(SnergError, match=r"points\.ply"):
            read_dataset(folder)


def test_renders_stay_where_they_are(tmp_path):
    dataset = read_dataset(make_dataset(tmp_path / "a", train=3, test=1, size=12))
    assert np.array_equal(dataset.source_to_world, np.eye(4)) and dataset.splits() == ("train", "test")
    value = json.loads((tmp_path / "a" / "transforms_train.json").read_text())
    (tmp_path / "a" / "transforms.json").write_text(json.dumps(value))
    whole = read_dataset(tmp_path / "a" / "transforms.json", options=ALL)
    assert np.array_equal(whole.source_to_world, np.eye(4)) and whole.box is not None


def test_pictures_of_different_sizes(tmp_path):
    cameras = list(ring())
    cameras[2] = replace(cameras[2].resized(40, 30), name="002")
    folder = write_nerfstudio(tmp_path / "a", cameras)
    dataset = read_dataset(folder, options=ALL)
    assert dataset.read(2).shape == (30, 40, 3) and dataset.read(1).shape == (18, 24, 3)
    check_cameras(dataset, cameras, np.eye(4))
