"""Every key for lenses, fields of view, crops, masks and frames that the loaders of other tools know: honoured, refused by name, or said.

instant-ngp: src/nerf_loader.cu. nerfstudio: its dataparsers nerfstudio, instant_ngp, blender, dnerf, colmap, phototourism and sdfstudio.
Gaussian splatting: scene/dataset_readers.py and colmap_loader.py. COLMAP: sensor/models and the reconstruction's text and binary files.
"""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import ring, thing, write_colmap, write_ngp

from snerg.core.artifact import kind_of
from snerg.core.data.dataset import Dataset, DatasetOptions
from snerg.core.data.load import read_dataset, read_split
from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.errors import SnergError
from snerg.core.io.images import write_png

ALL = DatasetOptions(0)
WHITE = np.full((18, 24), 255, np.uint8)
POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
START, END = np.eye(4).tolist(), (np.eye(4) + np.eye(4, k=3)).tolist()


@dataclass
class Key:
    """A key, or a file that counts like one, of a tool; a frame's key or the whole file's, and what must come of it."""

    tool: str
    name: str
    top: dict[str, Any] = field(default_factory=dict)
    frame: dict[str, Any] = field(default_factory=dict)  # values may have {} for the frame's number
    drop: tuple[str, ...] = ()
    holds: Callable[[Dataset], Any] = lambda dataset: len(dataset.views) == 4
    files: Callable[[Path], Any] = lambda folder: None

    def __str__(self) -> str:
        return f"{self.tool}: {self.name}"


def lens(*coefficients: float, model: str = "opencv") -> Callable[[Dataset], bool]:
    def holds(dataset: Dataset) -> bool:
        found = dataset.cameras[0].distortion
        return found is not None and found.model == model and found.coefficients[: len(coefficients)] == coefficients

    return holds


def focal(axis: int, value: float) -> Callable[[Dataset], bool]:
    return lambda dataset: bool(np.isclose(dataset.cameras[0].focal[axis], value))


def picture(name: str, values: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: write_png(folder / name, values)


def numbers(name: str, values: np.ndarray) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "depth").mkdir(exist_ok=True)
        np.save(folder / name, values)

    return write


def transparent(level: int) -> Callable[[Path], None]:
    return picture("images/000.png", np.concatenate([np.full((9, 24, 3), level), np.full((9, 24, 3), 99)]).astype(np.uint8))


def half_seen(dataset: Dataset) -> bool:
    image = dataset.read(0)
    return image.shape[-1] == 4 and not image[:9, :, 3].any() and bool((image[9:, :, 3] == 255).all())


def upright(dataset: Dataset) -> bool:
    return bool(np.allclose(dataset.source_to_world[:3, :3] @ [0, 1, 0], [0, 0, dataset.scale]))


