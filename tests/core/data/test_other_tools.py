"""Captures as Polycam, Record3D, Metashape, RealityCapture and Gaussian splatting export them, read back; other tools are named."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import FISHEYE, moved, pictures, ring, similarity, thing, write_colmap

from snerg.core.artifact import kind_of
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.readers import record3d
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion
from snerg.core.io.images import write_png

ALL = DatasetOptions(0)
BROWN = Distortion("nerfstudio", (-0.1, 0.02, 0.003, -0.001, 0.001, -0.002))
OPENCV = np.diag([1.0, -1, -1, 1])  # from OpenGL's axes and back


def quaternion(turn: np.ndarray) -> list[float]:
    """(x, y, z, w) of a rotation [3, 3]."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    k = np.array([[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0], [h - f, c - g, d - b, a + e + i]]) / 3
    return np.linalg.eigh(k)[1][:, -1].tolist()


def write_polycam(folder: Path, cameras, corrected: bool = True) -> Path:
    suffix = "corrected_" if corrected else ""
    keyframes = folder / "keyframes"
    pictures(keyframes / f"{suffix}images", cameras)
    (keyframes / f"{suffix}cameras").mkdir(parents=True)
    for c in cameras:
        value = {f"t_{i}{j}": float(c.camera_to_world[i, j]) for i in range(3) for j in range(4)}
        value |= {"fx": c.focal[0], "fy": c.focal[1], "cx": c.centre[0], "cy": c.centre[1], "width": c.width, "height": c.height}
        (keyframes / f"{suffix}cameras" / f"{c.name}.json").write_text(json.dumps({**value, "blur_score": 90.0, "timestamp": 1}))
        write_png(keyframes / "depth" / f"{c.name}.png", np.full((9, 12), 200, np.uint8))
    return folder


def write_record3d(folder: Path, cameras, name: str = "metadata.json", rgb: str = "rgb") -> Path:
    cameras = [replace(c, name=str(index)) for index, c in enumerate(cameras)]
    pictures(folder / rgb, cameras)
    poses = [[*quaternion(c.camera_to_world[:3, :3]), *c.position.tolist()] for c in cameras]
    first = cameras[0]
    matrix = np.array([[first.focal[0], 0, first.centre[0]], [0, first.focal[1], first.centre[1]], [0, 0, 1]])
    value = {"poses": poses, "K": matrix.T.ravel().tolist(), "w": first.width, "h": first.height, "fps": 30}
    (folder / name).write_text(json.dumps(value))
    return folder


def metashape_lens(camera: Camera) -> str:
    """A calibration of Metashape: f with b1 for the difference, the centre from the middle, p1 and p2 exchanged."""
    values = {"f": camera.focal[1], "b1": camera.focal[0] - camera.focal[1]}
    values |= {"cx": camera.centre[0] - camera.width / 2, "cy": camera.centre[1] - camera.height / 2}
    if camera.distortion is not None:
        k1, k2, k3, k4, *rest = camera.distortion.coefficients
        values |= {"k1": k1, "k2": k2, "k3": k3, "k4": k4}
        values |= dict(zip(("p2", "p1"), rest, strict=True)) if rest else {}
    return "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items())


def write_metashape(folder: Path, cameras, kind: str = "frame", more: str = "") -> Path:
    pictures(folder / "images", cameras)
    size = f'<resolution width="{cameras[0].width}" height="{cameras[0].height}"/>'
    guess = '<calibration class="initial"><f>999</f></calibration>'
    found = f'<calibration type="{kind}" class="adjusted">{size}{metashape_lens(cameras[0])}</calibration>'
    sensor = f'<sensor id="3" label="a" type="{kind}">{size}{guess}{found}</sensor>'
    shots = [
        f'<camera id="{i}" sensor_id="3" component_id="0" label="{c.name}{".JPG" if i % 2 else ""}"><transform>'
        f"{' '.join(map(repr, (c.camera_to_world @ OPENCV).ravel().tolist()))}</transform></camera>"
        for i, c in enumerate(cameras)
    ]
    text = f'<?xml version="1.0" encoding="UTF-8"?><document version="1.5.0"><chunk label="Chunk 1"><sensors>{sensor}</sensors>'
    text += f"<cameras>{''.join(shots[:3])}<group>{''.join(shots[3:])}</group>{more}</cameras></chunk></document>"
    (folder / "cameras.xml").write_text(text)
    return folder


