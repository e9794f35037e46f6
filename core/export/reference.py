"""The PNG layout of the reference implementation, both ways: the published viewer opens what is written here.

The viewer's world is the grid's own axes, y up. It starts at (0, 1, -4) looking at the origin with its near plane at
0.33, and asks the network about M d, M the upper 3 x 3 of worldspace_T_opengl and d a direction along the grid's axes.

A forward-facing scene ("ndc") lies in device coordinates with z turned round, near at 1. There the viewer looks along its z
with x to the left, so that a direction in the axes of the frame is diag(-1, 1, -1) d. Where its rays meet the near plane it
computes origin * t + direction for origin + t * direction (hard case 10): its perspective is a little off, with any such file.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera, focal_from_angle, rigid
from ..geometry.ndc import Ndc
from ..io.about import check_about_scene
from ..io.files import json_bytes, new_folder, read_json
from ..io.generation import one_generation
from ..io.guard import reading, why
from ..io.images import png_bytes, read_image, read_size
from ..io.paths import check_own
from ..io.schema import FAR, flag, number, numbers, pose, positive, shown, whole
from ..nerf.model import SHAPES, ViewNetwork
from ..progress import Progress, silent
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.scene import Scene, blocks_of
from .atlas import MAX_ATLAS_CELLS, PLANES, atlas_blocks
from .codecs import CodecSettings, read_picture
from .scene_files import LARGEST, check_atlas, check_blocks, write_slices

EMPTY = 255  # an index of a block without a cell
MAX_BLOCKS = 254  # along an axis of the grid: what a 3D texture is sure to hold (hard case 54)
OURS = "snerg_for_blender"  # our own key in scene_params.json: what the layout has no room for
SIDES = (1.0, 4.0)  # longest sides that the viewer's first view shows well; others are scaled to FITTED
FITTED = 2.0
UPRIGHT = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])  # viewer axes to world: it starts out at Blender's front view
SAME = np.eye(3, dtype=int)
FLIP = np.diag([1, 1, -1])  # device coordinates to the layout's
FACING = np.diag([-1, 1, -1])  # the axes of a forward-facing viewer to those of the frame
AHEAD = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # a frame that looks along the world's y, z up
KERNELS = ("0_weights", "0_bias", "1_weights", "1_bias", "2_weights", "2_bias")  # in ViewNetwork's order


def write_reference(snerg: Scene, folder: Path, camera: Camera | None = None, progress: Progress = silent) -> None:
    """Write scene_params.json, atlas_indices.png, rgba_NNN.png and feature_NNN.png, whole or not at all.

    camera: gives the picture's size and focal length that the layout records (the viewer uses them for NDC scenes only, and
    for those they are the frame's). The viewer's fixed near plane and white background stand in place of the scene's, and it
    fills no holes. Raises SnergError when the scene is larger than the viewer's textures, or forward-facing with a turned
    box, or the folder cannot be written.
    """
    check_fits(snerg)
    turned = for_viewer(snerg)
    with new_folder(folder) as temporary:
        (temporary / "scene_params.json").write_bytes(json_bytes(scene_params(snerg, turned, camera)))
        (temporary / "atlas_indices.png").write_bytes(png_bytes(index_picture(turned)))
        write_slices(turned, temporary, CodecSettings(), progress)


def check_fits(snerg: Scene) -> None:
    """Raise SnergError, saying why, when the published viewer could not hold the scene."""
    if not snerg.quantised:
        raise SnergError("The scene is not quantised, and the reference layout holds 8 bits a value: bake it again without 'float'.")
    if max(snerg.indirection.shape) > MAX_BLOCKS:
        most = MAX_BLOCKS * DATA_VOXELS
        raise SnergError(f"The scene is {max(snerg.shape)} voxels long; the reference layout holds {most}: bake at a lower resolution.")
    atlas_blocks(int((snerg.indirection >= 0).sum()))


def for_viewer(snerg: Scene) -> Scene:
    """The scene along the viewer's axes; a forward-facing one in the layout's device coordinates."""
    rotation = snerg.grid_to_world[:3, :3]
    if snerg.ndc is None:
        return reorient(snerg, viewer_axes(rotation))
    if np.abs(np.rint(rotation) - rotation).max() > 1e-9:
        raise SnergError(
            "The scene is forward-facing and its box is turned, which the reference layout has no room for: bake it without a box."
        )
    return reorient(snerg, np.rint(rotation.T @ FLIP).astype(int), FLIP)


def viewer_axes(rotation: NDArray[Any]) -> NDArray[Any]:
    """[3, 3] signed permutation from the viewer's axes to the grid's that shows the scene most nearly upright.

    rotation: [3, 3] from the grid's axes to the world's. Of the 24 turns of a cube, the one that brings the viewer's y
    nearest to the world's z, then the rest nearest to Blender's front view.
    """
    weight = np.array([1.0, 10.0, 1.0])
    return max(_turns(), key=lambda turn: float((UPRIGHT * (rotation @ turn) * weight).sum()))


def _turns() -> Iterable[NDArray[Any]]:
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        turn = np.eye(3, dtype=int)[:, list(order)] * signs
        if round(np.linalg.det(turn)) == 1:
            yield turn


def reorient(snerg: Scene, turn: NDArray[Any], flip: NDArray[Any] = SAME) -> Scene:
    """The same scene with its grid along other axes: column j of `turn` is new axis j in the old ones.

    flip: [3, 3] from the world that the grid stands in to the one of the result; it mirrors where `turn` does. A flipped axis is
    padded to whole blocks, so that cells flip as they are. Cells are numbered x, y, z with z fastest.
    """
    order, signs = np.abs(turn).argmax(axis=0), turn.sum(axis=0)
    flipped = [axis for axis in range(3) if signs[axis] < 0]
    shape = [int(snerg.shape[axis]) for axis in order]
    pose = snerg.grid_to_world.copy()
    pose[:3] = flip @ pose[:3]
    pose[:3, :3] = pose[:3, :3] @ turn
    for axis in flipped:
        shape[axis] = -(-shape[axis] // DATA_VOXELS) * DATA_VOXELS
        pose[:3, 3] -= pose[:3, axis] * shape[axis] * snerg.voxel_size
    numbers = np.flip(snerg.indirection.transpose(order), flipped)
    full = numbers >= 0
    indirection = np.where(full, np.cumsum(full.reshape(-1)).reshape(full.shape) - 1, -1).astype(np.int32)
    cells = np.flip(snerg.cells.transpose(0, *(order + 1), 4), [axis + 1 for axis in flipped])[numbers[full]]
    return replace(
        snerg, grid_to_world=pose, shape=(shape[0], shape[1], shape[2]), indirection=indirection, cells=np.ascontiguousarray(cells)
    )


def scene_params(snerg: Scene, turned: Scene, camera: Camera | None) -> dict[str, Any]:
    """What scene_params.json holds; `turned` is `snerg` along the viewer's axes.

    The box's centre is the viewer's origin, but in device coordinates. Where the scene was trained in the world's axes and is not scaled,
    worldspace_T_opengl takes the viewer's points to the world.
    """
    scale = viewer_scale(snerg)
    voxel_size = turned.voxel_size * scale
    corner, axes, origin = viewer_place(snerg, turned, scale)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = snerg.view_rotation @ axes, snerg.view_rotation @ origin
    blocks = atlas_blocks(len(turned.cells))
    atlas = [n * CELL_VOXELS for n in blocks]
    params: dict[str, Any] = {
        "voxel_size": voxel_size,
        "block_size": DATA_VOXELS,
        **dict(zip(("grid_width", "grid_height", "grid_depth"), turned.shape, strict=True)),
        **dict(zip(("atlas_width", "atlas_height", "atlas_depth"), atlas, strict=True)),
        "num_slices": atlas[2] // PLANES,
        **dict(zip(("min_x", "min_y", "min_z"), corner.tolist(), strict=True)),
        **dict(zip(("atlas_blocks_x", "atlas_blocks_y", "atlas_blocks_z"), blocks, strict=True)),
        **(picture_params(camera) if snerg.ndc is None else frame_params(snerg.ndc)),
        "worldspace_T_opengl": pose.tolist(),
        "ndc": snerg.ndc is not None,
        "format": "png",
    }
    if snerg.network is not None:
        params |= {key: np.asarray(value, np.float64).tolist() for key, value in zip(KERNELS, snerg.network, strict=True)}
    params[OURS] = {
        "grid_to_world": snerg.grid_to_world.tolist(),
        "view_rotation": np.asarray(snerg.view_rotation).tolist(),
        "voxel_size": float(snerg.voxel_size),
        "shape": list(snerg.shape),
        "near": float(snerg.near),
        "fill_holes": snerg.opacity_correction,
        "viewer_axes": np.rint(snerg.grid_to_world[:3, :3].T @ flip_of(snerg.ndc) @ turned.grid_to_world[:3, :3]).astype(int).tolist(),
        "about": snerg.about,
        "ndc": None if snerg.ndc is None else snerg.ndc.to_json(),
    }
    return params


def flip_of(ndc: Ndc | None) -> NDArray[Any]:
    """[3, 3] from the world of a scene's grid to that of the layout's."""
    return SAME if ndc is None else FLIP


def viewer_place(snerg: Scene, turned: Scene, scale: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The grid's corner in the viewer's world, the viewer's axes [3, 3] in ours, and its origin in ours."""
    pose = turned.grid_to_world
    if snerg.ndc is not None:
        return pose[:3, 3], snerg.ndc.camera_to_world[:3, :3] @ FACING, snerg.ndc.camera_to_world[:3, 3]
    centre = snerg.box.box_to_world[:3, 3]
    return (pose[:3, 3] - centre) @ pose[:3, :3] * scale, pose[:3, :3], centre


