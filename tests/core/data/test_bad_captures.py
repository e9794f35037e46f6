"""What can be wrong with a capture: one sentence that names it, whichever tool wrote it, and no memory spent on false counts."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from captures import facing, huge_png, ring, thing, write_colmap, write_llff, write_nerfstudio, write_ngp

from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.io.images import write_png

BOUNDS = np.tile([2.0, 9.0], (8, 1))
KINDS: dict[str, Callable[[Path], Path]] = {
    "ngp": lambda folder: write_ngp(folder, ring(8)),
    "nerfstudio": lambda folder: write_nerfstudio(folder, ring(8)),
    "llff": lambda folder: write_llff(folder, facing(8), BOUNDS),
    "colmap binary": lambda folder: write_colmap(folder, ring(8), *thing(20, 0), model="PINHOLE"),
    "colmap text": lambda folder: write_colmap(folder, ring(8), *thing(20, 0), model="PINHOLE", binary=False),
}


def table(change: Callable[[np.ndarray], np.ndarray | None]) -> Callable[[Path], None]:
    """An edit of LLFF's table."""

    def edit(folder: Path) -> None:
        old = np.load(folder / "poses_bounds.npy")
        new = change(old)
        np.save(folder / "poses_bounds.npy", old if new is None else new)

    return edit


def put(index: object, value: object) -> Callable[[Path], None]:
    return table(lambda rows: rows.__setitem__(index, value))


def frames(change: Callable[[dict], object]) -> Callable[[Path], None]:
    """An edit of transforms.json."""

    def edit(folder: Path) -> None:
        file = folder / "transforms.json"
        value = json.loads(file.read_text())
        change(value)
        file.write_text(json.dumps(value))

    return edit