def angles(turn: np.ndarray) -> tuple[float, float, float]:
    """(heading, pitch, roll) in degrees of a rotation Rz(-heading) Rx(pitch) Ry(roll)."""
    pitch, heading, roll = math.asin(turn[2, 1]), math.atan2(turn[0, 1], turn[1, 1]), math.atan2(-turn[2, 0], turn[2, 2])
    return math.degrees(heading), math.degrees(pitch), math.degrees(roll)


def write_realitycapture(folder: Path, cameras, newer: bool = False) -> Path:
    pictures(folder / "images", cameras)
    names = ("yaw", "f_35mm", "px_norm", "py_norm") if newer else ("heading", "f", "px", "py")
    lines = ["#name,x,y,alt,{},pitch,roll,{},{},{},k1,k2,k3,k4,t1,t2".format(*names)]
    for c in cameras:
        long = max(c.width, c.height)
        k = c.distortion.coefficients if c.distortion else (0.0,) * 6
        lens = [c.focal[0] / long * 36, (c.centre[0] - c.width / 2) / long, (c.centre[1] - c.height / 2) / long, *k[:4], k[5], k[4]]
        lines.append(f"{c.name}.jpg," + ",".join(repr(float(v)) for v in (*c.position, *angles(c.camera_to_world[:3, :3]), *lens)))
    (folder / "registration.csv").write_text(("#cameras 9\n" if newer else "") + "\n".join(lines) + "\n", encoding="utf-8-sig")
    return folder


