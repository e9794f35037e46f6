"""scene.json: the numbers of a baked scene. Its keys keep their names for good, since files that users have hold them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SnergError
from ..io.json_files import read_json
from ..io.schema import flag, number, numbers, record, shown
from ..nerf.frame import NETWORK_TRANSMITTANCE
from ..nerf.model import SHAPES, ViewNetwork
from ..scene.scene import Scene
from .atlas import atlas_blocks
from .codecs import PNG, CodecSettings

FORMAT = "snerg-scene"
VERSION = 3
ROOTS_VERSION = 4  # of scenes of square roots, so that readers that do not know them refuse; it has the key "square_roots"
OLDER_VERSIONS = (2,)  # that are read too: version 2 has no key "codec" and stores PNG
FLOAT = {"name": "float", "quality": None}  # the "codec" of a scene that is not quantised
MAX_VOXELS = 2**17  # of a grid along an axis
MAX_BLOCKS = 2**23  # macroblocks of a grid: a cube of 6,000 voxels a side
MAX_WEIGHT = 1e6  # absolute value of a network weight, so that its outputs stay finite; trained networks stay below 100


def scene_json(scene: Scene, codec: CodecSettings = PNG, alternatives: Sequence[CodecSettings] = ()) -> dict[str, Any]:
    """The value of scene.json for a scene whose slices are stored with `codec`, and again with each of `alternatives`."""
    network = scene.network
    return {
        "format": FORMAT,
        "version": ROOTS_VERSION if scene.square_roots else VERSION,
        "voxel_size": float(scene.voxel_size),
        "shape": list(scene.shape),
        "grid_to_world": scene.grid_to_world.tolist(),
        "view_rotation": np.asarray(scene.view_rotation).tolist(),
        "near": float(scene.near),
        "codec": codec.to_json() if scene.quantised else FLOAT,
        **({"alternatives": [codec.to_json() for codec in alternatives]} if alternatives else {}),
        **({"square_roots": True} if scene.square_roots else {}),
        "cells": len(scene.cells),
        "atlas_blocks": list(atlas_blocks(len(scene.cells))),
        "ndc": None if scene.ndc is None else scene.ndc.to_json(),
        "fill_holes": scene.opacity_correction,
        "effects": scene.effects,
        "network_transmittance": NETWORK_TRANSMITTANCE,
        "network": None if network is None else {k: np.asarray(v, np.float64).tolist() for k, v in network._asdict().items()},
        "about": scene.about,
    }


def read_scene_json(folder: Path) -> dict[str, Any]:
    """The value of a folder's scene.json, of a version that is read; its other keys are not checked.

    Raises SnergError naming the file when it is missing, not JSON, not a scene or of another version.
    """
    path = folder / "scene.json"
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise SnergError(f"{path} is not a SNeRG scene; import scenes of other tools with 'snerg import'.")
    if not isinstance(value.get("version"), int) or value["version"] not in (VERSION, ROOTS_VERSION, *OLDER_VERSIONS):
        raise SnergError(f"{path} has version {value.get('version')} of the format; this SNeRG reads {ROOTS_VERSION}: update it.")
    return value


def codec_in(value: dict[str, Any]) -> CodecSettings | None:
    """The codec that scene.json names; None when the scene is not quantised.

    Raises KeyError, TypeError, ValueError or SnergError when it names no valid codec.
    """
    if value["version"] in OLDER_VERSIONS:
        return PNG
    return None if value["codec"] == FLOAT else CodecSettings.from_json(value["codec"])


def alternatives_in(value: dict[str, Any]) -> list[CodecSettings]:
    """The codecs with which a scene's images are stored once more, for readers that do not know the first one.

    Raises KeyError, TypeError, ValueError or SnergError when one is not valid.
    """
    return [CodecSettings.from_json(record(codec, "alternatives")) for codec in value.get("alternatives", [])]


def square_roots_in(value: dict[str, Any]) -> bool:
    """Whether a scene's cells hold square roots. Raises KeyError or ValueError where the key is missing or no flag."""
    return value["version"] == ROOTS_VERSION and flag(value["square_roots"], "square_roots")


def check_viewer_values(value: dict[str, Any]) -> None:
    """Check the values that Python does not use: "network_transmittance", which the web page reads, and "effects".

    Raises KeyError or ValueError when one is missing or invalid.
    """
    number(value["network_transmittance"], "network_transmittance", 0, 1)
    for name, chosen in record(value["effects"], "effects").items():
        flag(chosen, f"effects[{shown(name)}]")


def network_from_json(value: dict[str, Any]) -> ViewNetwork:
    """The view-dependence network from the key "network". Raises KeyError or ValueError on a missing or invalid weight."""
    arrays = [numbers(value[name], name, shape, MAX_WEIGHT) for name, shape in zip(ViewNetwork._fields, SHAPES, strict=True)]
    return ViewNetwork(*(array.astype(np.float32) for array in arrays))


def check_blocks(blocks: tuple[int, int, int]) -> None:
    """Raise ValueError when a grid has more macroblocks than any scene, before memory is allocated for them."""
    if math.prod(blocks) > MAX_BLOCKS:
        raise ValueError(f"its grid has {' x '.join(map(str, blocks))} macroblocks; the most is {MAX_BLOCKS} in all")
