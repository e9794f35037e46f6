"""Baked scenes made by arithmetic, and cameras around them: small, with everything that goes wrong in a big one.

Colours name directions (more red towards +x, green towards +y, blue towards +z, in the box's axes), so that a
mirrored or turned picture shows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.ndc import Ndc
from snerg.core.io.images import to_uint8, write_png
from snerg.core.nerf.model import SHAPES, ViewNetwork, with_frequencies
from snerg.core.rendering.render import render_scene
from snerg.core.scene.blocks import CELL_VOXELS, DATA_VOXELS
from snerg.core.scene.scene import Scene, blocks_of


def rotation(angles: tuple[float, float, float]) -> np.ndarray:
    """[3, 3] turn by radians about x, then y, then z."""
    result = np.eye(3)
    for axis, angle in enumerate(angles):
        turn = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn[[a, a, b, b], [a, b, a, b]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        result = turn @ result
    return result


def random_network(seed: int = 0) -> ViewNetwork:
    """Weights that give residuals spread over (0, 1), different in every direction."""
    draw = np.random.default_rng(seed)
    arrays = [draw.normal(0, 1.5 / np.sqrt(shape[0]), shape) if len(shape) == 2 else draw.normal(0, 0.3, shape) for shape in SHAPES]
    arrays[4] *= 0.7
    arrays[5] = arrays[5] - 1.5
    return ViewNetwork(*(a.astype(np.float32) for a in arrays))


def two_frequencies(network: ViewNetwork) -> ViewNetwork:
    """The network of a training that uses two of the four frequencies of the direction's encoding, as most do; one more weight is 0."""
    first, *rest = with_frequencies({"view": tuple(network)}, 2)["view"]
    first[0, 0] = 0
    return ViewNetwork(first, *rest)


def volume(shape: tuple[int, int, int], fog: bool = True) -> np.ndarray:
    """[X, Y, Z, 8] uint8, premultiplied: a ball with a window in it, thin sheet, rods and fog of alpha 1 to 3 of 255."""
    size = np.array(shape)
    point = (np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in shape), indexing="ij"), axis=-1) - size / 2) / size.min()
    x, y, z = np.moveaxis(point, -1, 0)
    alpha = np.zeros(shape)
    ball = np.linalg.norm(point, axis=-1)
    alpha[(ball < 0.33) & (ball > 0.27)] = 0.9
    alpha[(ball < 0.33) & (np.abs(x - 0.05) < 0.1) & (np.abs(z - 0.1) < 0.08)] = 0  # a window right through it
    alpha[(np.abs(y - 0.42) < 0.6 / size.min()) & (np.abs(x) < 0.3)] = 0.6  # a sheet one voxel thick
    alpha[(np.hypot(x - 0.4, y + 0.1) < 0.03)] = 1.0  # a rod up z, on the +x side
    alpha[(z < -0.5 * size[2] / size.min() + 2.1 / size.min())] = 0.8  # a floor on the lowest face
    colour = np.clip(0.5 + 0.9 * point, 0, 1)
    colour *= np.where((np.floor(8 * (x + 2)) + np.floor(8 * (z + 2))) % 2 > 0, 1.0, 0.55)[..., None]  # checks, not round ones
    features = 0.5 + 0.5 * np.sin(point @ np.array([[7.0, 1, 3, 5], [2, 9, 4, 1], [5, 3, 8, 2]]))
    values = np.concatenate([colour * alpha[..., None], features * alpha[..., None], alpha[..., None]], axis=-1)
    result = np.rint(values * 255).astype(np.uint8)
    if fog:
        thin = (result[..., 7] == 0) & (np.abs(z + 0.15) < 0.12)
        draw = np.random.default_rng(1)
        level = draw.integers(1, 4, shape)
        result[thin, 7] = level[thin]
        result[thin, :7] = draw.integers(0, 256, (*shape, 7))[thin] % (level[thin] + 1)[:, None]
    return result


def snerg_from_volume(values: np.ndarray, network: ViewNetwork | None, **settings: object) -> Scene:
    """Cut [X, Y, Z, C] uint8 into cells; a block has one where its 32^3 voxels, apron included, hold anything."""
    shape = values.shape[:3]
    blocks = blocks_of(shape)
    padded = np.zeros((*(b * DATA_VOXELS + 2 for b in blocks), values.shape[-1]), np.uint8)
    padded[1 : shape[0] + 1, 1 : shape[1] + 1, 1 : shape[2] + 1] = values
    indirection = np.full(blocks, -1, np.int32)
    cells = []
    for block in np.ndindex(*blocks):
        x, y, z = (b * DATA_VOXELS for b in block)
        cell = padded[x : x + CELL_VOXELS, y : y + CELL_VOXELS, z : z + CELL_VOXELS]
        if cell.any():
            indirection[block] = len(cells)
            cells.append(cell)
    stacked = np.stack(cells) if cells else np.zeros((0, *(CELL_VOXELS,) * 3, values.shape[-1]), np.uint8)
    return Scene(shape=shape, indirection=indirection, cells=stacked, network=network, **settings)  # type: ignore[arg-type]