def write_sidecars(folder: Path, cameras, model: str = "brown4t2") -> Path:
    pictures(folder, cameras)
    for c in cameras:
        long = max(c.width, c.height)
        k = c.distortion.coefficients if c.distortion else (0.0,) * 6
        turn = (c.camera_to_world @ OPENCV)[:3, :3].T
        (folder / f"{c.name}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
            f'xcr:Version="3" xcr:DistortionModel="{model}" xcr:FocalLength35mm="{c.focal[0] / long * 36!r}" xcr:AspectRatio="1" '
            f'xcr:PrincipalPointU="{(c.centre[0] - c.width / 2) / long!r}" xcr:PrincipalPointV="{(c.centre[1] - c.height / 2) / long!r}" '
            'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">'
            f"<xcr:Rotation>{' '.join(map(repr, turn.ravel().tolist()))}</xcr:Rotation>"
            f"<xcr:Position>{' '.join(map(repr, c.position.tolist()))}</xcr:Position>"
            f"<xcr:DistortionCoeficients>{' '.join(map(repr, (*k[:4], k[5], k[4])))}</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    return folder


def write_splats(folder: Path, cameras) -> Path:
    pictures(folder / "images", cameras)
    value = [
        {"id": i, "img_name": c.name, "width": c.width, "height": c.height, "fx": c.focal[0], "fy": c.focal[1]}
        | {"position": c.position.tolist(), "rotation": (c.camera_to_world @ OPENCV)[:3, :3].tolist()}
        for i, c in enumerate(cameras)
    ]
    (folder / "cameras.json").write_text(json.dumps(value))
    return folder


def write_bundler(folder: Path, cameras) -> Path:
    """As RealityCapture does: one photograph was not registered, and each line of the list has a focal length from EXIF."""
    pictures(folder / "images", [*cameras, replace(cameras[0], name="zzz")])
    lines = ["# Bundle file v0.3", f"{len(cameras) + 1} 12"]
    for c in cameras:
        turn = c.camera_to_world[:3, :3].T
        k1, k2 = c.distortion.coefficients[:2] if c.distortion else (0.0, 0.0)
        lines += [f"{c.focal[0]!r} {k1!r} {k2!r}", *(" ".join(map(repr, row)) for row in turn.tolist())]
        lines.append(" ".join(map(repr, (-turn @ c.position).tolist())))
    lines += ["0 0 0", *["0 0 0"] * 4]
    for i in range(12):
        lines += [f"{i * 0.1} 0.5 0.25", "255 128 0", "2 0 17 1.5 -2.5 1 3 4.5 6.5"]
    (folder / "bundler").mkdir()
    (folder / "bundler" / "bundle.out").write_text("\n".join(lines))
    (folder / "bundler" / "list.txt").write_text("\n".join([f"C:\\scan\\{c.name}.JPG 0 26.0" for c in cameras] + ["zzz.JPG"]) + "\n")
    return folder


SQUARE = [replace(c, focal=(26.0, 26.0)) for c in ring(8)]  # square pixels, which RealityCapture assumes
BENT = [replace(c, distortion=BROWN) for c in SQUARE]
TOOLS = {
    "polycam": (write_polycam, ring(8)),
    "record3d": (write_record3d, ring(8)),
    "record3d, unpacked": (lambda folder, cameras: write_record3d(folder, cameras, "metadata", "rgbd"), ring(8)),
    "record3d, EXR_RGBD": (lambda folder, cameras: write_record3d(folder / "EXR_RGBD", cameras).parent, ring(8)),
    "metashape": (write_metashape, ring(8, BROWN)),
    "metashape, fisheye": (lambda folder, cameras: write_metashape(folder, cameras, "fisheye"), ring(8, FISHEYE)),
    "realitycapture": (write_realitycapture, BENT),
    "realitycapture, newer": (lambda folder, cameras: write_realitycapture(folder, cameras, True), BENT),
    "realitycapture, xmp": (write_sidecars, BENT),
    "bundler": (write_bundler, [replace(c, centre=(12, 9), distortion=Distortion("opencv", (-0.1, 0.02))) for c in SQUARE]),
    "splats": (write_splats, [replace(c, centre=(12, 9)) for c in ring(8)]),
}  # fmt: skip


@pytest.mark.parametrize("tool", TOOLS)
def test_cameras_come_back(tmp_path, tool):
    """The rays of every pixel are those of the cameras that were written, in a world moved by a similarity."""
    write, cameras = TOOLS[tool]
    by = similarity(9)
    written = moved(cameras, by)
    folder = write(tmp_path / "capture", written)
    dataset = read_dataset(folder, options=ALL)
    assert kind_of(folder) == "dataset" and dataset.kind == tool.partition(",")[0]
    assert not dataset.remarks() or (tool == "bundler" and "1 of the 9" in dataset.remarks()[0] and len(dataset.points) == 12)
    for index, (found, camera) in enumerate(zip(dataset.cameras, moved(written, dataset.source_to_world), strict=True)):
        assert np.allclose(found.position, camera.position, atol=1e-6) and dataset.read(index)[0, 0, 0] == index * 9 + 10
        assert np.allclose(found.rays()[1], camera.rays()[1], atol=1e-6)


@pytest.mark.parametrize("tool", TOOLS)
def test_pictures_that_are_not_there_are_counted_and_damaged_ones_named(tmp_path, tool):
    write, cameras = TOOLS[tool]
    folder = write(tmp_path / "capture", cameras)
    images = sorted(p for p in folder.rglob("*.png") if "depth" not in str(p))
    images[5].write_bytes(images[5].read_bytes()[:60])
    if "record3d" not in tool:
        images[2].unlink()
    dataset = read_dataset(folder, options=ALL)
    assert len(dataset.views) == (7 if "record3d" in tool else 6) and any(images[5].name in note for note in dataset.remarks())
    assert dataset.skipped_frames == (0 if "record3d" in tool else 1)
    for image in images:
        image.unlink(missing_ok=True)
    with pytest.raises(SnergError, match=r"images|none|no pose|there"):
        read_dataset(folder, options=ALL)


def test_polycam_as_the_phone_tracked_it(tmp_path):
    folder = write_polycam(tmp_path / "capture", ring(8), corrected=False)
    (folder / "keyframes" / "cameras" / "003.json").write_text("{")
    dataset = read_dataset(folder / "keyframes", options=ALL)
    assert len(dataset.views) == 7 and "drift" in dataset.notes[0] and "003.json" in dataset.notes[1]


def test_depth_of_polycam_in_millimetres(tmp_path):
    from PIL import Image

    folder = write_polycam(tmp_path / "capture", ring(8))
    for file in (folder / "keyframes" / "depth").iterdir():
        Image.fromarray(np.full((9, 12), 4000, np.uint16)).save(file)
    dataset = read_dataset(folder, options=ALL)
    assert np.allclose(dataset.depth(0), 4 * dataset.scale)


def test_a_long_recording_is_thinned_and_said(tmp_path, monkeypatch):
    monkeypatch.setattr(record3d, "MOST_FRAMES", 5)
    folder = write_record3d(tmp_path / "capture", ring(12))
    value = json.loads((folder / "metadata.json").read_text())
    value["perFrameIntrinsicCoeffs"] = [[20.0 + i, 21, 12, 9] for i in range(12)]
    (folder / "metadata.json").write_text(json.dumps(value))
    dataset = read_dataset(folder, options=ALL)
    assert [c.name for c in dataset.cameras] == ["0", "3", "6", "8", "11"] and "5 of the 12" in dataset.notes[0]
    assert dataset.cameras[1].focal[0] == 23  # the intrinsics of its own frame, numbered and not sorted as text
    (folder / "rgb" / "4.png").unlink()
    again = read_dataset(folder, options=ALL)
    assert [c.focal[0] - 20 for c in again.cameras] == [float(c.name) for c in again.cameras] and "numbers" in again.notes[0]


def test_metashape_leaves_out_what_is_not_aligned(tmp_path):
    more = (
        '<camera id="20" sensor_id="3" label="x"/><camera id="21" sensor_id="3" label="y" enabled="false"><transform>1</transform></camera>'
    )
    more += '<camera id="22" sensor_id="3" component_id="1" label="z"><transform>1</transform></camera>'
    folder = write_metashape(tmp_path / "capture", ring(8), more=more)
    notes = read_dataset(folder / "cameras.xml", options=ALL).notes
    assert "2 of the 11" in notes[0] and "1 cameras" in notes[1]
    text = (folder / "cameras.xml").read_text()
    (folder / "cameras.xml").write_text(text.replace("<f>27.0</f>", "<f>27.0</f><b2>4.5</b2>"))
    assert any("B2" in note for note in read_dataset(folder, options=ALL).notes)
    (folder / "cameras.xml").write_text(text.replace("<f>27.0</f>", "<f>27.0</f><p3>0.1</p3>"))
    with pytest.raises(SnergError, match="P3"):
        read_dataset(folder, options=ALL)
    (folder / "cameras.xml").write_text(text.replace("<document", '<!DOCTYPE d [<!ENTITY a "b">]><document'))
    with pytest.raises(SnergError, match="entities"):
        read_dataset(folder, options=ALL)


def test_numbers_that_are_not_finite_leave_out_one_camera(tmp_path):
    folder = write_metashape(tmp_path / "a", ring(8))
    text = (folder / "cameras.xml").read_text()
    start = text.index("<transform>", text.index('label="003')) + len("<transform>")
    (folder / "cameras.xml").write_text(text[:start] + "nan " + text[text.index(" ", start) :])
    assert "camera 003" in read_dataset(folder, options=ALL).notes[0]
    (folder / "cameras.xml").write_text(text.replace("<f>27.0</f>", "<f>inf</f>"))
    with pytest.raises(SnergError, match=r"its f is not finite"):
        read_dataset(folder, options=ALL)
    folder = write_realitycapture(tmp_path / "b", SQUARE)
    table = folder / "registration.csv"
    table.write_text(table.read_text("utf-8-sig").replace("\n002.jpg,", "\n002.jpg,nan,1,1,0,0,0,20\nzzz.jpg,", 1))
    dataset = read_dataset(folder, options=ALL)
    assert "002.jpg" in dataset.notes[0] and dataset.skipped_frames == 1


def test_realitycapture_without_what_is_needed(tmp_path):
    folder = write_realitycapture(tmp_path / "a", SQUARE)
    (folder / "registration.csv").write_text("#name,x,y,z\n000.jpg,1,2,3\n")
    with pytest.raises(SnergError, match=r"no column alt.*Internal/External"):
        read_dataset(folder, options=ALL)
    folder = write_sidecars(tmp_path / "b", BENT, "division")
    with pytest.raises(SnergError, match=r"division.*Brown3"):
        read_dataset(folder, options=ALL)
    folder = write_sidecars(tmp_path / "c", SQUARE, "division")
    os.remove(folder / "004.xmp")
    assert "1 photographs" in read_dataset(folder, options=ALL).notes[0]


def test_splats_bring_their_points(tmp_path):
    folder = write_splats(tmp_path / "capture", ring(8))
    body = "".join(f"{x} 0 1\n" for x in range(12))
    header = "ply\nformat ascii 1.0\nelement vertex 12\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (folder / "input.ply").write_text(header + body)
    assert len(read_dataset(folder / "cameras.json", options=ALL).points) == 12
    write_colmap(folder, ring(8), *thing(20, 0), model="PINHOLE")  # a result in its capture's folder
    assert read_dataset(folder, options=ALL).kind == "colmap" and read_dataset(folder / "cameras.json", options=ALL).kind == "splats"
    shutil.rmtree(folder / "sparse")
    shutil.rmtree(folder / "images")
    with pytest.raises(SnergError, match="without photographs"):
        read_dataset(folder / "cameras.json", options=ALL)
    (folder / "point_cloud" / "iteration_7000").mkdir(parents=True)
    with pytest.raises(SnergError, match=r"splatting.*trained on"):
        read_dataset(folder, options=ALL)


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("a.rcproj", "RealityCapture.*Internal/External"),
        ("a.psx", "Metashape.*XML"),
        ("sfm_data.json", "OpenMVG.*openMVG2Colmap"),
        ("cameras.sfm", "Meshroom.*ExportColmap"),
        ("a.nvm", "VisualSFM.*Bundler"),
        ("a.p4d", "Pix4D"),
        ("a.r3d", "Record3D|archive"),
    ],
)
def test_the_files_of_other_tools_are_refused_by_name(tmp_path, file, says):
    (tmp_path / file).write_text('{"sfm_data_version": "0.3"}')
    for path in (tmp_path, tmp_path / file):
        with pytest.raises(SnergError, match=says):
            read_dataset(path)