def edit(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    value = json.loads((folder / "transforms.json").read_text())
    change(value)
    (folder / "transforms.json").write_text(json.dumps(value))


def blurred(folder: Path) -> None:
    edit(folder, lambda value: value["frames"][2].update(sharpness=3.0))


def exposed(folder: Path) -> None:
    edit(folder, lambda value: [f.update(transform_matrix_start=f["transform_matrix"], transform_matrix=END) for f in value["frames"]])


def unnamed(folder: Path) -> None:
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    for index in range(4):
        write_png(folder / f"train_00{index}" / "rgba.png", WHITE)


def rays(folder: Path) -> None:
    for index in range(4):
        (folder / "images" / f"rays_00{index}.dat").write_bytes(b"0")


def boxed(centre: tuple[float, ...], half: float) -> Callable[[Dataset], bool]:
    """Whether the box is the cube around `centre`, with sides of 2 `half`, in the poses' own world."""

    def holds(dataset: Dataset) -> bool:
        middle = dataset.source_to_world[:3] @ [*centre, 1]
        return np.allclose(dataset.box.box_to_world[:3, 3], middle) and np.allclose(dataset.box.size, 2 * half * dataset.scale)

    return holds


def wide(folder: Path) -> None:
    for index in range(4):
        write_png(folder / "images" / f"00{index}.png", np.zeros((18, 36, 3), np.uint8))


def panorama(dataset: Dataset) -> bool:
    return all(camera.projection == "equirectangular" for camera in dataset.cameras)


def names(dataset: Dataset) -> list[str]:
    return [view.image.stem for view in dataset.views]


NGP, STUDIO, SPLAT = "instant-ngp", "nerfstudio", "gaussian-splatting"
DEPTH = np.full((18, 24), 2000, np.int32)
HALF = np.concatenate([np.zeros((9, 24), np.uint8), np.full((9, 24), 255, np.uint8)])

HONOURED = [
    Key(NGP, "fl_x", {"fl_x": 30}, holds=focal(0, 30)),
    Key(NGP, "fl_y", {"fl_y": 31}, holds=focal(1, 31)),
    Key(NGP, "fl_x of a frame", frame={"fl_x": 30}, holds=focal(0, 30)),
    Key(NGP, "w, h, fl_x of a frame", frame={"w": 48, "h": 36, "fl_x": 52, "cx": 24, "cy": 18}, holds=focal(0, 26)),
    Key(NGP, "cx", {"cx": 11}, holds=lambda d: d.cameras[0].centre[0] == 11),
    Key(NGP, "cy", {"cy": 8}, holds=lambda d: d.cameras[0].centre[1] == 8),
    Key(NGP, "w and h", {"w": 48, "h": 36}, holds=focal(0, 13)),
    Key(NGP, "x_fov before fl_x", {"x_fov": 50}, holds=focal(0, 12 / np.tan(np.radians(25)))),
    Key(NGP, "y_fov", {"y_fov": 50}, drop=("fl_y",), holds=focal(1, 9 / np.tan(np.radians(25)))),
    Key(NGP, "y_fov of a frame", frame={"y_fov": 50}, holds=focal(1, 9 / np.tan(np.radians(25)))),
    Key(NGP, "camera_angle_x", {"camera_angle_x": 0.8}, drop=("fl_x", "fl_y"), holds=focal(0, 12 / np.tan(0.4))),
    Key(NGP, "camera_angle_y", {"camera_angle_y": 0.8}, drop=("fl_x", "fl_y"), holds=focal(1, 9 / np.tan(0.4))),
    Key(NGP, "k1 to k3, p1, p2", {"k1": 0.1, "k2": 0.02, "k3": 0.03, "p1": 0.01, "p2": 0.02}, holds=lens(0.1, 0.02, 0.01, 0.02, 0.03)),
    Key(NGP, "k1 of a frame", frame={"k1": 0.1}, holds=lens(0.1)),
    Key(NGP, "is_fisheye, k4", {"is_fisheye": True, "k1": 0.1, "k4": 0.01}, holds=lens(0.1, 0, 0, 0.01, model="fisheye")),
    Key(NGP, "transform_matrix_start", files=exposed, holds=lambda d: len({tuple(c.position) for c in d.cameras}) == 4),
    Key(NGP, "rolling_shutter of a camera that stands", {"rolling_shutter": [0, 0.1, 0, 0]}),
    Key(NGP, "aabb_scale", {"aabb_scale": 1}, holds=lambda d: d.box is not None),
    Key(NGP, "scale", {"aabb_scale": 1, "scale": 0.25}, holds=boxed((0, 0, 0), 2)),
    Key(NGP, "offset", {"aabb_scale": 1, "scale": 0.25, "offset": [0.25, 0.5, 0.5]}, holds=boxed((1, 0, 0), 2)),
    Key(NGP, "offset of one number", {"aabb_scale": 1, "scale": 0.25, "offset": 0.25}, holds=boxed((1, 1, 1), 2)),
    Key(NGP, "aabb", {"aabb_scale": 1, "aabb": [[0, -1, -1], [2, 1, 1]]}, holds=boxed((1, 0, 0), 1)),
    Key(NGP, "n_frames", {"n_frames": 3}, holds=lambda d: names(d) == ["000", "001", "002"] and "n_frames" in d.notes[0]),
    Key(
        NGP,
        "sharpness_discard_threshold",
        {"sharpness_discard_threshold": 0.5},
        holds=lambda d: names(d) == ["000", "001", "003"] and "sharpness" in d.notes[0],
        files=blurred,
    ),
    Key(NGP, "up", {"up": [0, 2, 0]}, holds=upright),
    Key(NGP, "white_transparent", {"white_transparent": True}, files=transparent(255), holds=half_seen),
    Key(NGP, "black_transparent", {"black_transparent": True}, files=transparent(0), holds=half_seen),
    Key(NGP, "<image>.alpha.png", files=picture("images/000.png.alpha.png", HALF), holds=half_seen),
    Key(NGP, "<name>.alpha.png", files=picture("images/000.alpha.png", HALF), holds=half_seen),
    Key(NGP, "dynamic_mask_<name>.png", files=picture("images/dynamic_mask_000.png", HALF), holds=lambda d: d.mask(0)[:9].all()),
    Key(
        NGP,
        "depth_path, integer_depth_scale",
        {"integer_depth_scale": 0.5},
        {"depth_path": "depth/a.npy"},
        files=numbers("depth/a.npy", DEPTH),
        holds=lambda d: np.allclose(d.depth(0), 1000 * d.scale),
    ),
    Key(NGP, "enable_depth_loading", {"enable_depth_loading": False}, {"depth_path": "depth/a.npy"}, holds=lambda d: d.depth(0) is None),
    Key(NGP, "enable_ray_loading", {"enable_ray_loading": False}, files=rays),
    Key(NGP, "file_path that is empty", frame={"file_path": ""}, files=unnamed, holds=lambda d: names(d) == ["rgba"] * 4),
    Key(NGP, "file_path with \\", frame={"file_path": "images\\00{}.png"}),
    Key(NGP, "file_path without a suffix", frame={"file_path": "images/00{}"}),
    *(
        Key(STUDIO, f"camera_model {name}", {"camera_model": name, "k1": 0.1}, holds=lens(0.1))
        for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
    ),
    Key(STUDIO, "camera_model OPENCV_FISHEYE", {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, holds=lens(0.1, model="fisheye")),
    Key(STUDIO, "camera_model EQUIRECTANGULAR", {"camera_model": "EQUIRECTANGULAR", "w": 36, "h": 18}, files=wide, holds=panorama),
    Key(NGP, "latlong", {"latlong": True, "w": 36, "h": 18}, files=wide, holds=panorama),
    Key(STUDIO, "k4", {"k1": 0.1, "k4": 0.01}, holds=lens(0.1, 0, 0, 0.01, model="nerfstudio")),
    Key(STUDIO, "distortion_params", {"distortion_params": [0.1, 0.02, 0.03, 0.0, 0.01, 0.02]}, holds=lens(0.1, 0.02, 0.01, 0.02, 0.03)),
    Key(
        STUDIO,
        "distortion_params of a fisheye",
        {"camera_model": "OPENCV_FISHEYE", "distortion_params": [0.1, 0.02, 0.03, 0.04]},
        holds=lens(0.1, 0.02, 0.03, 0.04, model="fisheye"),
    ),
    Key(
        STUDIO,
        "fisheye_crop_radius",
        {"camera_model": "OPENCV_FISHEYE", "fisheye_crop_radius": 10, "w": 48, "h": 36, "fl_x": 80, "fl_y": 80},
        holds=lambda d: d.mask(0)[9, 8:16].all() and not d.mask(0)[9, :7].any() and abs(d.mask(0).sum() - np.pi * 25) < 8,
    ),
    Key(STUDIO, "mask_path", frame={"mask_path": "m/a.png"}, files=picture("m/a.png", HALF), holds=lambda d: d.mask(0)[9:].all()),
    Key(
        STUDIO,
        "depth_file_path, depth_unit_scale_factor",
        {"depth_unit_scale_factor": 0.002},
        {"depth_file_path": "depth/a.npy"},
        files=numbers("depth/a.npy", DEPTH),
        holds=lambda d: np.allclose(d.depth(0), 4 * d.scale),
    ),
    Key(STUDIO, "train_filenames", {"train_filenames": ["images/001.png", "images/003.png"]}, holds=lambda d: names(d) == ["001", "003"]),
    Key(
        STUDIO,
        "val_filenames, test_filenames",
        {f"{split}_filenames": [f"images/00{i}.png" for i in which] for split, which in (("train", (0, 1)), ("val", (2,)), ("test", (3,)))},
        holds=lambda d: d.splits() == ("train", "val", "test"),
    ),
    Key(
        STUDIO,
        "orientation_override none",
        {"orientation_override": "none"},
        holds=lambda d: np.allclose(d.source_to_world[:3, :3] @ [0, 0, 1], [0, 0, d.scale]),
    ),
    Key(STUDIO, "orientation_override vertical", {"orientation_override": "vertical"}),
    Key(
        STUDIO,
        "ply_file_path",
        {"ply_file_path": "sparse.ply"},
        files=lambda folder: (folder / "sparse.ply").write_bytes(POINTS),
        holds=lambda d: len(d.points) == 1,
    ),
    Key(STUDIO, "applied_transform, applied_scale", {"applied_transform": END[:3], "applied_scale": 2.0}, holds=lambda d: focal(0, 26)(d)),
]

REFUSED = [
    *(Key(NGP, name, {name: True}) for name in ("from_mitsuba", "normal_mts_args", "from_na")),
    Key(NGP, "fix_premult", {"fix_premult": True}, {"file_path": "images/00{}.exr"}),
    Key(NGP, "rolling_shutter", {"rolling_shutter": [0, 0.1, 0, 0]}, {"transform_matrix_start": START, "transform_matrix_end": END}),
    Key(NGP, "ftheta_p0", {"ftheta_p0": 0.1}),
    Key(NGP, "rays_00", files=rays),
    Key(NGP, "up", {"up": [0, 0, 0]}),
    Key(NGP, "n_frames", {"n_frames": "all"}),
    Key(STUDIO, "fisheye_crop_radius", {"fisheye_crop_radius": -1}),
    Key(STUDIO, "distortion_params", {"distortion_params": [0.0] * 16}),
    Key(STUDIO, "none.png", frame={"mask_path": "none.png"}),
    Key(STUDIO, "train_filenames", {"train_filenames": ["images/009.png"]}),
    *(Key(NGP, name, {name: True}) for name in ("latlong", "equirectangular")),  # of pictures that are not twice as wide as high
    Key(STUDIO, "EQUIRECTANGULAR", {"camera_model": "EQUIRECTANGULAR"}),
    *(
        Key(STUDIO, name, {"camera_model": name})
        for name in ("OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R", "ORTHOPHOTO", "FISHEYE624")
    ),
]

SAID = [
    *(Key(NGP, name, {name: True}) for name in ("sharpen", "importance_sampling", "n_extra_learnable_dims", "envmap", "render_aabb")),
    Key(NGP, "driver_parameters", frame={"driver_parameters": {"LightX": 1.0}}),
    Key(STUDIO, "time", frame={"time": "{}"}),
]


def written(folder: Path, key: Key) -> Path:
    """A capture of four pictures of 24 x 18 pixels whose file has the key."""
    write_ngp(folder, ring(4), **key.top)

    def change(value: dict[str, Any]) -> None:
        for name in key.drop:
            value.pop(name)
        for index, frame in enumerate(value["frames"]):
            filled = {k: v.format(index) if isinstance(v, str) else v for k, v in key.frame.items()}
            frame.update({k: float(v) if k == "time" else v for k, v in filled.items()})

    edit(folder, change)
    key.files(folder)
    return folder


@pytest.mark.parametrize("key", HONOURED, ids=str)
def test_it_is_honoured(tmp_path, key):
    assert key.holds(read_dataset(written(tmp_path, key), options=ALL))


@pytest.mark.parametrize("key", REFUSED, ids=str)
def test_it_is_refused_by_name(tmp_path, key):
    with pytest.raises(SnergError, match=re.escape(key.name)):
        read_dataset(written(tmp_path, key), options=ALL)


def test_cameras_to_render_from_have_the_same_axes(tmp_path):
    folder = written(tmp_path, Key(NGP, "from_mitsuba", {"from_mitsuba": True}))
    with pytest.raises(SnergError, match="from_mitsuba"):
        read_cameras(folder / "transforms.json")


@pytest.mark.parametrize("key", SAID, ids=str)
def test_it_is_said_that_it_has_no_effect(tmp_path, key):
    dataset = read_dataset(written(tmp_path, key), options=ALL)
    assert len(dataset.views) == 4 and any(re.search(rf"\b{key.name}\b.*no effect", note) for note in dataset.remarks())


def sparse(folder: Path) -> Path:
    return folder / "sparse" / "0"


def model_written(folder: Path, binary: bool = False, count: int = 4) -> Path:
    """A COLMAP model of pictures of 24 x 18 pixels."""
    return write_colmap(folder, ring(count), *thing(20, 0), model="PINHOLE", binary=binary)


def with_lens(folder: Path, number: int, name: str, values: list[float], binary: bool) -> Path:
    """The model with one camera of another lens."""
    model_written(folder, binary)
    if binary:
        (sparse(folder) / "cameras.bin").write_bytes(struct.pack(f"<QIiQQ{len(values)}d", 1, 7, number, 24, 18, *values))
    else:
        (sparse(folder) / "cameras.txt").write_text(f"7 {name} 24 18 {' '.join(map(str, values))}\n")
    return folder


LENSES: list[tuple[str, int, tuple[str, tuple[float, ...]] | None]] = [  # by COLMAP's number: name, parameters, the lens or None: refused
    ("SIMPLE_PINHOLE", 3, ("", ())),
    ("PINHOLE", 4, ("", ())),
    ("SIMPLE_RADIAL", 4, ("opencv", (0.1,))),
    ("RADIAL", 5, ("opencv", (0.1, 0.2))),
    ("OPENCV", 8, ("opencv", (0.1, 0.2, 0.3, 0.4))),
    ("OPENCV_FISHEYE", 8, ("fisheye", (0.1, 0.2, 0.3, 0.4))),
    ("FULL_OPENCV", 12, ("opencv", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))),
    ("FOV", 5, None),
    ("SIMPLE_RADIAL_FISHEYE", 4, ("fisheye", (0.1,))),
    ("RADIAL_FISHEYE", 5, ("fisheye", (0.1, 0.2))),
    ("THIN_PRISM_FISHEYE", 12, None),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16, None),
    ("SIMPLE_DIVISION", 4, None),
    ("DIVISION", 5, None),
    ("SIMPLE_FISHEYE", 3, ("fisheye", ())),
    ("FISHEYE", 4, ("fisheye", ())),
    ("EUCM", 6, None),
    ("EQUIRECTANGULAR", 2, None),
]
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_DIVISION", "SIMPLE_FISHEYE")


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("number", range(len(LENSES)), ids=[name for name, *_ in LENSES])
def test_the_lenses_of_colmap(tmp_path, number, binary):
    name, count, expected = LENSES[number]
    first = [20.0, 12.5, 8.5] if name in ONE_FOCAL else [20.0, 21.0, 12.5, 8.5]
    values = [*first, *(0.1 * (i + 1) for i in range(12))][:count]
    with_lens(tmp_path, number, name, values, binary)
    if expected is None:
        with pytest.raises(SnergError, match=rf"\b{name}\b"):
            read_dataset(tmp_path, options=ALL)
        return
    camera = read_dataset(tmp_path, options=ALL).cameras[0]
    assert camera.focal == (20, 20 if name in ONE_FOCAL else 21) and camera.centre == (12.5, 8.5)
    found = camera.distortion
    if expected == ("", ()):
        assert found is None
    else:
        assert found.model == expected[0] and np.allclose(found.coefficients[: len(expected[1])], expected[1])