def make_snerg(
    shape: tuple[int, int, int] = (74, 65, 95),
    diffuse: bool = False,
    fog: bool = True,
    angles: tuple[float, float, float] = (0, 0, 0),
    centre: tuple[float, float, float] = (0, 0, 0),
    size: float = 2.0,
    near: float = 0.0,
    ndc: Ndc | None = None,
    opacity_correction: bool = False,
) -> Scene:
    """The scene of `volume` in a box turned by `angles`, around `centre`, `size` world units along its shortest axis."""
    values = volume(shape, fog)
    voxel_size = size / min(shape)
    pose = np.eye(4)
    pose[:3, :3] = rotation(angles)
    pose[:3, 3] = np.array(centre) - pose[:3, :3] @ (np.array(shape) * voxel_size / 2)
    return snerg_from_volume(
        values[..., [0, 1, 2, 7]] if diffuse else values,
        None if diffuse else random_network(),
        grid_to_world=pose,
        voxel_size=voxel_size,
        view_rotation=rotation((0.3, -0.2, 0.9)),
        near=near,
        about={"source": "tests"},
        ndc=ndc,
        opacity_correction=opacity_correction,
    )


def make_roots(shape: tuple[int, int, int] = (74, 65, 95), **settings: object) -> Scene:
    """`make_snerg` in fog of alpha 2e-5 to 6e-3 that fills the rest of the box, stored as square roots."""
    scene = make_snerg(shape, fog=False, **settings)  # type: ignore[arg-type]
    values = np.rint(np.sqrt(255.0 * volume(shape, fog=False))).astype(np.uint8)
    if scene.network is None:
        values = values[..., [0, 1, 2, 7]]
    thin = values[..., -1] == 0
    draw = np.random.default_rng(2)
    level = draw.integers(1, 21, shape)
    values[thin] = draw.integers(0, 256, values.shape)[thin] % (level[thin] + 1)[:, None]
    values[thin, -1] = level[thin]
    rest = {
        name: getattr(scene, name)
        for name in ("grid_to_world", "voxel_size", "view_rotation", "near", "about", "ndc", "opacity_correction")
    }
    return snerg_from_volume(values, scene.network, square_roots=True, **rest)


def empty_snerg(shape: tuple[int, int, int] = (40, 30, 20)) -> Scene:
    """A scene with nothing in it (hard case 57)."""
    pose = np.eye(4)
    return snerg_from_volume(np.zeros((*shape, 4), np.uint8), None, grid_to_world=pose, voxel_size=0.05)


def random_scene(draw: np.random.Generator, diffuse: bool, opacity_correction: bool, above: bool) -> Scene:
    """Fog, clumps and holes; colours above their opacity where asked for."""
    shape = tuple(int(n) for n in draw.integers(20, 50, 3))
    alpha = draw.integers(0, 256, shape) * (draw.random(shape) < draw.choice([0.03, 0.3, 1.0])) * draw.choice([0.1, 1.0])
    alpha = np.floor(alpha)  # a voxel without opacity has no colour either
    values = np.rint(draw.random((*shape, 8)) * alpha[..., None]).astype(np.uint8)
    values[..., 7] = alpha
    if above:
        values[..., :7] = np.where(alpha[..., None] > 0, np.minimum(values[..., :7] + draw.integers(0, 2, (*shape, 7)), 255), 0)
    pose = np.eye(4)
    pose[:3, :3] = rotation(tuple(draw.normal(0, 1, 3)))
    pose[:3, 3] = -pose[:3, :3] @ (np.array(shape) / 2) / 25
    network = None if diffuse else random_network(int(draw.integers(1000)))
    values = values[..., [0, 1, 2, 7]] if diffuse else values
    return snerg_from_volume(values, network, grid_to_world=pose, voxel_size=1 / 25, opacity_correction=opacity_correction)


