"""Captures as people have them: names, folders, encodings and dialects of other tools, each read or refused by name."""

from __future__ import annotations

import json
import os
import shutil
import struct
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from captures import ring, thing, write_colmap, write_llff, write_nerfstudio, write_ngp
from PIL import Image

from snerg.core.artifact import kind_of
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.image_resolver import find_image
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.data.readers.path_files import read_path
from snerg.core.errors import SnergError
from snerg.core.geometry.distortion import Distortion
from snerg.core.io.images import write_png

ALL = DatasetOptions(0)


def colmap(folder: Path, count: int = 8, binary: bool = True) -> Path:
    return write_colmap(folder, ring(count), *thing(20, 0), model="PINHOLE", binary=binary)


def edit(folder: Path, change, name: str = "transforms.json") -> None:
    value = json.loads((folder / name).read_text())
    change(value)
    (folder / name).write_text(json.dumps(value))


@pytest.mark.parametrize(
    ("named", "real"),
    [
        ("images/A.JPG", "images/a.jpg"),
        ("Images/a.png", "images/A.PNG"),
        ("images/a.jpg", "images/a.webp"),
        ("images/a", "images/a.Tiff"),
        ("images/a.ARW", "images/a.png"),
        (unicodedata.normalize("NFC", "images/Gärten é.png"), unicodedata.normalize("NFD", "images/Gärten é.png")),
        ("/home/me/scan/images/a.png", "images/a.png"),
        ("C:\\scan\\images\\a.png", "images/a.png"),
        ("../scan/images/a.png", "images/a.png"),
        ("data/images/a.png", "images/a.png"),
    ],
)
def test_a_picture_is_found_by_its_name(tmp_path, named, real):
    file = tmp_path / real
    file.parent.mkdir(parents=True)
    file.write_bytes(b"x")
    assert find_image(tmp_path, named, "here") == file.resolve()


def test_the_exact_name_comes_first_and_other_names_are_not_taken(tmp_path):
    for name in ("a.png", "A.png", "b.png"):
        (tmp_path / name).write_bytes(b"x")
    assert find_image(tmp_path, "A.png", "here") == tmp_path / "A.png" and find_image(tmp_path, "a.jpg", "here") == tmp_path / "a.png"
    assert find_image(tmp_path, "c.png", "here") is None
    assert find_image(tmp_path, "test/b.png", "here") is None  # the picture of another split
    with pytest.raises(SnergError, match="outside"):
        find_image(tmp_path, "../c.png", "here")


def test_one_picture_is_not_two_views(tmp_path):
    write_nerfstudio(tmp_path, ring(8))
    edit(tmp_path, lambda v: [f.update(file_path=f"/scan/cam{i}/000.png") for i, f in enumerate(v["frames"])])
    with pytest.raises(SnergError, match=r"cam0/000\.png and /scan/cam1/000\.png"):
        read_dataset(tmp_path, options=ALL)


def test_the_largest_model_is_read_and_said(tmp_path):
    colmap(tmp_path, 3)
    shutil.move(tmp_path / "sparse" / "0", tmp_path / "small")
    colmap(tmp_path, 9, binary=False)
    shutil.move(tmp_path / "sparse" / "0", tmp_path / "sparse" / "1")
    shutil.move(tmp_path / "small", tmp_path / "sparse" / "0")
    dataset = read_dataset(tmp_path, options=ALL)
    assert len(dataset.views) == 9 and "sparse/1" in dataset.notes[0] and "sparse/0 (3)" in dataset.notes[0]
    shutil.rmtree(tmp_path / "sparse" / "0")
    alone = read_dataset(tmp_path, options=ALL)
    assert len(alone.views) == 9 and not alone.notes


