"""A baked scene on disk: scene.json, indirection.png and the atlas. A web page holds the same files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.ndc import Ndc
from ..io.about import check_about_scene
from ..io.files import new_folder
from ..io.generation import one_generation
from ..io.guard import reading
from ..io.images import png_bytes
from ..io.json_files import json_bytes
from ..io.paths import check_own
from ..io.schema import flag, number, pose, positive, record, rotation, whole
from ..progress import Note, Progress, silent, within
from ..scene.blocks import CELL_VOXELS
from ..scene.scene import Scene, blocks_of
from .atlas import MAX_ATLAS_CELLS
from .atlas_files import atlas_file_names, check_float_cells, read_atlas, read_float_cells, write_atlas
from .codecs import PNG, CodecSettings
from .image_files import read_image_file
from .scene_json import (
    FLOAT,
    MAX_VOXELS,
    ROOTS_VERSION,
    VERSION,
    alternatives_in,
    check_blocks,
    check_viewer_values,
    codec_in,
    network_from_json,
    read_scene_json,
    scene_json,
    square_roots_in,
)


def write_scene(scene: Scene, folder: Path, progress: Progress = silent, codec: CodecSettings = PNG) -> None:
    """Write a scene folder, whole or not at all.

    Raises SnergError when `folder` cannot be written, or the codec is not installed or cannot hold the scene.
    """
    with new_folder(folder) as temporary:
        write_scene_files(scene, temporary, progress, codec)


def write_scene_files(
    scene: Scene, folder: Path, progress: Progress = silent, codec: CodecSettings = PNG, alternatives: Sequence[CodecSettings] = ()
) -> None:
    """Write the files of a scene into a folder that exists.

    scene.json holds the numbers, indirection.png the indirection grid (see `indirection_image`), and the files of atlas_files the
    atlas. alternatives: lossless codecs with which the atlas is written again, beside, for readers that do not know the first. Raises
    SnergError as `write_scene` does.
    """
    check_storable(scene.quantised, codec)
    if scene.square_roots and codec.half_features:
        progress(0.0, Note("Features are stored at the whole resolution: half of it holds none of thin fog."))
        codec, *alternatives = (replace(one, half_features=False) for one in (codec, *alternatives))
    if not scene.quantised:
        check_float_cells(scene.cells, "The scene's atlas", "bake it again")
    (folder / "scene.json").write_bytes(json_bytes(scene_json(scene, codec, alternatives)))
    (folder / "indirection.png").write_bytes(png_bytes(indirection_image(scene.indirection)))
    if not scene.quantised:
        np.save(folder / "cells.npy", scene.cells, allow_pickle=False)
    else:
        for index, stored in enumerate((codec, *alternatives)):
            write_atlas(scene, folder, stored, within(progress, *(np.array([index, index + 1]) / (1 + len(alternatives)))))


def check_storable(quantised: bool, codec: CodecSettings) -> None:
    """Raise SnergError when the codec is not installed, or is not PNG (the default) while the scene is not quantised."""
    codec.check()
    if not quantised and codec != PNG:
        raise SnergError(f"The scene is not quantised, and {codec.name} holds 8 bits a value: bake it quantised, or do not choose a codec.")


def indirection_image(indirection: NDArray[Any]) -> NDArray[Any]:
    """int32 [bx, by, bz] to RGB uint8 [bz * by, bx, 3]: cell + 1 = R + 256 G + 65536 B, hence 0 where a macroblock is empty."""
    value = (indirection.transpose(2, 1, 0).reshape(-1, indirection.shape[0]) + 1).astype(np.uint32)
    pixels: NDArray[Any] = np.stack([value & 255, value >> 8 & 255, value >> 16 & 255], axis=-1).astype(np.uint8)
    return pixels


def _read_indirection(path: Path, blocks: tuple[int, int, int]) -> NDArray[Any]:
    """The inverse of `indirection_image`: int32 [bx, by, bz]."""
    bx, by, bz = blocks
    pixels = read_image_file(path, (bz * by, bx, 3)).astype(np.int32)
    value = pixels @ np.array([1, 256, 65536], np.int32) - 1
    return np.ascontiguousarray(value.reshape(bz, by, bx).transpose(2, 1, 0))


def is_scene(folder: Path) -> bool:
    """Whether a folder holds a scene.json."""
    return (folder / "scene.json").is_file()


def read_scene(folder: Path) -> Scene:
    """Read a scene folder. If another process replaces the folder meanwhile, all files come from one of the two versions.

    Raises SnergError naming the file and what is wrong with it.
    """
    return one_generation(folder, lambda: _read_scene(folder))


def _read_scene(folder: Path) -> Scene:
    value = read_scene_json(folder)
    with reading(folder / "scene.json", "export or bake the scene again"):
        return _scene(folder, value)


def _scene(folder: Path, value: dict[str, Any]) -> Scene:
    """The scene of a folder whose scene.json holds `value`."""
    check_viewer_values(value)
    x, y, z = (whole(n, "shape", 1, MAX_VOXELS) for n in value["shape"])
    blocks = blocks_of((x, y, z))
    check_blocks(blocks)
    network = value["network"]
    return Scene(
        grid_to_world=pose(value["grid_to_world"], "grid_to_world"),
        voxel_size=positive(value["voxel_size"], "voxel_size"),
        shape=(x, y, z),
        indirection=_read_indirection(folder / "indirection.png", blocks),
        cells=_read_cells(folder, value, 4 if network is None else 8),
        network=None if network is None else network_from_json(record(network, "network")),
        view_rotation=rotation(value["view_rotation"], "view_rotation"),
        near=number(value["near"], "near", 0),
        about=check_about_scene(value["about"]),
        ndc=None if value["ndc"] is None else Ndc.from_json(value["ndc"]),
        opacity_correction=flag(value["fill_holes"], "fill_holes"),
        square_roots=square_roots_in(value),
    )


def _read_cells(folder: Path, value: dict[str, Any], channels: int) -> NDArray[Any]:
    """The cells [M, 32, 32, 32, channels]: uint8, or float32 when the scene is not quantised."""
    ax, ay, az = (whole(n, "atlas_blocks", 1, MAX_ATLAS_CELLS) for n in value["atlas_blocks"])
    count = whole(value["cells"], "cells", 0, MAX_ATLAS_CELLS**3)
    codec = codec_in(value)
    if codec is None:
        return read_float_cells(folder / "cells.npy", (count, *(CELL_VOXELS,) * 3, channels))
    return read_atlas(folder, _readable(codec, alternatives_in(value)), (ax, ay, az), count, channels)


def _readable(codec: CodecSettings, alternatives: Sequence[CodecSettings]) -> CodecSettings:
    """The first codec that is installed here; `codec` when none is, which then says what to install."""
    for one in (codec, *alternatives):
        try:
            one.check()
            return one
        except SnergError:
            continue
    return codec


def codec_of(folder: Path) -> CodecSettings:
    """The codec of a scene folder; PNG, the default, when the scene is not quantised. Raises SnergError when it names none."""
    return codecs_of(folder)[0]


def codecs_of(folder: Path) -> list[CodecSettings]:
    """The codec of a scene folder as `codec_of`, and those with which its images are stored once more. Raises SnergError as that does."""
    value = read_scene_json(folder)
    try:
        return [codec_in(value) or PNG, *alternatives_in(value)]
    except (KeyError, TypeError, ValueError) as error:
        raise SnergError(f"{folder / 'scene.json'} is damaged: it has no good codec; export or bake the scene again.") from error


def is_current(folder: Path) -> bool:
    """Whether a scene folder has a current version of the format, which a web page reads."""
    return read_scene_json(folder)["version"] in (VERSION, ROOTS_VERSION)


def scene_files(folder: Path) -> list[Path]:
    """The files of a scene folder that `read_scene` reads; other files that lie beside them are left out.

    Raises SnergError when one of them is a link or missing.
    """
    value = read_scene_json(folder)
    names = ["scene.json", "indirection.png"]
    if value.get("codec") == FLOAT:
        names.append("cells.npy")
    else:
        ax, ay, az = (int(n) for n in value["atlas_blocks"])
        for codec in codecs_of(folder):
            names += atlas_file_names(codec, (ax, ay, az), 4 if value["network"] is None else 8)
    files = [folder / name for name in names]
    for path in files:
        check_own(path)
    return files


def copy_scene_files(folder: Path, target: Path) -> None:
    """Copy the files of a scene folder unchanged into another folder that exists. Raises SnergError as `scene_files` does."""
    for path in scene_files(folder):
        shutil.copyfile(path, target / path.name, follow_symlinks=False)  # a file may have become a link since the check
