"""scene_params.json: the numbers of a scene in the reference layout. The published viewer fixes its keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.camera import Camera, focal_from_angle
from ..geometry.ndc import Ndc
from ..io.guard import why
from ..io.json_files import read_json
from ..io.schema import FAR, number, numbers, shown, whole
from ..nerf.model import SHAPES, ViewNetwork
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.scene import Scene
from .atlas import MAX_ATLAS_CELLS, SLICE_PLANES, atlas_blocks, slice_count
from .reference_axes import FLIP_Z, FRAME_FROM_VIEWER, layout_from_ndc
from .scene_json import MAX_WEIGHT

MAX_BLOCKS = 254  # macroblocks of the grid along an axis: within the 256 texels of a 3D texture that WebGL 2 guarantees
SNERG_KEY = "snerg_for_blender"  # holds what the layout has no key for, so that reading restores our scenes exactly
VIEWABLE_SIDES = (1.0, 4.0)  # viewer units: the longest side of a box that the viewer's first view shows well
SCALED_SIDE = 2.0  # viewer units: the longest side that other boxes are scaled to
VIEWER_SIZE, VIEWER_ANGLE = (1280, 720), math.radians(35)  # image and vertical angle of view of the viewer's first view
VIEWER_FRAME = {"input_focal": 755.644059435, "input_width": 1006.0, "input_height": 756.0}  # the published viewer's, for scenes without
FRAME_TO_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of other tools: looks along y, z up
NETWORK_KEYS = ("0_weights", "0_bias", "1_weights", "1_bias", "2_weights", "2_bias")  # in the order of ViewNetwork's fields


def scene_params(scene: Scene, turned: Scene, camera: Camera | None) -> dict[str, Any]:
    """The value of scene_params.json. turned: `scene` along the viewer's axes (reference_axes.viewer_scene).

    The viewer's origin is the box's centre, or in a forward-facing scene the origin of the device coordinates. If the network was
    trained in the world's axes and the scene is not scaled, worldspace_T_opengl takes the viewer's points to the world.
    """
    scale = viewer_scale(scene)
    corner, axes, origin = _viewer_placement(scene, turned, scale)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = scene.view_rotation @ axes, scene.view_rotation @ origin
    blocks = atlas_blocks(len(turned.cells))
    params: dict[str, Any] = {
        "voxel_size": turned.voxel_size * scale,
        "block_size": DATA_VOXELS,
        **dict(zip(("grid_width", "grid_height", "grid_depth"), turned.shape, strict=True)),
        **dict(zip(("atlas_width", "atlas_height", "atlas_depth"), [n * CELL_VOXELS for n in blocks], strict=True)),
        "num_slices": slice_count(blocks),
        **dict(zip(("min_x", "min_y", "min_z"), corner.tolist(), strict=True)),
        **dict(zip(("atlas_blocks_x", "atlas_blocks_y", "atlas_blocks_z"), blocks, strict=True)),
        **(_image_params(camera) if scene.ndc is None else _frame_params(scene.ndc)),
        "worldspace_T_opengl": pose.tolist(),
        "ndc": scene.ndc is not None,
        "format": "png",
    }
    if scene.network is not None:
        params |= {key: np.asarray(value, np.float64).tolist() for key, value in zip(NETWORK_KEYS, scene.network, strict=True)}
    return params | {SNERG_KEY: _snerg_params(scene, turned)}


def _snerg_params(scene: Scene, turned: Scene) -> dict[str, Any]:
    """The value of our key: what reference.restore needs."""
    turn = scene.grid_to_world[:3, :3].T @ layout_from_ndc(scene.ndc) @ turned.grid_to_world[:3, :3]
    return {
        "grid_to_world": scene.grid_to_world.tolist(),
        "view_rotation": np.asarray(scene.view_rotation).tolist(),
        "voxel_size": float(scene.voxel_size),
        "shape": list(scene.shape),
        "near": float(scene.near),
        "fill_holes": scene.opacity_correction,
        "viewer_axes": np.rint(turn).astype(int).tolist(),
        "about": scene.about,
        "ndc": None if scene.ndc is None else scene.ndc.to_json(),
    }


def _viewer_placement(scene: Scene, turned: Scene, scale: float) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The grid's corner [3] in viewer units, the viewer's axes [3, 3] in the world's, and the viewer's origin [3] in the world."""
    pose = turned.grid_to_world
    if scene.ndc is not None:
        return pose[:3, 3], scene.ndc.camera_to_world[:3, :3] @ FRAME_FROM_VIEWER, scene.ndc.camera_to_world[:3, 3]
    centre = scene.box.box_to_world[:3, 3]
    return (pose[:3, 3] - centre) @ pose[:3, :3] * scale, pose[:3, :3], centre


def viewer_scale(scene: Scene) -> float:
    """Viewer units a world unit: 1, unless the viewer's first camera would be inside the box or see it too small."""
    if scene.ndc is not None:
        return 1.0
    side = float(scene.box.size.max())
    return 1.0 if VIEWABLE_SIDES[0] <= side <= VIEWABLE_SIDES[1] else SCALED_SIDE / side


def _image_params(camera: Camera | None) -> dict[str, float]:
    """input_height, input_width and input_focal in pixels: of the camera, or of the viewer's first view."""
    if camera is None:
        width, height = VIEWER_SIZE
        return {
            "input_height": float(height),
            "input_width": float(width),
            "input_focal": focal_from_angle(VIEWER_ANGLE, height, "The viewer"),
        }
    return {"input_height": float(camera.height), "input_width": float(camera.width), "input_focal": float(camera.focal[0])}