@pytest.mark.parametrize(
    ("model", "pictures"),
    [("colmap_text", "images"), ("dense/sparse", "dense/images"), ("sparse/0", "input"), ("colmap/sparse/0", "Images"), ("", "images")],
)
def test_the_layouts_of_other_tools(tmp_path, model, pictures):
    made = colmap(tmp_path / "made", binary="text" not in model)
    for source, target in ((made / "sparse" / "0", model), (made / "images", pictures)):
        shutil.copytree(source, tmp_path / "scan" / target, dirs_exist_ok=True)
    assert len(read_dataset(tmp_path / "scan", options=ALL).views) == 8


def test_the_parent_folder_is_not_taken(tmp_path):
    parent = colmap(tmp_path / "parent")
    scan = colmap(parent / "scan")
    os.rename(scan / "images", scan / "input")
    assert {view.image.parent for view in read_dataset(scan, options=ALL).views} == {(scan / "input").resolve()}
    shutil.rmtree(scan / "input")
    with pytest.raises(SnergError, match="images"):
        read_dataset(scan, options=ALL)


def test_json_as_editors_and_shells_leave_it(tmp_path):
    file = write_nerfstudio(tmp_path, ring(8)) / "transforms.json"
    text = file.read_text().replace('"camera_model": ', '// "a note"\n"link": "http://x/*y*/", /* more\n */ "camera_model": ', 1)
    for data in (text.encode(), text.encode("utf-8-sig"), text.encode("utf-16"), b"\xfe\xff" + text.encode("utf-16-be")):
        file.write_bytes(data)
        assert len(read_dataset(tmp_path, options=ALL).views) == 8


def test_colmap_text_as_others_write_it(tmp_path):
    folder = colmap(tmp_path, binary=False)
    expected = read_dataset(folder, options=ALL)
    for file in (folder / "sparse" / "0").iterdir():
        lines = [line if line.startswith("#") else line.strip().replace(" ", ", ") for line in file.read_text().split("\n")]
        file.write_text("  # a note\n" + "\r\n".join(lines), encoding="utf-8-sig")
    found = read_dataset(folder, options=ALL)
    assert np.allclose([c.camera_to_world for c in found.cameras], [c.camera_to_world for c in expected.cameras])
    assert [v.image for v in found.views] == [v.image for v in expected.views] and np.allclose(found.points, expected.points)


def test_llff_takes_the_photographs_of_its_model_and_says_so(tmp_path):
    cameras = ring(8)
    write_llff(tmp_path, cameras, np.tile([2.0, 9.0], (8, 1)))
    colmap(tmp_path)
    shutil.copy(tmp_path / "images" / "002.png", tmp_path / "images" / "0015.png")
    dataset = read_dataset(tmp_path, options=ALL)
    assert [v.image.stem for v in dataset.views] == [c.name for c in cameras] and "1 photograph" in dataset.notes[0]


