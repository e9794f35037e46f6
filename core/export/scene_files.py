"""A baked scene on disk: scene.json, indirection.png and the atlas as pictures. The web bundle holds the same files."""

from __future__ import annotations

import math
import shutil
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.ndc import Ndc
from ..io.about import check_about_scene
from ..io.files import json_bytes, new_folder, read_json
from ..io.generation import one_generation
from ..io.guard import check_file, reading
from ..io.images import png_bytes
from ..io.paths import check_own
from ..io.schema import flag, number, numbers, pose, positive, record, rotation, shown, whole
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import SHAPES, ViewNetwork
from ..progress import Progress, silent
from ..scene.blocks import CELL_VOXELS
from ..scene.scene import Scene, blocks_of
from .atlas import MAX_ATLAS_CELLS, PLANES, atlas_blocks, cells_from_slices, slices
from .codecs import CodecSettings, VideoWriter, encode, pictures_of, pixels_of, read_picture, read_video, suffix

FORMAT = "snerg-scene"
VERSION = 3
OLDER = (2,)  # versions that are read too: 2 knew PNG alone
MAX_VOXELS = 2**17  # along an axis
MAX_BLOCKS = 2**23  # of a grid: a cube of 6,000 voxels a side
FREE_BYTES, EXPANSION = 2**26, 4000  # what an atlas may hold, and how many times its files' bytes beyond that: PNG packs 1000
MAX_FLOATS = 2**37
LARGEST = 1e6  # of the network's weights: those of trained ones are below 100
IN_FLIGHT = 4  # pictures that wait to be written: what is in memory beside the scene stays small (hard case 56)
PNG = CodecSettings()
FLOAT = {"name": "float", "quality": None}  # cells that are not quantised: cells.npy


def write_scene(snerg: Scene, folder: Path, progress: Progress = silent, codec: CodecSettings = PNG) -> None:
    """Write a scene folder, whole or not at all.

    Raises SnergError when `folder` cannot be written, or the codec cannot hold the scene or is not installed.
    """
    with new_folder(folder) as temporary:
        write_scene_files(snerg, temporary, progress, codec)


def write_scene_files(snerg: Scene, folder: Path, progress: Progress = silent, codec: CodecSettings = PNG) -> None:
    """The files of a scene into a folder that exists.

    scene.json: the numbers; indirection.png: see `indirection_picture`; KIND_NNN.SUFFIX: see codecs.pictures_of, each with
    four Z planes of the atlas stacked (see atlas.slices), or for H.264 KIND.mp4, a plane a frame; cells.npy: the cells where
    they are not quantised.
    """
    check_storable(snerg.quantised, codec)
    (folder / "scene.json").write_bytes(json_bytes(scene_json(snerg, codec)))
    (folder / "indirection.png").write_bytes(png_bytes(indirection_picture(snerg.indirection)))
    if not snerg.quantised:
        np.save(folder / "cells.npy", snerg.cells, allow_pickle=False)
    else:
        write_slices(snerg, folder, codec, progress)


def check_storable(quantised: bool, codec: CodecSettings) -> None:
    """Raise SnergError when a codec is not installed, or cannot hold a scene that is not quantised."""
    codec.check()
    if not quantised and codec != PNG:
        raise SnergError(f"The scene is not quantised, and {codec.name} holds 8 bits a value: bake it quantised, or store it as it is.")


def write_slices(snerg: Scene, folder: Path, codec: CodecSettings, progress: Progress) -> None:
    """The atlas pictures, two at a time (encoders let go of Python's lock)."""

    def write(index: int, pictures: dict[str, NDArray[Any]]) -> None:
        for kind, pixels in pictures.items():
            (folder / f"{kind}_{index:03d}.{suffix(kind, codec)}").write_bytes(encode(kind, pixels, codec))

    blocks = atlas_blocks(len(snerg.cells))
    total = blocks[2] * CELL_VOXELS // PLANES
    videos = _videos(folder, codec, snerg.cells.shape[-1])
    with ThreadPoolExecutor(2) as pool:
        jobs: deque[Future[None]] = deque()
        for index, picture in enumerate(slices(snerg.cells, blocks)):
            if len(jobs) == IN_FLIGHT:
                jobs.popleft().result()
            for plane in np.split(picture, PLANES) if videos else ():
                frames = pictures_of(plane, codec)
                for kind, video in videos.items():
                    video.add(frames[kind])
            pictures = {"alpha": picture[..., -1]} if videos else pictures_of(picture, codec)
            jobs.append(pool.submit(write, index, pictures))
            progress(index / total, "Writing the atlas")
        for job in jobs:
            job.result()
    for video in videos.values():
        video.close()
    progress(1.0, "Writing the atlas")