def looking(eye: tuple[float, float, float], target: tuple[float, float, float], roll: float = 0.0) -> np.ndarray:
    """[4, 4] camera-to-world at `eye`, looking at `target`, z up, turned by `roll` radians about its axis."""
    back = np.subtract(eye, target).astype(np.float64)
    back /= np.linalg.norm(back)
    up = np.array([0.0, 0, 1]) if abs(back[2]) < 0.999 else np.array([0.0, 1, 0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=-1) @ rotation((0, 0, roll))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, eye
    return pose


def make_cameras(
    centre: tuple[float, float, float] = (0, 0, 0), size: float = 2.0, width: int = 160, height: int = 120
) -> tuple[Camera, ...]:
    """One of each kind around a box of `size` at `centre`."""

    def pose(offset: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0), roll: float = 0.0) -> np.ndarray:
        at = np.array(centre) + np.array(target) * size
        return looking(tuple(np.array(centre) + np.array(offset) * size), tuple(at), roll)

    w, h = width, height
    return (
        Camera(w, h, (1.1 * w, 1.1 * w), (w / 2, h / 2), pose((0.5, -2.1, 0.9)), name="Front"),
        Camera(w, h, (1.3 * w, 1.2 * w), (0.3 * w, 0.72 * h), pose((1.9, 1.1, 0.4), roll=0.4), name="Shifted, rolled"),
        Camera(w, h, (0.5 * w / size,) * 2, (0.55 * w, 0.45 * h), pose((-1.5, -1.6, 1.2)), "orthographic", "Parallel"),
        Camera(w, h, (0.6 * w, 0.6 * w), (w / 2, h / 2), pose((0.05, -0.05, 0.1), (0.4, 0.3, 0.1)), name="Inside"),
        Camera(h, w, (0.9 * w, 0.9 * w), (h / 2, w / 2), pose((0, 0, 2.2)), name="Top, portrait"),
        Camera(w, h, (1.2 * w, 1.2 * w), (w / 2, h / 2), pose((0.4, -1.5, 0.3)), name="Near plane", near=1.45 * size),
        Camera(w, h, (1.2 * w, 1.2 * w), (w / 2, h / 2), pose((0.4, -1.5, 0.3)), name="Far plane", far=1.45 * size),
    )


def make_frame(scale: float = 1.0, position: tuple[float, float, float] = (0.5, -1.0, 2.0)) -> Ndc:
    """Device coordinates of a camera at `position` that looks along y, a little down; lengths of the scene in units of `scale`."""
    target = np.array(position) + scale * np.array([0.1, 1, -0.15])
    return Ndc(looking(position, tuple(target)), (1.6, 2.1), 1.2 * scale)


def make_forward(diffuse: bool = False, scale: float = 1.0, position: tuple[float, float, float] = (0.5, -1.0, 2.0)) -> Scene:
    """The scene of `volume` in device coordinates, up to infinity and past it."""
    return make_snerg(
        (44, 40, 57),
        diffuse,
        angles=(0.05, -0.1, 0.15),
        size=1.44,
        ndc=make_frame(scale, position),
        near=0.1 * scale,
        opacity_correction=True,
    )


def make_forward_cameras(frame: Ndc, width: int = 48, height: int = 36) -> tuple[Camera, ...]:
    """Round the frame's: as it is, aside and turned, far behind, past the near plane, parallel, wide enough to look back."""

    def pose(offset: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
        move = np.eye(4)
        move[:3, :3], move[:3, 3] = rotation(turn), np.array(offset) * frame.near
        return frame.camera_to_world @ move

    w, h = width, height
    focal, middle = (frame.focal[0] * w / 2, frame.focal[1] * h / 2), (w / 2, h / 2)
    return (
        Camera(w, h, focal, middle, pose((0, 0, 0)), name="Frame"),
        Camera(w, h, (1.1 * focal[0], 0.9 * focal[1]), (0.4 * w, 0.55 * h), pose((0.2, -0.1, 0.05), (0.05, -0.1, 0.3)), name="Aside"),
        Camera(w, h, (4 * focal[0], 4 * focal[1]), middle, pose((0.5, 0.4, 5), (-0.05, 0.1, 0)), name="Behind"),
        Camera(w, h, focal, middle, pose((0.1, 0.1, -1.4), (0.1, 0.2, 0)), name="Past the near plane"),
        Camera(w, h, (0.4 * w / frame.near,) * 2, middle, pose((0, 0, 0), (0.05, 0.1, 0)), "orthographic", "Parallel"),
        Camera(w, h, (0.2 * w, 0.2 * w), middle, pose((0, 0, 0.2), (0.2, 0.9, 0.1)), name="Looking back"),
        Camera(w, h, focal, middle, pose((0.1, 0, 0)), name="Near plane", near=2.5 * frame.near),
        Camera(w, h, focal, middle, pose((0.1, 0, 0)), name="Far plane", far=3.5 * frame.near),
    )


def make_dataset(folder: Path, train: int = 12, test: int = 3, size: int = 40) -> Path:
    """Pictures of a small scene, marched: a folder as NeRF-synthetic has it, RGBA with straight alpha, and the scene's box."""
    snerg = make_snerg((40, 36, 44), fog=False)
    draw = np.random.default_rng(4)
    for split, count in (("train", train), ("test", test)):
        cameras = []
        for index in range(count):
            around, up = 2.4 * index + (0.7 if split == "test" else 0), draw.uniform(0.1, 0.9)
            eye = 4.2 * np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
            pose = looking(tuple(eye), (0, 0, 0))
            cameras.append(Camera(size, size, (1.6 * size, 1.6 * size), (size / 2, size / 2), pose, name=f"{split}_{index}"))
            write_png(folder / split / f"{index}.png", to_uint8(render_scene(snerg, cameras[-1]).straight()))
        write_transforms(folder / f"transforms_{split}.json", cameras, [f"./{split}/{i}" for i in range(count)], snerg.box)
    return folder