def test_photographs_are_turned_by_exif_where_the_cameras_are_for_that(tmp_path):
    write_ngp(tmp_path, ring(8))
    upright = np.random.default_rng(0).integers(0, 256, (18, 24, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    for file in (tmp_path / "images").iterdir():
        Image.fromarray(np.rot90(upright).copy()).save(file, exif=exif)  # stored lying, to be turned clockwise
    dataset = read_dataset(tmp_path, options=ALL)
    assert (dataset.cameras[0].width, dataset.cameras[0].height) == (24, 18) and np.array_equal(dataset.read(0), upright)
    for file in (tmp_path / "images").iterdir():
        Image.fromarray(upright).save(file, exif=exif)  # cameras for the stored pixels: not turned
    assert np.array_equal(read_dataset(tmp_path, options=ALL).read(0), upright)


def test_masks_are_found_under_both_names(tmp_path):
    colmap(tmp_path)
    write_png(tmp_path / "masks" / "001.png.png", np.full((18, 24), 255, np.uint8))
    write_png(tmp_path / "masks" / "002.PNG", np.full((18, 24), 255, np.uint8))
    assert [v.mask.name for v in read_dataset(tmp_path, options=ALL).views if v.mask] == ["001.png.png", "002.PNG"]


def test_k4_is_the_term_of_the_tool_that_wrote_it(tmp_path):
    write_nerfstudio(tmp_path, ring(8))
    edit(tmp_path, lambda v: [[f.pop("k5", 0), f.pop("k6", 0), f.update(k1=0.1, k2=0, k3=0, k4=0.05, p1=0, p2=0)] for f in v["frames"]])
    lens = read_dataset(tmp_path, options=ALL).cameras[0].distortion
    points = np.array([[0.3, 0.4], [0.0, -1.0], [0.7, 0.1]])
    square = (points**2).sum(-1, keepdims=True)
    assert np.allclose(lens.distort(points), points * (1 + 0.1 * square + 0.05 * square**4))
    assert np.allclose(lens.undistort(lens.distort(points)), points)
    edit(tmp_path, lambda v: [f.update(k5=0, k6=0) for f in v["frames"]])
    assert read_dataset(tmp_path, options=ALL).cameras[0].distortion == Distortion("opencv", (0.1, 0, 0, 0, 0, 0.05))


@pytest.mark.parametrize("key", ["x_fov", "y_fov", "camera_angle_y"])
def test_fields_of_view_of_instant_ngp(tmp_path, key):
    write_ngp(tmp_path, ring(8))
    angle = 0.8 if "angle" in key else np.degrees(0.8)
    edit(tmp_path, lambda v: [[v.pop(k) for k in ("fl_x", "fl_y", "camera_angle_x")], v.update({key: angle})])
    across = 24 if key == "x_fov" else 18
    assert np.allclose(read_dataset(tmp_path, options=ALL).cameras[0].focal, across / 2 / np.tan(0.4))


def test_one_panorama_is_left_out_and_named(tmp_path):
    write_nerfstudio(tmp_path, ring(8))
    edit(tmp_path, lambda v: v["frames"][2].update(camera_model="EQUIRECTANGULAR"))
    dataset = read_dataset(tmp_path, options=ALL)
    assert len(dataset.views) == 7 and "002" not in [c.name for c in dataset.cameras] and dataset.skipped_frames == 0
    assert "frame 2" in dataset.notes[0] and "EQUIRECTANGULAR" in dataset.notes[0]


def test_test_cameras_without_pictures(tmp_path):
    write_nerfstudio(tmp_path, ring(8))
    os.rename(tmp_path / "transforms.json", tmp_path / "transforms_train.json")
    value = json.loads((tmp_path / "transforms_train.json").read_text())
    bare = {"camera_angle_x": 0.8, "frames": [{"file_path": f"test/{i}", "transform_matrix": np.eye(4).tolist()} for i in range(3)]}
    (tmp_path / "transforms_test.json").write_text(json.dumps(bare))
    (tmp_path / "transforms_val.json").write_text(json.dumps({**value, "frames": []}))
    assert read_dataset(tmp_path, options=ALL).splits() == ("train",)
    with pytest.raises(SnergError, match="only cameras"):
        read_dataset(tmp_path, "test", options=ALL)
    (camera, *_), file = read_cameras(tmp_path / "transforms_test.json", (60, 40)), tmp_path / "transforms_test.json"
    assert (camera.width, camera.height) == (60, 40) and camera.focal[0] == pytest.approx(30 / np.tan(0.4))
    with pytest.raises(SnergError, match="--width"):
        read_cameras(file)


def test_an_archive_is_to_be_unpacked(tmp_path):
    archive = shutil.make_archive(str(tmp_path / "scan"), "zip", colmap(tmp_path / "folder"))
    for read in (kind_of, read_dataset):
        with pytest.raises(SnergError, match="unpack"):
            read(Path(archive))


def test_a_camera_path_of_nerfstudio(tmp_path):
    pose = ring(3)[1].camera_to_world
    step = {"camera_to_world": pose.ravel().tolist(), "fov": 50, "aspect": 1.5}
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"render_width": 60, "render_height": 40, "camera_type": "perspective", "camera_path": [step, step]}))
    first, second = read_cameras(file)
    assert (first.width, first.height) == (60, 40) and np.allclose(first.camera_to_world, pose) and first.name != second.name
    assert np.allclose(first.focal, 20 / np.tan(np.radians(25))) and first.centre == (30, 20)
    path = read_path(file)
    assert (path.start, path.end, path.fps) == (1, 2, 24.0) and np.allclose(path.camera_at(2).camera_to_world, pose)
    file.write_text(json.dumps({"render_width": 60, "render_height": 40, "fps": 30, "camera_path": [step, step, step]}))
    assert (read_path(file).end, read_path(file).fps) == (3, 30.0)
    for kind in ("equirectangular", "fisheye"):
        file.write_text(json.dumps({"render_width": 60, "render_height": 30, "camera_type": kind, "camera_path": [step]}))
        assert read_cameras(file)[0].projection == kind
        with pytest.raises(SnergError, match=f"{kind}; a path needs perspective"):
            read_path(file)
    file.write_text(json.dumps({"camera_type": "omnidirectional", "camera_path": [step]}))
    with pytest.raises(SnergError, match="omnidirectional"):
        read_cameras(file)


