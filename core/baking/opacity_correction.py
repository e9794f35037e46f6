"""Whether a scene calls for equation 9: measured on rays of its cameras, the field's own against what was baked."""

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

MAX_CAMERAS = 8  # looked from, spread over all
RAYS_PER_CAMERA = 128  # of each


def opacity_correction_errors(
    field: Field, scene: Scene, cameras: Sequence[Camera], seed: int, tell: Callable[[float], None]
) -> dict[str, float]:
    """{"with": ..., "without": ...}: how far the rays of a scene that does without equation 9 are from the field's, with it and without it:
    root mean square of colour and transmittance.

    The equation makes up for light that a bake lets through surfaces (supplement C.3). Where the field itself is translucent, or was
    trained to let its background shine through, it takes away what belongs there. tell: called with the fraction done.
    """
    rng = np.random.default_rng(seed)
    values: dict[str, list[NDArray[Any]]] = {"field": [], "with": [], "without": []}
    some = cameras[:: -(-len(cameras) // MAX_CAMERAS)]
    for index, camera in enumerate(some):
        tell(index / len(some))
        origins, directions = camera.rays(rng.integers(0, (camera.width, camera.height), (RAYS_PER_CAMERA, 2)))
        near = max(scene.near, camera.near)
        baked = march_rays(scene, origins, directions, near=near)
        for name, rays in (
            ("field", field_rays(field, scene, origins, directions, near)),
            ("with", correct_opacity(baked)),
            ("without", baked),
        ):
            colour = shade(scene.network, rays, directions @ scene.view_rotation.T)
            values[name].append(np.concatenate([colour, rays.transmittance[:, None]], axis=-1))
    truth = np.concatenate(values.pop("field"))
    return {name: round(float(np.sqrt(np.mean((np.concatenate(parts) - truth) ** 2))), 5) for name, parts in values.items()}


def field_rays(field: Field, scene: Scene, origins: NDArray[Any], directions: NDArray[Any], near: float) -> Composited:
    """What rays of the world [N, 3] gather of a field inside a scene's grid."""
    *_, start, stop = intersect_grid(scene, origins, directions, near)
    o, d, *_ = space_rays(scene.ndc, origins, directions, near)
    gathered, through = through_space(field, o, d, start * scene.voxel_size, directions, stop * scene.voxel_size)
    return Composited(gathered[:, :3], gathered[:, 3:-1], through, gathered[:, -1])