def test_rigs_and_frames_of_colmap_leave_the_poses(tmp_path):
    model_written(tmp_path / "a", binary=True)
    model_written(tmp_path / "b", binary=True)
    for name in ("rigs", "frames"):
        (sparse(tmp_path / "b") / f"{name}.bin").write_bytes(struct.pack("<QIIiI", 1, 1, 1, 0, 7))
    plain, rig = (read_dataset(tmp_path / name, options=ALL) for name in "ab")
    assert all(np.allclose(a.camera_to_world, b.camera_to_world) for a, b in zip(plain.cameras, rig.cameras, strict=True))


def test_points_of_gaussian_splatting_stand_for_those_of_the_model(tmp_path):
    model_written(tmp_path)
    (sparse(tmp_path) / "points3D.txt").unlink()
    (sparse(tmp_path) / "points3D.ply").write_bytes(POINTS)
    dataset = read_dataset(tmp_path, options=ALL)
    assert len(dataset.points) == 1 and dataset.bounds is None


@pytest.mark.parametrize(
    ("file", "lines", "expected"),
    [
        ("train_list.txt", "000.png\n002.png\n", {"train": ["000", "002"]}),
        ("test_list.txt", "003.png\n", {"train": ["000", "001", "002"], "test": ["003"]}),
        ("validation_list.txt", "003.png\n", {"train": ["000", "001", "002"], "val": ["003"]}),
        ("sparse/0/test.txt", "001.png\n", {"train": ["000", "002", "003"], "test": ["001"]}),
        ("sparse/0/test.txt", "\n", {"train": ["000", "001", "002", "003"]}),
        ("test_list.txt", "009.png\n", None),
    ],
    ids=lambda value: value if isinstance(value, str) and "/" not in value else None,
)
def test_lists_of_splits(tmp_path, file, lines, expected):
    (model_written(tmp_path) / file).write_text(lines)
    if expected is None:
        with pytest.raises(SnergError, match=r"test_list\.txt names 009"):
            read_dataset(tmp_path, options=ALL)
        return
    dataset = read_dataset(tmp_path, options=ALL)
    assert {split: names(read_split(dataset, split)) for split in dataset.splits()} == expected