def test_a_model_that_says_more_images_than_it_has(tmp_path):
    colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "sparse" / "1")
    (tmp_path / "sparse" / "1" / "images.bin").write_bytes(struct.pack("<I", 1))
    with pytest.raises(SnergError, match=r"images\.bin.*damaged"):
        read_dataset(tmp_path, options=ALL)


def test_the_cameras_of_gaussian_splatting(tmp_path):
    camera = ring(3)[1]
    axes = camera.camera_to_world[:3, :3] * [1, -1, -1]
    value = {"id": 0, "img_name": "a.png", "width": 24, "height": 18, "position": camera.position.tolist(), "rotation": axes.tolist()}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([{**value, "fx": 26.0, "fy": 27.0}]))
    (found,) = read_cameras(file)
    assert np.allclose(found.camera_to_world, camera.camera_to_world) and found.focal == (26, 27) and found.name == "a"
    for bad in ([value], [], [3]):
        file.write_text(json.dumps(bad))
        with pytest.raises(SnergError, match=r"cameras\.json.*export it again"):
            read_cameras(file)


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("keyframes/depth/1.png", "", "Polycam.*raw data"),
        ("EXR_RGBD/metadata.json", "{}", "Record3D.*EXR"),
        ("scan.rsproj", "", "RealityCapture.*COLMAP"),
        ("scan.psx", "", "Metashape"),
        ("database.db", "", "mapper"),
        ("reconstruction.json", "[]", "OpenSfM"),
    ],
)
def test_a_capture_of_another_tool_is_refused_by_name(tmp_path, file, content, says):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(content)
    for read in (kind_of, read_dataset):
        with pytest.raises(SnergError, match=says):
            read(tmp_path)


@pytest.mark.parametrize("binary", [True, False])
def test_one_lens_of_a_model_is_left_out_and_named(tmp_path, binary):
    sparse = colmap(tmp_path, binary=binary) / "sparse" / "0"
    if binary:
        cameras, images = (sparse / "cameras.bin").read_bytes(), (sparse / "images.bin").read_bytes()
        fov = struct.pack("<IiQQ5d", 9, 7, 24, 18, 26, 26, 12, 9, 0.5)
        (sparse / "cameras.bin").write_bytes(struct.pack("<Q", 2) + cameras[8:] + fov)
        (sparse / "images.bin").write_bytes(images.replace(struct.pack("<I", 7) + b"003.png", struct.pack("<I", 9) + b"003.png"))
    else:
        with open(sparse / "cameras.txt", "a") as file:
            file.write("9 FOV 24 18 26 26 12 9 0.5\n")
        (sparse / "images.txt").write_text((sparse / "images.txt").read_text().replace("7 003.png", "9 003.png"))
    dataset = read_dataset(tmp_path, options=ALL)
    assert len(dataset.views) == 7 and "003" not in [c.name for c in dataset.cameras]
    assert "camera 9" in dataset.notes[0] and "FOV" in dataset.notes[0] and "1 images" in dataset.notes[0]
