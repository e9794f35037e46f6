"""A baked scene on disk: scene.json, indirection.png and the atlas as PNGs. The web bundle holds the same files."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.images import png_bytes, read_image
from ..capture.ndc import Ndc
from ..errors import SnergError
from ..field.networks import ViewNetwork
from ..files import json_bytes, new_folder, read_json
from ..grid.box import CELL_VOXELS
from ..grid.snerg import NETWORK_TRANSMITTANCE, Snerg, blocks_of
from .codecs import PLANES, atlas_blocks, cells_from_slices, slices

FORMAT = "snerg-scene"
VERSION = 2
IN_FLIGHT = 4  # pictures that wait to be written: what is in memory beside the scene stays small (hard case 56)
Progress = Callable[[float, str], None]


def write_scene(snerg: Snerg, folder: Path, progress: Progress = lambda fraction, what: None) -> None:
    """Write a scene folder, whole or not at all. Raises SnergError when `folder` cannot be written."""
    with new_folder(folder) as temporary:
        write_scene_files(snerg, temporary, progress)


def write_scene_files(snerg: Snerg, folder: Path, progress: Progress = lambda fraction, what: None) -> None:
    """The files of a scene into a folder that exists.

    scene.json: the numbers; indirection.png: see `indirection_picture`; rgba_NNN.png: RGB and alpha, and
    feature_NNN.png: the four features, each with four Z planes of the atlas stacked (see codecs.slices).
    """
    (folder / "scene.json").write_bytes(json_bytes(scene_json(snerg)))
    (folder / "indirection.png").write_bytes(png_bytes(indirection_picture(snerg.indirection)))
    write_slices(snerg, folder, progress)


def write_slices(snerg: Snerg, folder: Path, progress: Progress) -> None:
    """The atlas pictures, two at a time (zlib lets go of Python's lock)."""

    def write(index: int, picture: np.ndarray) -> None:
        (folder / f"rgba_{index:03d}.png").write_bytes(png_bytes(picture[..., [0, 1, 2, -1]]))
        if picture.shape[-1] == 8:
            (folder / f"feature_{index:03d}.png").write_bytes(png_bytes(picture[..., 3:7]))

    blocks = atlas_blocks(len(snerg.cells))
    total = blocks[2] * CELL_VOXELS // PLANES
    with ThreadPoolExecutor(2) as pool:
        jobs: deque[Future[None]] = deque()
        for index, picture in enumerate(slices(snerg.cells, blocks)):
            if len(jobs) == IN_FLIGHT:
                jobs.popleft().result()
            jobs.append(pool.submit(write, index, picture))
            progress(index / total, "Writing the atlas")
        for job in jobs:
            job.result()
    progress(1.0, "Writing the atlas")


def scene_json(snerg: Snerg) -> dict[str, Any]:
    """What scene.json holds."""
    network = snerg.network
    return {
        "format": FORMAT,
        "version": VERSION,
        "voxel_size": float(snerg.voxel_size),
        "shape": list(snerg.shape),
        "grid_to_world": snerg.grid_to_world.tolist(),
        "view_rotation": np.asarray(snerg.view_rotation).tolist(),
        "near": float(snerg.near),
        "cells": len(snerg.cells),
        "atlas_blocks": list(atlas_blocks(len(snerg.cells))),
        "ndc": None if snerg.ndc is None else snerg.ndc.to_json(),
        "fill_holes": snerg.fill_holes,
        "effects": snerg.effects,
        "network_transmittance": NETWORK_TRANSMITTANCE,
        "network": None if network is None else {k: np.asarray(v, np.float64).tolist() for k, v in network._asdict().items()},
        "about": snerg.about,
    }


def indirection_picture(indirection: np.ndarray) -> np.ndarray:
    """int32 [bx, by, bz] to RGB uint8 [bz * by, bx, 3]: 0 where empty, else cell + 1 = R + 256 G + 65536 B."""
    value = (indirection.transpose(2, 1, 0).reshape(-1, indirection.shape[0]) + 1).astype(np.uint32)
    return np.stack([value & 255, value >> 8 & 255, value >> 16 & 255], axis=-1).astype(np.uint8)


def is_scene(folder: Path) -> bool:
    """Whether a folder looks like one that `write_scene` wrote."""
    return (folder / "scene.json").is_file()


def read_scene(folder: Path) -> Snerg:
    """Read a scene folder. Raises SnergError that names the file and what is wrong with it."""
    path = folder / "scene.json"
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise SnergError(f"{path} is not a SNeRG scene; import scenes of other tools with 'snerg import'.")
    if value.get("version") != VERSION:
        raise SnergError(f"{path} has version {value.get('version')} of the format; this SNeRG reads {VERSION}: update it.")
    try:
        return _read(folder, value)
    except (KeyError, TypeError, ValueError, json.JSONDecodeError) as error:
        raise SnergError(f"{path} is damaged ({type(error).__name__}: {error}); export or bake the scene again.") from error


def _read(folder: Path, value: dict[str, Any]) -> Snerg:
    x, y, z = (int(n) for n in value["shape"])
    blocks = blocks_of((x, y, z))
    picture = read_picture(folder / "indirection.png", (blocks[2] * blocks[1], blocks[0], 3)).astype(np.int32)
    indirection = (picture @ np.array([1, 256, 65536], np.int32) - 1).reshape(blocks[2], blocks[1], blocks[0]).transpose(2, 1, 0)
    ax, ay, az = (int(n) for n in value["atlas_blocks"])
    network = value["network"]
    cells = read_cells(folder, (ax, ay, az), int(value["cells"]), network is not None)
    return Snerg(
        grid_to_world=np.array(value["grid_to_world"], np.float64),
        voxel_size=float(value["voxel_size"]),
        shape=(x, y, z),
        indirection=np.ascontiguousarray(indirection),
        cells=cells,
        network=None if network is None else ViewNetwork(*(np.array(network[k], np.float32) for k in ViewNetwork._fields)),
        view_rotation=np.array(value["view_rotation"], np.float64),
        near=float(value["near"]),
        about=dict(value["about"]),
        ndc=None if value["ndc"] is None else Ndc.from_json(value["ndc"]),
        fill_holes=bool(value["fill_holes"]),
    )


def read_cells(folder: Path, blocks: tuple[int, int, int], count: int, features: bool) -> np.ndarray:
    """Atlas cells from rgba_NNN.png and, where the scene has them, feature_NNN.png."""
    size = (PLANES * blocks[1] * CELL_VOXELS, blocks[0] * CELL_VOXELS, 4)
    if count > blocks[0] * blocks[1] * blocks[2]:
        raise SnergError(f"{folder} says that it has {count} cells in an atlas of {blocks}; export it again.")

    def read(index: int) -> np.ndarray:
        rgba = read_picture(folder / f"rgba_{index:03d}.png", size)
        if not features:
            return rgba
        feature = read_picture(folder / f"feature_{index:03d}.png", size)
        return np.concatenate([rgba[..., :3], feature, rgba[..., 3:]], axis=-1)

    return cells_from_slices(read, blocks, count, 8 if features else 4)


def read_picture(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """A PNG that must have exactly this shape. Raises SnergError naming the file when it has not."""
    pixels = read_image(path)
    if pixels.shape != shape:
        raise SnergError(f"{path} is {pixels.shape}, not {shape}; the scene's folder is damaged: export it again.")
    return pixels