def test_results_and_videos_are_refused(tmp_path):
    for name, says in (("a.usdz", "without photographs"), ("a.ply", "without photographs"), ("a.splat", "made from"), ("a.mp4", "frames")):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(SnergError, match=says):
            read_dataset(tmp_path / name)
    (tmp_path / "r.json").write_text('[{"cameras": {}, "shots": {}}]')
    (tmp_path / "m.json").write_text('{"views": [], "intrinsics": [], "poses": []}')
    for name, says in (("r.json", "OpenSfM"), ("m.json", "Meshroom")):
        with pytest.raises(SnergError, match=says):
            read_dataset(tmp_path / name)


def test_bundlers_list_and_counts_must_fit(tmp_path):
    folder = write_bundler(tmp_path / "capture", SQUARE)
    model, text = folder / "bundler" / "bundle.out", (folder / "bundler" / "bundle.out").read_text()
    assert len(read_dataset(model, options=ALL).views) == 8  # the model itself, whose pictures lie a folder higher
    for bad in (text[:300], text.replace("9 12", "900000000 12"), text.replace("9 12", "9 x")):
        model.write_text(bad)
        with pytest.raises(SnergError, match=r"bundle\.out.*export it again"):
            read_dataset(folder, options=ALL)
    model.write_text(text)
    (folder / "bundler" / "list.txt").write_text("a.jpg\n")
    with pytest.raises(SnergError, match=r"9 cameras.*list\.txt"):
        read_dataset(folder, options=ALL)


@pytest.mark.parametrize("mask", ["masks/000_mask.png", "000_mask.png", "masks/000.png"])
def test_masks_of_metashape(tmp_path, mask):
    write_metashape(tmp_path, ring(4))
    folder = next(tmp_path.rglob("000.png")).parent
    write_png((tmp_path if "/" in mask else folder) / mask, np.zeros((18, 24), np.uint8))
    dataset = read_dataset(tmp_path, options=ALL)
    assert not dataset.mask(0).any() and len(dataset.views) == 4 and not dataset.remarks()