@pytest.mark.parametrize(
    "mask",
    [
        "masks/000.png.png",
        "masks/000.png",
        "masks/000.JPG",
        "Masks/000_mask.png",
        "mask/000.png.mask.png",
        "images/000_mask.png",
        "images/000.png.mask.png",
    ],
)
def test_masks_as_tools_name_them(tmp_path, mask):
    write_png(model_written(tmp_path) / mask, HALF)
    dataset = read_dataset(tmp_path, options=ALL)
    assert dataset.mask(0)[9:].all() and not dataset.mask(0)[:9].any() and dataset.mask(1) is None and not dataset.remarks()


def test_what_is_passed_over_is_said(tmp_path):
    write_png(model_written(tmp_path / "colmap") / "masks" / "009.png", WHITE)
    (sparse(tmp_path / "colmap") / "depth_params.json").write_text("{}")
    write_png(write_ngp(tmp_path / "ngp", ring(4)) / "masks" / "000.png", WHITE)
    said = " ".join(read_dataset(tmp_path / "colmap", options=ALL).remarks())
    assert "depth_params.json" in said and "1 of the 1 masks" in said and "009.png" in said
    assert "masks" in " ".join(read_dataset(tmp_path / "ngp", options=ALL).remarks())


def sdfstudio(folder: Path, **frame: Any) -> Path:
    write_ngp(folder, ring(4))
    (folder / "transforms.json").unlink()
    frames = []
    for camera in ring(4):
        lens = np.eye(4)
        lens[:2, :3] = [[26, 0, 12.5], [0, 27, 8.8]]
        pose = camera.camera_to_world * [1, -1, -1, 1]
        frames.append({"rgb_path": f"images/{camera.name}.png", "camtoworld": pose.tolist(), "intrinsics": lens.tolist(), **frame})
    box = {"aabb": [[-1, -1, -1], [1, 1, 1]], "near": 0.1, "far": 5, "radius": 1, "collider_type": "near_far"}
    value = {"camera_model": "OPENCV", "height": 18, "width": 24, "has_mono_prior": False, "scene_box": box, "frames": frames}
    (folder / "meta_data.json").write_text(json.dumps(value))
    return folder


