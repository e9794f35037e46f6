"""Small captures written as other tools write them: cameras round a known object, in a world turned, moved and scaled at random."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes import looking, rotation
from snerg.core.data.readers.transforms_camera import intrinsics_json
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion
from snerg.core.io.images import write_png

LENS = Distortion("opencv", (-0.1, 0.02, 0.001, -0.002))
FISHEYE = Distortion("fisheye", (0.02, -0.01, 0.001, 0.0))
SIZE = (24, 18)


def similarity(seed: int = 3) -> np.ndarray:
    """[4, 4]: a turn, a size and a place as structure from motion leaves them."""
    draw = np.random.default_rng(seed)
    result = np.eye(4)
    result[:3, :3] = rotation(tuple(draw.uniform(-3, 3, 3))) * draw.uniform(0.2, 5)
    result[:3, 3] = draw.uniform(-20, 20, 3)
    return result


def ring(count: int = 12, lens: Distortion | None = None, arc: float = 2 * np.pi, elevation: float = 0.5) -> tuple[Camera, ...]:
    """Upright cameras 4 away from the origin, which look down at it, round z."""
    cameras = []
    for index, around in enumerate(np.linspace(0, arc, count, endpoint=False)):
        up = elevation + 0.2 * np.sin(3 * around)
        eye = 4 * np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        pose = looking(tuple(eye), (0, 0, 0))
        cameras.append(Camera(*SIZE, (26.0, 27.0), (12.5, 8.8), pose, name=f"{index:03d}", distortion=lens))
    return tuple(cameras)


def facing(count: int = 8) -> tuple[Camera, ...]:
    """Upright cameras side by side that look along +y."""
    draw = np.random.default_rng(0)
    places = draw.uniform(-0.5, 0.5, (count, 3)) * [1, 0.1, 0.6] - [0, 4, 0]
    poses = [looking(tuple(p), tuple(p + np.array([0, 5, 0]))) for p in places]
    return tuple(Camera(*SIZE, (26.0, 26.0), (12, 9), pose, name=f"{i:03d}") for i, pose in enumerate(poses))


def thing(count: int = 300, outliers: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] of a box of 2 x 1 x 1.5 that stands on z = -0.75, a few of them astray, and colours [N, 3]."""
    draw = np.random.default_rng(1)
    points = draw.uniform(-1, 1, (count, 3)) * [1, 0.5, 0.75]
    points[:outliers] *= 1000
    return points, draw.integers(0, 256, (count, 3)).astype(np.uint8)


def moved(cameras: Sequence[Camera], by: np.ndarray) -> tuple[Camera, ...]:
    return tuple(c.moved(by) for c in cameras)


def apply(by: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ by[:3, :3].T + by[:3, 3]


def pictures(folder: Path, cameras: Sequence[Camera], shrink: int = 1) -> None:
    """A picture a camera, each of one colour of its own."""
    for index, camera in enumerate(cameras):
        pixels = np.full((camera.height // shrink, camera.width // shrink, 3), index * 9 + 10, np.uint8)
        write_png(folder / f"{camera.name}.png", pixels)


def huge_png(width: int, height: int) -> bytes:
    """A PNG of some 70 bytes whose header claims `width` x `height` pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 64)) + chunk(b"IEND", b"")


def write_ngp(folder: Path, cameras: Sequence[Camera], suffix: str = ".png", **top: object) -> Path:
    """As instant-ngp's colmap2nerf does: one set of intrinsics for all."""
    pictures(folder / "images", cameras)
    frames = [{"file_path": f"images/{c.name}{suffix}", "sharpness": 30.0, "transform_matrix": c.camera_to_world.tolist()} for c in cameras]
    shared = {"camera_angle_x": 0.7, **intrinsics_json(cameras[0]), "aabb_scale": 2}
    if cameras[0].distortion and cameras[0].distortion.model == "fisheye":
        shared |= {"is_fisheye": True}
    shared.pop("camera_model", None)
    (folder / "transforms.json").write_text(json.dumps({**shared, **top, "frames": frames}))
    return folder


def write_nerfstudio(folder: Path, cameras: Sequence[Camera], **top: object) -> Path:
    """As nerfstudio's ns-process-data does, intrinsics a frame."""
    pictures(folder / "images", cameras)
    frames = [
        {"file_path": f"./images/{c.name}.png", "transform_matrix": c.camera_to_world.tolist(), **intrinsics_json(c)} for c in cameras
    ]
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **top, "frames": frames}))
    return folder


def write_llff(folder: Path, cameras: Sequence[Camera], bounds: np.ndarray, shrink: int = 1) -> Path:
    """As LLFF's imgs2poses does: columns down, right, back; sizes and focal length of the full picture."""
    rows = []
    for camera, bound in zip(cameras, bounds, strict=True):
        right, up, back, place = camera.camera_to_world[:3].T
        rows.append(
            np.concatenate([np.stack([-up, right, back, place, [camera.height, camera.width, camera.focal[0]]], -1).ravel(), bound])
        )
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "poses_bounds.npy", np.array(rows))
    pictures(folder / ("images" if shrink == 1 else f"images_{shrink}"), cameras, shrink)
    return folder


