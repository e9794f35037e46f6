"""Which voxels a camera ever sees (section 5.3): the skipping marcher, stopped where little light is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..capture.camera import Camera
from .box import DATA_VOXELS
from .march import MarchSettings, march_rays, tables_of
from .snerg import Snerg

Progress = Callable[[float, str], None]


def visible_voxels(
    opaque: Snerg, cameras: Sequence[Camera], threshold: float, progress: Progress = lambda fraction, what: None
) -> np.ndarray:
    """bool [M, 30, 30, 30] of a scene of alpha alone: voxels that a ray of some camera reaches with transmittance >= threshold.

    A camera's picture is marched at about two voxels a pixel, no finer than its own; dilate what comes back by two.
    """
    visited = np.zeros(len(tables_of(opaque).words), bool)
    settings = MarchSettings(stop_transmittance=threshold)
    for done, camera in enumerate(cameras):
        origins, directions = marching_camera(camera, opaque).rays()
        march_rays(opaque, origins, directions, settings, near=camera.near, visited=visited)
        progress((done + 1) / len(cameras), f"Visibility: camera {done + 1} of {len(cameras)}")
    cells = visited.reshape(-1, *(DATA_VOXELS + 2,) * 3)[: len(opaque.cells)]
    return cells[:, 1:-1, 1:-1, 1:-1]


def marching_camera(camera: Camera, scene: Snerg) -> Camera:
    """The camera with pixels of about two voxels at the middle of the scene, at most as many as it has."""
    scale = min(1.0, 0.5 / (pixels_a_unit(camera, scene) * scene.voxel_size))
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def pixels_a_unit(camera: Camera, scene: Snerg) -> float:
    """Pixels of a camera that a length of 1 of the scene's space covers, about the middle of the scene."""
    if camera.projection == "orthographic":
        return max(camera.focal)
    if scene.ndc is not None:  # as many at any depth for a camera where the frame is, about as many for its neighbours
        return max(mine / frame for mine, frame in zip(camera.focal, scene.ndc.focal, strict=True))
    box = scene.box
    return max(camera.focal) / max(float(np.linalg.norm(camera.position - box.box_to_world[:3, 3])), float(box.size.max()) / 4)