def test_a_dataset_of_sdfstudio(tmp_path):
    other = write_ngp(tmp_path / "ngp", ring(4), aabb_scale=2, scale=1)
    write_png(tmp_path / "sdf" / "m.png", HALF)
    mine = read_dataset(sdfstudio(tmp_path / "sdf", foreground_mask="m.png", mono_depth_path="d.npy"), options=ALL)
    for a, b in zip(mine.cameras, read_dataset(other, options=ALL).cameras, strict=True):
        assert np.allclose(a.camera_to_world, b.camera_to_world) and (a.focal, a.centre) == (b.focal, b.centre)
    assert np.allclose(mine.box.corners(), read_dataset(other, options=ALL).box.corners())
    assert mine.mask(0)[9:].all() and not mine.mask(0)[:9].any() and "no effect" in mine.notes[0]
    assert kind_of(tmp_path / "sdf") == "dataset" and len(read_dataset(tmp_path / "sdf" / "meta_data.json", options=ALL).views) == 4
    (sdfstudio(tmp_path / "bad", camtoworld=3) / "x").touch()
    with pytest.raises(SnergError, match="frame 0 has no camtoworld"):
        read_dataset(tmp_path / "bad", options=ALL)


def test_phototourism_is_a_dense_model(tmp_path):
    model_written(tmp_path / "made")
    (tmp_path / "dense").mkdir()
    shutil.move(sparse(tmp_path / "made"), tmp_path / "dense" / "sparse")
    shutil.move(tmp_path / "made" / "images", tmp_path / "dense" / "images")
    assert len(read_dataset(tmp_path, options=ALL).views) == 4