def viewer_scale(snerg: Scene) -> float:
    """Viewer units a world unit: 1, but for a scene that the viewer's fixed camera would start inside of or miss."""
    if snerg.ndc is not None:
        return 1.0
    side = float(snerg.box.size.max())
    return 1.0 if SIDES[0] <= side <= SIDES[1] else FITTED / side


def picture_params(camera: Camera | None) -> dict[str, float]:
    """input_height, input_width and input_focal: of the camera, or of the viewer's own first view."""
    if camera is None:
        return {"input_height": 720.0, "input_width": 1280.0, "input_focal": focal_from_angle(math.radians(35), 720, "The viewer")}
    return {"input_height": float(camera.height), "input_width": float(camera.width), "input_focal": float(camera.focal[0])}


def frame_params(ndc: Ndc) -> dict[str, float]:
    """input_height, input_width and input_focal of a frame: only their ratios count."""
    focal = 500 * ndc.focal[0]
    return {"input_height": 2 * focal / ndc.focal[1], "input_width": 1000.0, "input_focal": focal}


def index_picture(snerg: Scene) -> NDArray[Any]:
    """RGB uint8 [bz * by, bx, 3]: the cell's place in the atlas, in cells along x, y and z; 255 where there is none."""
    width, height, _ = atlas_blocks(len(snerg.cells))
    number = snerg.indirection.transpose(2, 1, 0).reshape(-1, snerg.indirection.shape[0])
    place = np.stack([number % width, number // width % height, number // (width * height)], axis=-1)
    return np.where(number[..., None] < 0, EMPTY, place).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class ReferenceParams:
    """scene_params.json, checked.

    voxel_size: viewer units. shape: voxels (x, y, z). low: [3] the grid's corner, viewer units. atlas: cells along x, y, z.
    pose: [4, 4] rigid, worldspace_T_opengl. network: None in a diffuse scene. ours: what `write_reference` added, or {}.
    ndc: of a forward-facing scene. Its pose takes the axes of the frame to those in which the network was trained.
    """

    voxel_size: float
    shape: tuple[int, int, int]
    low: NDArray[Any]
    atlas: tuple[int, int, int]
    pose: NDArray[Any]
    network: ViewNetwork | None
    ours: dict[str, Any]
    ndc: Ndc | None


def is_reference(folder: Path) -> bool:
    """Whether a folder looks like a scene in the reference layout."""
    return (folder / "scene_params.json").is_file()


def read_reference(folder: Path, progress: Progress = silent) -> Scene:
    """Read a scene in the reference layout.

    A scene of another tool stands in the world where worldspace_T_opengl puts it, a forward-facing one along y with near at 1;
    one of ours where it was, exactly.
    All of it is from one generation where another process replaces it meanwhile.
    Raises SnergError that names the file and what is wrong with it.
    """
    path = folder / "scene_params.json"
    with reading(path, "export it again"):
        return one_generation(folder, lambda: _read(folder, path, progress))


def _read(folder: Path, path: Path, progress: Progress) -> Scene:
    params = read_params(folder)
    places, indirection = read_indices(folder, params)
    cells = read_atlas(folder, params, places, progress)
    axes = params.pose[:3, :3] if params.ndc is None else np.eye(3)
    pose = params.pose.copy() if params.ndc is None else np.eye(4)
    pose[:3, 3] += axes @ params.low
    about = {"source": "reference", "path": str(folder)}
    snerg = Scene(pose, params.voxel_size, params.shape, indirection, cells, params.network, about=about)
    try:
        if params.ours:
            return restore(snerg, params.ours)
        if params.ndc is None:
            return snerg
        view = params.pose[:3, :3] @ params.ndc.camera_to_world[:3, :3].T
        return replace(reorient(snerg, FLIP, FLIP), ndc=params.ndc, view_rotation=view)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SnergError(
            f"{path} has a damaged {OURS!r} ({type(error).__name__}: {error}); export it again, or delete that key."
        ) from error


def restore(snerg: Scene, ours: dict[str, Any]) -> Scene:
    """Undo what `write_reference` did to fit the viewer."""
    turn = np.array(ours["viewer_axes"])
    if turn.shape != (3, 3) or not np.array_equal(turn @ turn.T, np.eye(3)) or turn.dtype.kind != "i":
        raise ValueError("viewer_axes is not a turn of a cube")
    x, y, z = (whole(n, "shape", 1, MAX_BLOCKS * DATA_VOXELS) for n in ours["shape"])
    ndc = None if ours["ndc"] is None else Ndc.from_json(ours["ndc"])
    turned = reorient(snerg, turn.T, flip_of(ndc))
    if blocks_of((x, y, z)) != turned.indirection.shape:
        raise ValueError(f"shape is {(x, y, z)} where the grid is {turned.shape}")
    return replace(
        turned,
        grid_to_world=pose(ours["grid_to_world"], "grid_to_world"),
        view_rotation=rigid(np.c_[np.array(ours["view_rotation"], np.float64), np.zeros(3)], "view_rotation")[:3, :3],
        voxel_size=positive(ours["voxel_size"], "voxel_size"),
        shape=(x, y, z),
        near=number(ours["near"], "near", 0),
        opacity_correction=flag(ours["fill_holes"], "fill_holes"),
        about=check_about_scene(ours["about"]),
        ndc=ndc,
    )


def read_params(folder: Path) -> ReferenceParams:
    """Read and check scene_params.json. Raises SnergError saying what is wrong with it."""
    path = folder / "scene_params.json"
    value = read_json(path)
    if not isinstance(value, dict) or "voxel_size" not in value:
        raise SnergError(f"{path} is not a scene in the reference SNeRG layout.")
    try:
        return _params(value)
    except KeyError as error:
        raise SnergError(f"{path} has no {error}; the scene is damaged or of another kind: export it again.") from error
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        raise SnergError(f"{path} cannot be used: {why(error)}.") from error


def _params(value: dict[str, Any]) -> ReferenceParams:
    if value["format"] != "png":
        raise ValueError(f"its images are of format {value['format']!r}; only 'png' is read")
    if int(value["block_size"]) != DATA_VOXELS:
        raise ValueError(f"its blocks are of {value['block_size']} voxels; only {DATA_VOXELS} are read")
    x, y, z = (_count(value, key, MAX_BLOCKS * DATA_VOXELS) for key in ("grid_width", "grid_height", "grid_depth"))
    atlas = ax, ay, az = tuple(_count(value, f"atlas_blocks_{axis}", MAX_ATLAS_CELLS) for axis in "xyz")
    for key, cells in zip(("atlas_width", "atlas_height", "atlas_depth"), atlas, strict=True):
        if int(value[key]) != cells * CELL_VOXELS:
            raise ValueError(f"{key} is {value[key]} where its blocks make {cells * CELL_VOXELS}")
    if int(value["num_slices"]) * PLANES != az * CELL_VOXELS:
        raise ValueError(f"num_slices is {value['num_slices']} where the atlas makes {az * CELL_VOXELS // PLANES}")
    ours = value.get(OURS, {})
    return ReferenceParams(
        voxel_size=_finite(value, "voxel_size", positive=True),
        shape=(x, y, z),
        low=np.array([_finite(value, f"min_{axis}") for axis in "xyz"]),
        atlas=(ax, ay, az),
        pose=_facing(value["worldspace_T_opengl"]) if value["ndc"] else _pose(value["worldspace_T_opengl"]),
        network=_network(value) if "0_bias" in value else None,
        ours=ours if isinstance(ours, dict) else {},
        ndc=_frame(value) if value["ndc"] else None,
    )


def _count(value: dict[str, Any], key: str, most: int) -> int:
    given = number(value[key], key)
    return whole(int(given) if given == int(given) else given, key, 1, most)


def _finite(value: dict[str, Any], key: str, positive: bool = False) -> float:
    found = float(value[key])
    if not abs(found) <= FAR or (positive and found <= 0):
        raise ValueError(f"{key} is {shown(value[key])}; it must be finite{' and above 0' if positive else ''}")
    return found


def _pose(rows: Any) -> NDArray[Any]:
    pose = np.array(rows, np.float64)
    if pose.shape != (4, 4) or not (np.abs(pose) <= FAR).all():
        raise ValueError("worldspace_T_opengl is not a finite 4 x 4 matrix")
    axes = pose[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("worldspace_T_opengl scales, shears or mirrors; only a rotation and a translation can be used")
    return pose


def _facing(rows: Any) -> NDArray[Any]:
    """From the axes of a frame to the network's. What the reference writes is the turning round of its grid, not of directions."""
    matrix = np.array(rows, np.float64)
    if matrix.shape == (4, 4) and np.array_equal(matrix[:3, :3], FLIP):
        return np.eye(4)
    pose = _pose(rows)
    pose[:3, :3] = pose[:3, :3] @ FACING
    return pose


def _frame(value: dict[str, Any]) -> Ndc:
    focal, width, height = (_finite(value, f"input_{key}", positive=True) for key in ("focal", "width", "height"))
    return Ndc(AHEAD, (2 * focal / width, 2 * focal / height), 1.0)


def _network(value: dict[str, Any]) -> ViewNetwork:
    arrays = []
    for key, shape in zip(KERNELS, SHAPES, strict=True):
        arrays.append(numbers(value[key], key, shape, LARGEST).astype(np.float32))
    return ViewNetwork(*arrays)


def reference_files(folder: Path) -> list[Path]:
    """The files that scene_params.json names, of a folder that `read_reference` reads.

    Raises SnergError when one of them is a link or missing.
    """
    check_own(folder / "scene_params.json")  # before it is read
    params = read_params(folder)
    kinds = ("rgba",) if params.network is None else ("rgba", "feature")
    slices = range(params.atlas[2] * CELL_VOXELS // PLANES)
    names = ["scene_params.json", "atlas_indices.png", *(f"{kind}_{index:03d}.png" for kind in kinds for index in slices)]
    files = [folder / name for name in names]
    for path in files:
        check_own(path)
    return files


def read_indices(folder: Path, params: ReferenceParams) -> tuple[NDArray[Any], NDArray[Any]]:
    """atlas_indices.png: (places [M, 3], the cells in use as (ix, iy, iz), and indirection [bx, by, bz] into them)."""
    path = folder / "atlas_indices.png"
    bx, by, bz = blocks_of(params.shape)
    check_blocks((bx, by, bz))
    size = read_size(path)
    if size != (bx, bz * by):
        raise SnergError(f"{path} is {size[0]} x {size[1]}, not {bx} x {bz * by}; the scene is damaged: export it again.")
    pixels = read_image(path)[..., :3]
    place = pixels.reshape(bz, by, bx, 3).transpose(2, 1, 0, 3).astype(np.int32)
    full = place[..., 0] < EMPTY
    used = place[full]
    if (used >= params.atlas).any():
        raise SnergError(f"{path} points outside the atlas of {params.atlas} cells; the scene is damaged: export it again.")
    number = (used[:, 2] * params.atlas[1] + used[:, 1]) * params.atlas[0] + used[:, 0]
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    indirection = np.full((bx, by, bz), -1, np.int32)
    indirection[full] = inverse
    return used[first], indirection


def read_atlas(folder: Path, params: ReferenceParams, places: NDArray[Any], progress: Progress) -> NDArray[Any]:
    """The cells at `places` [M, 3], uint8 [M, 32, 32, 32, 4 or 8]; only those, a picture at a time (hard case 56)."""
    names = [("rgba", [0, 1, 2, 7]), ("feature", [3, 4, 5, 6])] if params.network is not None else [("rgba", [0, 1, 2, 3])]
    check_atlas(folder, len(places) * CELL_VOXELS**3 * 4 * len(names))
    cells = np.zeros((len(places), *(CELL_VOXELS,) * 3, 4 * len(names)), np.uint8)
    width, height, depth = params.atlas
    n = CELL_VOXELS
    size = (PLANES * height * n, width * n, 4)

    def read(job: tuple[int, str, list[int]]) -> None:
        index, name, channels = job
        picture = read_picture(folder / f"{name}_{index:03d}.png", size).reshape(PLANES, height, n, width, n, 4)
        layer, plane = divmod(index * PLANES, n)
        rows = np.flatnonzero(places[:, 2] == layer)
        part = picture[:, places[rows, 1], :, places[rows, 0]]  # [cell, z, y, x, channel]: indices apart come first
        cells[rows[:, None], :, :, plane : plane + PLANES, np.array(channels)] = part.transpose(0, 4, 3, 2, 1)

    jobs = [(index, name, channels) for index in range(depth * n // PLANES) for name, channels in names]
    with ThreadPoolExecutor(2) as pool:
        for done, _ in enumerate(pool.map(read, jobs)):
            progress((done + 1) / len(jobs), "Reading the atlas")
    return cells
