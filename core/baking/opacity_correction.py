"""Decides whether a scene needs the opacity correction (eq. 9), by comparing rays of the bake with rays of the field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.ndc import space_rays
from ..nerf.field import Field
from ..nerf.frame import Composited, shade
from ..nerf.render import through_space
from ..rendering.opacity import correct_opacity
from ..rendering.packet_traversal import intersect_grid
from ..rendering.render import march_rays
from ..scene.scene import Scene

MAX_CAMERAS = 8  # cameras whose rays are compared, spread evenly over all
RAYS_PER_CAMERA = 128  # random pixels of each


def opacity_correction_errors(
    field: Field, scene: Scene, cameras: Sequence[Camera], seed: int, tell: Callable[[float], None]
) -> dict[str, float]:
    """{"with": error, "without": error}: the error of the baked scene against the field, with and without opacity correction (eq. 9).

    The error is the root mean square difference of colour and transmittance, both in [0, 1], over random rays of the cameras. `scene` must
    have no correction. Sampling at voxel resolution makes opaque surfaces partly transparent, and eq. 9 corrects that (supplement C.3).
    Where the field itself is translucent, or was trained to show its background, the correction makes the scene too opaque.
    tell: a function that is called with the fraction done, in [0, 1).
    """
    rng = np.random.default_rng(seed)
    values: dict[str, list[NDArray[Any]]] = {"field": [], "with": [], "without": []}
    chosen = cameras[:: -(-len(cameras) // MAX_CAMERAS)]
    for index, camera in enumerate(chosen):
        tell(index / len(chosen))
        origins, directions = camera.rays(rng.integers(0, (camera.width, camera.height), (RAYS_PER_CAMERA, 2)))
        near, far = camera.clip_distances(directions)
        near = np.maximum(scene.near, near)
        baked = march_rays(scene, origins, directions, near=near, far=far)
        rays_by_name = {"field": field_rays(field, scene, origins, directions, near, far), "with": correct_opacity(baked), "without": baked}
        for name, rays in rays_by_name.items():
            colour = shade(scene.network, rays, directions @ scene.view_rotation.T)
            values[name].append(np.concatenate([colour, rays.transmittance[:, None]], axis=-1))
    truth = np.concatenate(values.pop("field"))
    return {name: round(float(np.sqrt(np.mean((np.concatenate(parts) - truth) ** 2))), 5) for name, parts in values.items()}


def field_rays(
    field: Field, scene: Scene, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any], far: NDArray[Any] | None = None
) -> Composited:
    """The field composited along rays of the world (origins, directions [N, 3] float64) between near and far [N], inside a scene's grid."""
    *_, start, stop = intersect_grid(scene, origins, directions, near, far)
    o, d, *_ = space_rays(scene.ndc, origins, directions, near)
    values, transmittance = through_space(field, o, d, start * scene.voxel_size, directions, stop * scene.voxel_size)
    return Composited(values[:, :3], values[:, 3:-1], transmittance, values[:, -1])