def _frame_params(ndc: Ndc) -> dict[str, float]:
    """input_height, input_width and input_focal of a frame: the viewer uses only their ratios."""
    focal = 500 * ndc.focal[0]
    return {"input_height": 2 * focal / ndc.focal[1], "input_width": 1000.0, "input_focal": focal}


@dataclass(frozen=True, eq=False)
class ReferenceParams:
    """scene_params.json, checked."""

    voxel_size: float  # viewer units
    shape: tuple[int, int, int]  # of the grid: voxels along x, y and z
    low: NDArray[Any]  # [3] the grid's corner, viewer units
    atlas: tuple[int, int, int]  # cells along x, y and z
    pose: NDArray[Any]  # [4, 4] rigid: worldspace_T_opengl; in a forward-facing scene, the frame's axes to the network's
    network: ViewNetwork | None  # None in a diffuse scene
    ours: dict[str, Any]  # the value of our key, or {} in a scene of another tool
    ndc: Ndc | None  # of a forward-facing scene


def read_params(folder: Path) -> ReferenceParams:
    """Read and check scene_params.json. Raises SnergError naming the file and what is wrong with it."""
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
    if value.get("format", "png") != "png":
        raise ValueError(f"its images are of format {value['format']!r}; only 'png' is read")
    if int(value["block_size"]) != DATA_VOXELS:
        raise ValueError(f"its blocks are of {value['block_size']} voxels; only {DATA_VOXELS} are read")
    x, y, z = (_count(value, key, MAX_BLOCKS * DATA_VOXELS) for key in ("grid_width", "grid_height", "grid_depth"))
    ours, forward = value.get(SNERG_KEY, {}), bool(value.get("ndc"))
    return ReferenceParams(
        voxel_size=_finite(value, "voxel_size", positive=True),
        shape=(x, y, z),
        low=np.array([_finite(value, f"min_{axis}") for axis in "xyz"]),
        atlas=_atlas(value),
        pose=_frame_pose(value["worldspace_T_opengl"]) if forward else _pose(value["worldspace_T_opengl"]),
        network=_network(value) if "0_bias" in value else None,
        ours=ours if isinstance(ours, dict) else {},
        ndc=_ndc(value) if forward else None,
    )


def _atlas(value: dict[str, Any]) -> tuple[int, int, int]:
    """Cells of the atlas along x, y and z, from its size in voxels.

    Raises ValueError when that is no multiple of a cell, or atlas_blocks_x, _y, _z (which the viewer does not read) or num_slices do
    not match it.
    """
    found = []
    for axis, key in zip("xyz", ("atlas_width", "atlas_height", "atlas_depth"), strict=True):
        voxels = _count(value, key, MAX_ATLAS_CELLS * CELL_VOXELS)
        cells = _count(value, f"atlas_blocks_{axis}", MAX_ATLAS_CELLS) if f"atlas_blocks_{axis}" in value else voxels // CELL_VOXELS
        if voxels != cells * CELL_VOXELS or not cells:
            raise ValueError(f"{key} is {value[key]} where its blocks make {max(cells, 1) * CELL_VOXELS}")
        found.append(cells)
    x, y, z = found
    if int(value["num_slices"]) * SLICE_PLANES != z * CELL_VOXELS:
        raise ValueError(f"num_slices is {value['num_slices']} where the atlas makes {slice_count((x, y, z))}")
    return x, y, z


def _count(value: dict[str, Any], key: str, most: int) -> int:
    """A whole number from 1 to `most`; other tools may write it as 30.0."""
    given = number(value[key], key)
    return whole(int(given) if given == int(given) else given, key, 1, most)


def _finite(value: dict[str, Any], key: str, positive: bool = False) -> float:
    found = float(value[key])
    if not abs(found) <= FAR or (positive and found <= 0):
        raise ValueError(f"{key} is {shown(value[key])}; it must be finite{' and above 0' if positive else ''}")
    return found


def _pose(rows: Any) -> NDArray[Any]:
    """worldspace_T_opengl, float64 [4, 4]; raises ValueError when it is not rigid."""
    pose = np.array(rows, np.float64)
    if pose.shape != (4, 4) or not (np.abs(pose) <= FAR).all():
        raise ValueError("worldspace_T_opengl is not a finite 4 x 4 matrix")
    axes = pose[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("worldspace_T_opengl scales, shears or mirrors; only a rotation and a translation can be used")
    return pose


def _frame_pose(rows: Any) -> NDArray[Any]:
    """[4, 4] from the axes of a forward-facing scene's frame to the network's.

    The reference implementation writes FLIP_Z there, which reverses its grid and not view directions: the axes are the same.
    """
    matrix = np.array(rows, np.float64)
    if matrix.shape == (4, 4) and np.array_equal(matrix[:3, :3], FLIP_Z):
        return np.eye(4)
    pose = _pose(rows)
    pose[:3, :3] = pose[:3, :3] @ FRAME_FROM_VIEWER
    return pose


def _ndc(value: dict[str, Any]) -> Ndc:
    """The frame of a forward-facing scene of another tool, with its near plane at 1; where none is stated, the published viewer's own."""
    stated = value if "input_focal" in value else VIEWER_FRAME
    focal, width, height = (_finite(stated, f"input_{key}", positive=True) for key in ("focal", "width", "height"))
    return Ndc(FRAME_TO_WORLD, (2 * focal / width, 2 * focal / height), 1.0)


def _network(value: dict[str, Any]) -> ViewNetwork:
    arrays = [numbers(value[key], key, shape, MAX_WEIGHT) for key, shape in zip(NETWORK_KEYS, SHAPES, strict=True)]
    return ViewNetwork(*(array.astype(np.float32) for array in arrays))
