"""The file layout of the reference implementation, written and read: the published viewer opens what is written here.

A folder holds scene_params.json (reference_params), atlas_indices.png (the indirection grid), and the atlas as rgba_NNN.png and
feature_NNN.png. The grid lies along the viewer's axes (reference_axes).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera, rigid
from ..geometry.ndc import Ndc
from ..io.about import check_about_scene
from ..io.files import new_folder
from ..io.generation import one_generation
from ..io.guard import reading
from ..io.images import png_bytes, read_image, read_size
from ..io.json_files import json_bytes
from ..io.paths import check_own
from ..io.schema import flag, number, pose, positive, whole
from ..progress import Note, Progress, silent
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.scene import Scene, blocks_of
from .atlas import SLICE_PLANES, atlas_blocks, slice_count
from .atlas_files import atlas_file_names, check_atlas_bytes, write_atlas
from .codecs import PNG
from .even_levels import GRAINY, with_even_levels
from .image_files import read_image_file
from .reference_axes import FLIP_Z, layout_from_ndc, reorient, viewer_scene
from .reference_params import MAX_BLOCKS, SNERG_KEY, ReferenceParams, read_params, scene_params
from .scene_json import check_blocks

EMPTY = 255  # in atlas_indices.png: a macroblock without a cell


def write_reference(scene: Scene, folder: Path, camera: Camera | None = None, progress: Progress = silent) -> None:
    """Write scene_params.json, atlas_indices.png, rgba_NNN.png and feature_NNN.png, whole or not at all.

    camera: its image size and focal length are recorded in scene_params.json. The viewer uses them for forward-facing scenes only,
    where those of the frame are recorded instead. The viewer has a near plane and a white background of its own, and no opacity
    correction. Thin fog (Scene.square_roots) is stored with even levels, and a note says what that loses. Raises SnergError when the
    scene exceeds the viewer's limits, when a forward-facing scene's box is rotated, or when the folder cannot be written.
    """
    check_limits(scene)
    if scene.square_roots:
        progress(0.0, Note(GRAINY))
        scene = with_even_levels(scene)
    turned = viewer_scene(scene)
    with new_folder(folder) as temporary:
        (temporary / "scene_params.json").write_bytes(json_bytes(scene_params(scene, turned, camera)))
        (temporary / "atlas_indices.png").write_bytes(png_bytes(index_image(turned)))
        write_atlas(turned, temporary, PNG, progress)


def check_limits(scene: Scene) -> None:
    """Raise SnergError when the layout or the published viewer cannot hold the scene."""
    if not scene.quantised:
        raise SnergError("The scene is not quantised, and the reference layout holds 8 bits a value: bake it again without 'float'.")
    if max(scene.indirection.shape) > MAX_BLOCKS:
        most = MAX_BLOCKS * DATA_VOXELS
        raise SnergError(f"The scene is {max(scene.shape)} voxels long; the reference layout holds {most}: bake at a lower resolution.")
    atlas_blocks(int((scene.indirection >= 0).sum()))


def index_image(scene: Scene) -> NDArray[Any]:
    """RGB uint8 [bz * by, bx, 3]: the position of a macroblock's cell in the atlas, in cells along x, y and z; 255 where empty."""
    width, height, _ = atlas_blocks(len(scene.cells))
    cell = scene.indirection.transpose(2, 1, 0).reshape(-1, scene.indirection.shape[0])
    position = np.stack([cell % width, cell // width % height, cell // (width * height)], axis=-1)
    return np.where(cell[..., None] < 0, EMPTY, position).astype(np.uint8)


def is_reference(folder: Path) -> bool:
    """Whether a folder holds a scene_params.json."""
    return (folder / "scene_params.json").is_file()


def read_reference(folder: Path, progress: Progress = silent) -> Scene:
    """Read a scene in the reference layout.

    A scene that `write_reference` wrote is restored exactly. One of another tool is placed in the world by worldspace_T_opengl; a
    forward-facing one looks along the world's y with its near plane at distance 1. If another process replaces the folder
    meanwhile, all files come from one of the two versions. Raises SnergError naming the file and what is wrong with it.
    """
    with reading(folder / "scene_params.json", "export it again"):
        return one_generation(folder, lambda: _read(folder, progress))


def _read(folder: Path, progress: Progress) -> Scene:
    params = read_params(folder)
    positions, indirection = read_indices(folder, params)
    cells = read_cells(folder, params, positions, progress)
    axes = params.pose[:3, :3] if params.ndc is None else np.eye(3)
    grid_to_world = params.pose.copy() if params.ndc is None else np.eye(4)
    grid_to_world[:3, 3] += axes @ params.low
    about = {"source": "reference", "path": str(folder)}
    scene = Scene(grid_to_world, params.voxel_size, params.shape, indirection, cells, params.network, about=about)
    try:
        if params.ours:
            return restore(scene, params.ours)
        if params.ndc is None:
            return scene
        view_rotation = params.pose[:3, :3] @ params.ndc.camera_to_world[:3, :3].T
        return replace(reorient(scene, FLIP_Z, FLIP_Z), ndc=params.ndc, view_rotation=view_rotation)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SnergError(
            f"{folder / 'scene_params.json'} has a damaged {SNERG_KEY!r} ({type(error).__name__}: {error}); "
            "export it again, or delete that key."
        ) from error


def restore(scene: Scene, ours: dict[str, Any]) -> Scene:
    """The scene that `write_reference` was given, from the scene that was read and the value of our key.

    Raises KeyError, TypeError, ValueError or SnergError when the value is damaged or belongs to another grid.
    """
    turn = np.array(ours["viewer_axes"])
    if turn.shape != (3, 3) or not np.array_equal(turn @ turn.T, np.eye(3)) or turn.dtype.kind != "i":
        raise ValueError("viewer_axes is not a signed permutation of the axes")
    x, y, z = (whole(n, "shape", 1, MAX_BLOCKS * DATA_VOXELS) for n in ours["shape"])
    ndc = None if ours["ndc"] is None else Ndc.from_json(ours["ndc"])
    turned = reorient(scene, turn.T, layout_from_ndc(ndc))
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


def reference_files(folder: Path) -> list[Path]:
    """The files of a folder that `read_reference` reads; other files that lie beside them are left out.

    Raises SnergError when one of them is a link or missing.
    """
    check_own(folder / "scene_params.json")  # before it is read
    params = read_params(folder)
    names = atlas_file_names(PNG, params.atlas, 4 if params.network is None else 8)
    files = [folder / name for name in ("scene_params.json", "atlas_indices.png", *names)]
    for path in files:
        check_own(path)
    return files


def read_indices(folder: Path, params: ReferenceParams) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read atlas_indices.png: the positions of the cells in use, int32 [M, 3], and the indirection grid, int32 [bx, by, bz].

    A position is (x, y, z) in cells of the atlas; the grid holds indices into the positions, or -1 where a macroblock is empty.
    Raises SnergError when the image is missing, damaged, of another size, or points outside the atlas.
    """
    path = folder / "atlas_indices.png"
    bx, by, bz = blocks_of(params.shape)
    check_blocks((bx, by, bz))
    size = read_size(path)
    if size != (bx, bz * by):
        raise SnergError(f"{path} is {size[0]} x {size[1]}, not {bx} x {bz * by}; the scene is damaged: export it again.")
    pixels = read_image(path)[..., :3]
    position = pixels.reshape(bz, by, bx, 3).transpose(2, 1, 0, 3).astype(np.int32)
    full = position[..., 0] < EMPTY
    used = position[full]
    if (used >= params.atlas).any():
        raise SnergError(f"{path} points outside the atlas of {params.atlas} cells; the scene is damaged: export it again.")
    number_in_atlas = (used[:, 2] * params.atlas[1] + used[:, 1]) * params.atlas[0] + used[:, 0]
    _, first, inverse = np.unique(number_in_atlas, return_index=True, return_inverse=True)
    indirection = np.full((bx, by, bz), -1, np.int32)
    indirection[full] = inverse
    return used[first], indirection


def read_cells(folder: Path, params: ReferenceParams, positions: NDArray[Any], progress: Progress) -> NDArray[Any]:
    """The cells at `positions` [M, 3] in the atlas, uint8 [M, 32, 32, 32, 4 or 8]; one image is in memory at a time and thread.

    Raises SnergError naming the file when an image is missing or damaged, or when the images cannot hold that many cells.
    """
    names = [("rgba", [0, 1, 2, 7]), ("feature", [3, 4, 5, 6])] if params.network is not None else [("rgba", [0, 1, 2, 3])]
    check_atlas_bytes(folder, len(positions) * CELL_VOXELS**3 * 4 * len(names))
    cells = np.zeros((len(positions), *(CELL_VOXELS,) * 3, 4 * len(names)), np.uint8)
    width, height, _ = params.atlas
    n = CELL_VOXELS
    shape = (SLICE_PLANES * height * n, width * n, 4)

    def read(job: tuple[int, str, list[int]]) -> None:
        index, name, channels = job
        pixels = read_image_file(folder / f"{name}_{index:03d}.png", shape).reshape(SLICE_PLANES, height, n, width, n, 4)
        layer, plane = divmod(index * SLICE_PLANES, n)
        rows = np.flatnonzero(positions[:, 2] == layer)
        part = pixels[:, positions[rows, 1], :, positions[rows, 0]]  # [cell, z, y, x, channel]: NumPy puts split indices first
        cells[rows[:, None], :, :, plane : plane + SLICE_PLANES, np.array(channels)] = part.transpose(0, 4, 3, 2, 1)

    jobs = [(index, name, channels) for index in range(slice_count(params.atlas)) for name, channels in names]
    with ThreadPoolExecutor(2) as pool:
        for done, _ in enumerate(pool.map(read, jobs)):
            progress((done + 1) / len(jobs), "Reading the atlas")
    return cells