MODELS = {
    "SIMPLE_PINHOLE": (0, lambda c: [c.focal[0], *c.centre]),
    "PINHOLE": (1, lambda c: [*c.focal, *c.centre]),
    "SIMPLE_RADIAL": (2, lambda c: [c.focal[0], *c.centre, c.distortion.coefficients[0]]),
    "RADIAL": (3, lambda c: [c.focal[0], *c.centre, *c.distortion.coefficients[:2]]),
    "OPENCV": (4, lambda c: [*c.focal, *c.centre, *c.distortion.coefficients[:4]]),
    "OPENCV_FISHEYE": (5, lambda c: [*c.focal, *c.centre, *c.distortion.coefficients]),
    "FULL_OPENCV": (6, lambda c: [*c.focal, *c.centre, *c.distortion.coefficients]),
    "SIMPLE_RADIAL_FISHEYE": (8, lambda c: [c.focal[0], *c.centre, c.distortion.coefficients[0]]),
    "RADIAL_FISHEYE": (9, lambda c: [c.focal[0], *c.centre, *c.distortion.coefficients[:2]]),
}


def colmap_cameras(model: str, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras as far as a model of COLMAP's can tell of them."""
    bent = FISHEYE if "FISHEYE" in model else Distortion("opencv", (*LENS.coefficients[:4], 0.01, 0.02, -0.01, 0.005))
    keep = {
        "SIMPLE_PINHOLE": 0,
        "PINHOLE": 0,
        "SIMPLE_RADIAL": 1,
        "RADIAL": 2,
        "SIMPLE_RADIAL_FISHEYE": 1,
        "RADIAL_FISHEYE": 2,
        "OPENCV": 4,
    }
    lens = Distortion(bent.model, bent.coefficients[: keep.get(model, 8)]) if "PINHOLE" not in model else None
    both = model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
    return tuple(replace(c, distortion=lens, focal=c.focal if both else (c.focal[0],) * 2) for c in cameras)


def write_colmap(
    folder: Path,
    cameras: Sequence[Camera],
    points: np.ndarray,
    colours: np.ndarray,
    model: str = "OPENCV",
    binary: bool = True,
    shrink: int = 1,
) -> Path:
    """As COLMAP's mapper does: one camera for all images, every point seen by every image, images not in the order of names."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    pictures(folder / ("images" if shrink == 1 else f"images_{shrink}"), cameras, shrink)
    number, parameters = MODELS[model]
    values = [float(v) for v in parameters(cameras[0])]
    shots = [(i + 1, *_pose(c), 7, f"{c.name}.png") for i, c in reversed(list(enumerate(cameras)))]
    seen = [(1.0, 2.0, i + 1) for i in range(len(points))] + [(3.0, 4.0, -1)]
    if binary:
        (sparse / "cameras.bin").write_bytes(struct.pack(f"<QIiQQ{len(values)}d", 1, 7, number, *SIZE, *values))
        tracks = struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddq", *s) for s in seen)
        images = b"".join(struct.pack("<I7dI", *s[:9]) + s[9].encode() + b"\0" + tracks for s in shots)
        (sparse / "images.bin").write_bytes(struct.pack("<Q", len(shots)) + images)
        rows = [
            struct.pack("<Q3d3BdQII", i + 1, *p, *c, 0.5, 1, 1, 0) for i, (p, c) in enumerate(zip(points, colours.tolist(), strict=True))
        ]
        (sparse / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        return folder
    (sparse / "cameras.txt").write_text(f"# Camera list\n7 {model} {SIZE[0]} {SIZE[1]} {' '.join(map(repr, values))}\n")
    tracks_line = " ".join(f"{x} {y} {i}" for x, y, i in seen)
    lines = [f"{' '.join(str(float(v)) if 0 < k < 8 else str(v) for k, v in enumerate(s))}\n{tracks_line}\n" for s in shots]
    (sparse / "images.txt").write_text("# Image list\n" + "".join(lines))
    rows_text = [
        f"{i + 1} {' '.join(str(float(v)) for v in p)} {c[0]} {c[1]} {c[2]} 0.5 1 0\n"
        for i, (p, c) in enumerate(zip(points, colours.tolist(), strict=True))
    ]
    (sparse / "points3D.txt").write_text("# 3D point list\n" + "".join(rows_text))
    return folder


def _pose(camera: Camera) -> list[float]:
    """Quaternion (w, x, y, z) and translation of the world in OpenCV's camera axes."""
    turn = (camera.camera_to_world[:3, :3] * [1, -1, -1]).T
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000) needs no cases.
    (a, b, c), (d, e, f), (g, h, i) = turn
    k = np.array([[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0], [h - f, c - g, d - b, a + e + i]]) / 3
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return [float(v) for v in (w, x, y, z, *(-turn @ camera.position))]