def _videos(folder: Path, codec: CodecSettings, channels: int) -> dict[str, VideoWriter]:
    if codec.name != "h264":
        return {}
    return {kind: VideoWriter(folder / f"{kind}.mp4", codec) for kind in ("rgb", "feature")[: channels // 4]}


def scene_json(snerg: Scene, codec: CodecSettings = PNG) -> dict[str, Any]:
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
        "codec": codec.to_json() if snerg.quantised else FLOAT,
        "cells": len(snerg.cells),
        "atlas_blocks": list(atlas_blocks(len(snerg.cells))),
        "ndc": None if snerg.ndc is None else snerg.ndc.to_json(),
        "fill_holes": snerg.opacity_correction,
        "effects": snerg.effects,
        "network_transmittance": NETWORK_TRANSMITTANCE,
        "network": None if network is None else {k: np.asarray(v, np.float64).tolist() for k, v in network._asdict().items()},
        "about": snerg.about,
    }


def indirection_picture(indirection: NDArray[Any]) -> NDArray[Any]:
    """int32 [bx, by, bz] to RGB uint8 [bz * by, bx, 3]: 0 where empty, else cell + 1 = R + 256 G + 65536 B."""
    value = (indirection.transpose(2, 1, 0).reshape(-1, indirection.shape[0]) + 1).astype(np.uint32)
    return np.stack([value & 255, value >> 8 & 255, value >> 16 & 255], axis=-1).astype(np.uint8)


def is_scene(folder: Path) -> bool:
    """Whether a folder looks like one that `write_scene` wrote."""
    return (folder / "scene.json").is_file()


def read_scene(folder: Path) -> Scene:
    """Read a scene folder, whatever its codec, all of it from one generation where another process replaces it meanwhile.

    Raises SnergError that names the file and what is wrong with it.
    """
    return one_generation(folder, lambda: _read_scene(folder))


def _read_scene(folder: Path) -> Scene:
    path, value = _read_json(folder)
    with reading(path, "export or bake the scene again"):
        return _read(folder, value)


def codec_of(folder: Path) -> CodecSettings:
    """The codec of a scene folder's pictures; PNG where it is not quantised. Raises SnergError when it says none."""
    path, value = _read_json(folder)
    try:
        return PNG if value["version"] in OLDER or value["codec"] == FLOAT else CodecSettings.from_json(value["codec"])
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{path} is damaged: it has no good codec; export or bake the scene again.") from error


def is_current(folder: Path) -> bool:
    """Whether a scene folder is of this version of the format, which is all that a page reads."""
    return bool(_read_json(folder)[1]["version"] == VERSION)


def scene_files(folder: Path) -> list[Path]:
    """The files that a scene names, and no other that may lie beside them, of a folder that `read_scene` reads.

    Raises SnergError when one of them is a link or missing.
    """
    value = _read_json(folder)[1]
    codec = codec_of(folder)
    channels = 4 if value["network"] is None else 8
    names = ["scene.json", "indirection.png"]
    if value.get("codec") == FLOAT:
        names.append("cells.npy")
    else:
        count = int(value["atlas_blocks"][2]) * CELL_VOXELS // PLANES
        for kind in pictures_of(np.zeros((PLANES, 1, channels), np.uint8), codec):
            video = codec.name == "h264" and kind != "alpha"
            names += [f"{kind}.mp4"] if video else [f"{kind}_{index:03d}.{suffix(kind, codec)}" for index in range(count)]
    files = [folder / name for name in names]
    for path in files:
        check_own(path)
    return files


def copy_scene_files(folder: Path, to: Path) -> None:
    """The files of a scene as they are."""
    for path in scene_files(folder):
        shutil.copyfile(path, to / path.name, follow_symlinks=False)  # nor one that has just become a link


def _read_json(folder: Path) -> tuple[Path, dict[str, Any]]:
    path = folder / "scene.json"
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise SnergError(f"{path} is not a SNeRG scene; import scenes of other tools with 'snerg import'.")
    if not isinstance(value.get("version"), int) or value["version"] not in (VERSION, *OLDER):
        raise SnergError(f"{path} has version {value.get('version')} of the format; this SNeRG reads {VERSION}: update it.")
    return path, value


def _read(folder: Path, value: dict[str, Any]) -> Scene:
    _check_unused(value)
    x, y, z = (whole(n, "shape", 1, MAX_VOXELS) for n in value["shape"])
    blocks = blocks_of((x, y, z))
    check_blocks(blocks)
    picture = read_picture(folder / "indirection.png", (blocks[2] * blocks[1], blocks[0], 3)).astype(np.int32)
    indirection = (picture @ np.array([1, 256, 65536], np.int32) - 1).reshape(blocks[2], blocks[1], blocks[0]).transpose(2, 1, 0)
    network = value["network"]
    return Scene(
        grid_to_world=pose(value["grid_to_world"], "grid_to_world"),
        voxel_size=positive(value["voxel_size"], "voxel_size"),
        shape=(x, y, z),
        indirection=np.ascontiguousarray(indirection),
        cells=_read_cells(folder, value, 4 if network is None else 8),
        network=None if network is None else _network(record(network, "network")),
        view_rotation=rotation(value["view_rotation"], "view_rotation"),
        near=number(value["near"], "near", 0),
        about=check_about_scene(value["about"]),
        ndc=None if value["ndc"] is None else Ndc.from_json(value["ndc"]),
        opacity_correction=flag(value["fill_holes"], "fill_holes"),
    )


def _check_unused(value: dict[str, Any]) -> None:
    """Check the values that are stored for other programs only: the web page reads network_transmittance."""
    number(value["network_transmittance"], "network_transmittance", 0, 1)
    for name, chosen in record(value["effects"], "effects").items():
        flag(chosen, f"effects[{shown(name)}]")


def _network(value: dict[str, Any]) -> ViewNetwork:
    """MLP_Phi, its weights bounded so that what it computes stays finite."""
    arrays = [numbers(value[name], name, shape, LARGEST) for name, shape in zip(ViewNetwork._fields, SHAPES, strict=True)]
    return ViewNetwork(*(array.astype(np.float32) for array in arrays))


def check_blocks(blocks: tuple[int, int, int]) -> None:
    """Raise ValueError where a grid has more macroblocks than any scene, before memory is taken for them."""
    if math.prod(blocks) > MAX_BLOCKS:
        raise ValueError(f"its grid has {' x '.join(map(str, blocks))} macroblocks; the most is {MAX_BLOCKS} in all")


def check_atlas(folder: Path, values: int) -> None:
    """Raise SnergError where an atlas of so many bytes cannot be what a folder's files hold, before memory is taken for it."""
    stored = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    if values > FREE_BYTES + EXPANSION * stored:
        raise SnergError(
            f"{folder} says that its atlas has {values >> 20} MiB, more than its files of {stored} bytes hold; export it again."
        )


def _read_cells(folder: Path, value: dict[str, Any], channels: int) -> NDArray[Any]:
    """Atlas cells [count, 32, 32, 32, channels] as their codec stored them."""
    ax, ay, az = (whole(n, "atlas_blocks", 1, MAX_ATLAS_CELLS) for n in value["atlas_blocks"])
    count = whole(value["cells"], "cells", 0, MAX_ATLAS_CELLS**3)
    codec = PNG.to_json() if value["version"] in OLDER else value["codec"]
    if codec == FLOAT:
        return _read_floats(folder / "cells.npy", (count, *(CELL_VOXELS,) * 3, channels))
    if count > ax * ay * az:
        raise SnergError(f"{folder} says that it has {count} cells in an atlas of {ax} x {ay} x {az}; export it again.")
    check_atlas(folder, ax * ay * az * CELL_VOXELS**3 * channels)
    read = picture_reader(folder, CodecSettings.from_json(codec), (ax, ay, az), channels)
    return cells_from_slices(read, (ax, ay, az), count, channels)


def picture_reader(folder: Path, codec: CodecSettings, blocks: tuple[int, int, int], channels: int) -> Callable[[int], NDArray[Any]]:
    """A function from 0, 1, 2, ... to that slice of the atlas, uint8 [H, W, channels]. Raises SnergError as `read_scene` does."""
    codec.check()
    height, width = PLANES * blocks[1] * CELL_VOXELS, blocks[0] * CELL_VOXELS
    empty = pictures_of(np.zeros((height, width, channels), np.uint8), codec)
    shapes = {kind: pixels.shape for kind, pixels in empty.items()}
    if codec.name != "h264":
        return lambda index: pixels_of(
            {kind: read_picture(folder / f"{kind}_{index:03d}.{suffix(kind, codec)}", shape) for kind, shape in shapes.items()}, codec
        )
    alpha = shapes.pop("alpha")
    frames = {kind: read_video(folder / f"{kind}.mp4", (shape[0] // PLANES, width, 3)) for kind, shape in shapes.items()}

    def read(index: int) -> NDArray[Any]:
        planes = np.split(read_picture(folder / f"alpha_{index:03d}.png", alpha), PLANES)
        return np.concatenate(
            [pixels_of({"alpha": plane} | {kind: next(video) for kind, video in frames.items()}, codec) for plane in planes]
        )

    return read


def _read_floats(path: Path, shape: tuple[int, ...]) -> NDArray[Any]:
    """cells.npy, float32 in [0, 1]; its header is read first (hard case 61)."""
    if not path.exists():
        raise SnergError(f"{path} is missing; the scene's folder is damaged: export it again.")
    check_file(path, MAX_FLOATS)
    with reading(path, "export the scene again"):
        cells = np.lib.format.open_memmap(path, mode="r")
        if cells.shape != shape or cells.dtype != np.float32:
            raise ValueError(f"it is {cells.shape} {cells.dtype}, not {shape} float32")
        cells = np.array(cells)
    if not (cells.min(initial=0) >= 0 and cells.max(initial=0) <= 1):  # false for NaN as well
        raise SnergError(f"{path} holds values outside 0 to 1; export the scene again.")
    return cells