def lines(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    """An edit of one of COLMAP's text files."""

    def edit(folder: Path) -> None:
        file = folder / "sparse" / "0" / name
        file.write_text(change(file.read_text()))

    return edit


def data(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """An edit of one of COLMAP's binary files."""

    def edit(folder: Path) -> None:
        file = folder / "sparse" / "0" / name
        file.write_bytes(change(file.read_bytes()))

    return edit


def delete(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def empty_images(folder: Path) -> None:
    shutil.rmtree(folder / "images")
    (folder / "images").mkdir()


def no_folder(folder: Path) -> None:
    shutil.rmtree(folder / "images")


def link_out(folder: Path) -> None:
    """An image that is a link to a picture elsewhere."""
    elsewhere = folder.parent / "secret.png"
    shutil.move(folder / "images" / "003.png", elsewhere)
    os.symlink(elsewhere, folder / "images" / "003.png")


def together(value: dict) -> None:
    for frame in value["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = 1.0


def loop(folder: Path) -> None:
    (folder / "images" / "003.png").unlink()
    os.symlink("003.png", folder / "images" / "003.png")


def huge(folder: Path) -> None:
    """A picture of 60 bytes that claims to be 30000 x 22500."""
    (folder / "images" / "003.png").write_bytes(huge_png(30000, 22500))


def half(folder: Path) -> None:
    """A picture whose second half was never copied."""
    noise = np.random.default_rng(0).integers(0, 256, (18, 24, 3), dtype=np.uint8)
    write_png(folder / "images" / "003.png", noise)
    os.truncate(folder / "images" / "003.png", 700)


def cut(folder: Path) -> None:
    (folder / "images" / "003.png").write_bytes(b"\x89PNG")


def one_image(folder: Path) -> None:
    for image in sorted((folder / "images").iterdir())[1:]:
        image.unlink()


def no_numbers(folder: Path) -> None:
    (folder / "poses_bounds.npy").write_bytes(pickle.dumps(os.getcwd))


def object_array(folder: Path) -> None:
    np.save(folder / "poses_bounds.npy", np.array([{}, print], object), allow_pickle=True)


def false_shape(folder: Path) -> None:
    """A header that promises 17 TB."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (125000000000, 17), }"
    header += b" " * (63 - (10 + len(header)) % 64) + b"\n"
    (folder / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)


def renamed(name: str) -> Callable[[bytes], bytes]:
    return lambda old: old.replace(b"003.png", name.encode())


NAN, FLAT = np.nan, np.diag([1.0, 0, 1, 1]).tolist()
MIRROR = np.diag([1.0, 1, -1, 1]).tolist()
JSON = ("ngp", "nerfstudio")
TEXT, BINARY, LLFF = ("colmap text",), ("colmap binary",), ("llff",)
CASES: list[tuple[str, tuple[str, ...], Callable[[Path], object], str]] = [
    ("a missing image", ("nerfstudio", *TEXT, *BINARY), delete("images/003.png"), r"003"),
    ("a missing image", LLFF, delete("images/003.png"), "8 poses.*7 images"),
    ("no image at all", tuple(KINDS), empty_images, "images|none exists|does not exist"),
    ("no folder of images", (*LLFF, *TEXT, *BINARY), no_folder, "no folder 'images'"),
    ("a link out of the folder", tuple(KINDS), link_out, "outside"),
    ("a link to itself", ("nerfstudio", *LLFF, *TEXT), loop, "003"),
    ("one image", ("ngp",), one_image, "1 image to train on"),
    ("one image", ("nerfstudio",), frames(lambda v: v.update(frames=v["frames"][:1])), "1 image to train on"),
    ("no frames", JSON, frames(lambda v: v.update(frames=[])), "no frames"),
    ("frames of another kind", JSON, frames(lambda v: v["frames"].__setitem__(2, 3)), "frame 2"),
    ("a path out of the folder", JSON, frames(lambda v: v["frames"][2].update(file_path="../../etc/passwd")), "outside"),
    ("an absolute path", JSON, frames(lambda v: v["frames"][2].update(file_path="/etc/passwd")), "outside"),
    ("a mask out of the folder", JSON, frames(lambda v: v["frames"][2].update(mask_path="../secret.png")), "outside"),
    ("a mask that is not there", JSON, frames(lambda v: v["frames"][2].update(mask_path="no.png")), "mask no.png"),
    ("points out of the folder", JSON, frames(lambda v: v.update(ply_file_path="../points.ply")), "outside"),
    ("a path with a zero byte", JSON, frames(lambda v: v["frames"][2].update(file_path="a\0b")), "no path"),
    ("a path without end", JSON, frames(lambda v: v["frames"][2].update(file_path="a" * 5000)), "no path|not exist"),
    ("a path that is none", JSON, frames(lambda v: v["frames"][2].update(file_path=["a"])), "file_path"),
    ("an unknown lens", JSON, frames(lambda v: [f.update(camera_model="EQUIRECTANGULAR") for f in v["frames"]]), "EQUIRECTANGULAR"),
    ("another unknown lens", JSON, frames(lambda v: v.update(latlong=True)), "latlong"),
    ("no focal length", JSON, frames(lambda v: [x.update(fl_x=0) for x in (v, *v["frames"])]), "focal"),
    ("a scale of nothing", ("ngp",), frames(lambda v: v.update(aabb_scale=0)), "aabb_scale"),
    ("a scale of words", ("ngp",), frames(lambda v: v.update(aabb_scale="big")), "aabb_scale"),
    ("a split of frames that are not", JSON, frames(lambda v: v.update(train_filenames=["images/x.png"])), "x.png"),
    ("a split that is no list", JSON, frames(lambda v: v.update(train_filenames=3)), "train_filenames"),
    ("cameras all in one place", JSON, frames(together), "one place"),
    ("not JSON", JSON, lambda folder: (folder / "transforms.json").write_text("{"), "valid JSON"),
    ("JSON without end", JSON, lambda folder: (folder / "transforms.json").write_text("[" * 100000), "valid JSON"),
    ("a pickle", LLFF, no_numbers, "array of numbers"),
    ("an array of objects", LLFF, object_array, "array of numbers"),
    ("a table of another width", LLFF, table(lambda rows: rows[:, :15]), "17"),
    ("a table of one row", LLFF, table(lambda rows: rows[0]), "17"),
    ("an empty table", LLFF, table(lambda rows: rows[:0]), "no poses"),
    ("a table of words", LLFF, table(lambda rows: rows.astype(str)), "17"),
    ("a table cut short", LLFF, lambda folder: os.truncate(folder / "poses_bounds.npy", 500), "array of numbers"),
    ("a table of false size", LLFF, false_shape, "array of numbers"),
    ("fewer poses", LLFF, table(lambda rows: rows[:-1]), "7 poses.*8 images"),
    ("a mirroring pose", LLFF, table(lambda rows: rows * np.where(np.arange(17) % 5 == 2, [-1], [1])), "mirrors"),
    ("an unknown lens", TEXT, lines("cameras.txt", lambda t: t.replace("PINHOLE", "FOV")), "FOV"),
    ("an unheard-of lens", TEXT, lines("cameras.txt", lambda t: t.replace("PINHOLE", "PERISCOPE")), "PERISCOPE"),
    ("too few parameters", TEXT, lines("cameras.txt", lambda t: t.replace("PINHOLE", "OPENCV")), "4 parameters.*8"),
    ("a lens of words", TEXT, lines("cameras.txt", lambda t: t.replace("26.0", "wide")), "damaged"),
    ("no cameras", TEXT, lines("cameras.txt", lambda t: ""), "camera 7"),
    ("no images in the model", TEXT, lines("images.txt", lambda t: "# none\n"), "no images"),
    ("an image line cut short", TEXT, lines("images.txt", lambda t: t + "9 1 0 0\n\n"), "pose"),
    ("a pose that is not finite", TEXT, lines("images.txt", lambda t: t.replace("\n8 ", "\n8 nan ")), "image|damaged"),
    ("a path out of the folder", TEXT, lines("images.txt", lambda t: t.replace("003.png", "../../x.png")), "outside"),
    ("an absolute path", TEXT, lines("images.txt", lambda t: t.replace("003.png", "/etc/passwd")), "outside"),
    ("points cut short", TEXT, lines("points3D.txt", lambda t: t + "7 1.0 2.0\n"), "damaged"),
    ("no images file", TEXT, delete("sparse/0/images.txt"), "images.txt"),
    ("an unknown lens", BINARY, data("cameras.bin", lambda b: b[:12] + struct.pack("<i", 10) + b[16:] + bytes(64)), "THIN_PRISM"),
    ("an unheard-of lens", BINARY, data("cameras.bin", lambda b: b[:12] + struct.pack("<i", 77) + b[16:]), "number 77"),
    ("an empty file", BINARY, data("cameras.bin", lambda b: b""), "damaged"),
    ("cameras cut short", BINARY, data("cameras.bin", lambda b: b[:-3]), "cameras.bin.*damaged"),
    ("images cut short", BINARY, data("images.bin", lambda b: b[:-3]), "images.bin.*damaged"),
    ("images cut in a name", BINARY, data("images.bin", lambda b: b[: b.index(b"007.png") + 4]), "images.bin.*damaged"),
    ("points cut short", BINARY, data("points3D.bin", lambda b: b[:-3]), "points3D.bin.*damaged"),
    ("too many cameras", BINARY, data("cameras.bin", lambda b: struct.pack("<Q", 2**61) + b[8:]), "records"),
    ("too many images", BINARY, data("images.bin", lambda b: struct.pack("<Q", 2**40) + b[8:]), "records"),
    ("too many points", BINARY, data("points3D.bin", lambda b: struct.pack("<Q", 2**63) + b[8:]), "records"),
    ("a track without end", BINARY, data("points3D.bin", lambda b: b[:51] + struct.pack("<Q", 2**62) + b[59:]), "records"),
    ("a path out of the folder", BINARY, data("images.bin", renamed("../../x")), "outside"),
    ("a name that is no text", BINARY, data("images.bin", lambda b: b.replace(b"003.png", b"\xff\xfe3.png")), "damaged"),
    ("no images file", BINARY, delete("sparse/0/images.bin"), "images.bin"),
]  # fmt: skip

ONE_VIEW: list[tuple[str, tuple[str, ...], Callable[[Path], object], str]] = [
    ("a picture that claims to be huge", tuple(KINDS), huge, "003.*(30000 x 22500|675000000)"),
    ("a picture cut short", tuple(KINDS), cut, "003"),
    ("no pose", JSON, frames(lambda v: v["frames"][2].pop("transform_matrix")), "frame 2.*transform_matrix"),
    ("a pose that is not finite", JSON, frames(lambda v: v["frames"][2]["transform_matrix"][0].__setitem__(3, NAN)), "frame 2|'002'"),
    ("a flat pose", JSON, frames(lambda v: v["frames"][2].update(transform_matrix=FLAT)), "'002'.*pose"),
    ("a mirroring pose", JSON, frames(lambda v: v["frames"][2].update(transform_matrix=MIRROR)), "'002'.*mirrors"),
    ("a lens that is not finite", JSON, frames(lambda v: v["frames"][2].update(k1=NAN)), "lens"),
    ("a lens of words", JSON, frames(lambda v: v["frames"][2].update(k1="strong")), "frame 2.*numbers"),
    ("a size of nothing", JSON, frames(lambda v: v["frames"][2].update(w=0)), "above 0"),
    ("a turned image", JSON, frames(lambda v: v["frames"][2].update(w=18, h=24)), "turned"),
    ("a pose that is not finite", LLFF, put((2, 3), NAN), "finite"),
    ("a flat pose", LLFF, put((2, [0, 5, 10]), 0.0), "'002'.*pose"),
    ("near beyond far", LLFF, put((2, 15), 99.0), "pose 2.*99"),
    ("a size of nothing", LLFF, put((2, 4), 0.0), "above 0"),
    ("no focal length", LLFF, put((2, 14), 0.0), "focal"),
    ("a pose of no length", BINARY, data("images.bin", lambda b: b[:12] + bytes(32) + b[44:]), "pose"),
    ("a pose that is not finite", BINARY, data("images.bin", lambda b: b[:12] + struct.pack("<d", NAN) + b[20:]), "pose"),
    ("a picture cut in half", tuple(KINDS), half, "003.*damaged|003.*truncated"),
    ("one unknown lens", JSON, frames(lambda v: v["frames"][2].update(camera_model="PERISCOPE")), "frame 2.*PERISCOPE"),
    ("no focal length", JSON, frames(lambda v: v["frames"][2].update(fl_x=0)), "'002'.*focal"),
]  # fmt: skip


@pytest.mark.hard_case(4, 5, 59, 61, 62)
@pytest.mark.parametrize(
    ("kind", "spoil", "says"), [pytest.param(k, edit, says, id=f"{k}: {name}") for name, kinds, edit, says in CASES for k in kinds]
)
def test_one_sentence_says_what_is_wrong(tmp_path, kind, spoil, says):
    folder = KINDS[kind](tmp_path / "capture")
    spoil(folder)
    before = sorted(p for p in tmp_path.rglob("*"))
    tracemalloc.start()
    try:
        with pytest.raises(SnergError, match=says) as error:
            read_dataset(folder, options=DatasetOptions(0))
        assert tracemalloc.get_traced_memory()[1] < 2**25
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value) and str(error.value)[-1] in ".;)'"
    assert sorted(p for p in tmp_path.rglob("*")) == before


@pytest.mark.hard_case(4, 5, 59, 61, 62)
@pytest.mark.parametrize(
    ("kind", "spoil", "says"), [pytest.param(k, edit, says, id=f"{k}: {name}") for name, kinds, edit, says in ONE_VIEW for k in kinds]
)
def test_one_view_that_cannot_be_used_is_left_out_and_named(tmp_path, kind, spoil, says):
    folder = KINDS[kind](tmp_path / "capture")
    spoil(folder)
    tracemalloc.start()
    try:
        dataset = read_dataset(folder, options=DatasetOptions(0))
        assert tracemalloc.get_traced_memory()[1] < 2**25
    finally:
        tracemalloc.stop()
    (note,) = dataset.remarks()
    assert len(dataset.views) == 7 and re.search(says, note) and note.endswith("left out.") and "\n" not in note
    assert dataset.bounds is None or len(dataset.bounds) == 7


def test_many_views_that_cannot_be_used(tmp_path):
    """A split may name them; the first are named, and the last picture says why there are too few."""
    folder = write_ngp(tmp_path / "capture", ring(20), train_filenames=[f"images/{i:03d}.png" for i in range(20)])
    for index in range(3, 20):
        (folder / "images" / f"{index:03d}.png").write_bytes(b"no picture")
    dataset = read_dataset(folder)
    assert [c.name for c in dataset.cameras] == ["000", "001", "002"] and dataset.skipped_frames == 0
    assert len(dataset.notes) == 9 and dataset.notes[-1].startswith("9 more images")
    for index in (1, 2):
        (folder / "images" / f"{index:03d}.png").write_bytes(b"no picture")
    with pytest.raises(SnergError, match=r"1 image to train on.*11 more images"):
        read_dataset(folder)
    (folder / "images" / "000.png").write_bytes(b"no picture")
    with pytest.raises(SnergError, match=r"000\.png cannot be read"):
        read_dataset(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_none_of_these_is_wrong(tmp_path, kind):
    assert len(read_dataset(KINDS[kind](tmp_path / "capture"), options=DatasetOptions(0)).views) == 8


def test_what_is_no_capture(tmp_path):
    for path, says in ((tmp_path / "none", "does not exist"), (tmp_path, "no dataset")):
        with pytest.raises(SnergError, match=says):
            read_dataset(path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(SnergError, match="no dataset"):
        read_dataset(tmp_path / "notes.txt")


@pytest.mark.hard_case(62)
def test_a_table_that_would_run_code_does_not(tmp_path):
    folder = KINDS["llff"](tmp_path / "capture")
    marker = tmp_path / "ran"

    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(marker),)

    for content in (pickle.dumps(Bomb()), None):
        if content is None:
            np.save(folder / "poses_bounds.npy", np.array([Bomb()], object), allow_pickle=True)
        else:
            (folder / "poses_bounds.npy").write_bytes(content)
        with pytest.raises(SnergError):
            read_dataset(folder)
    assert not marker.exists()
