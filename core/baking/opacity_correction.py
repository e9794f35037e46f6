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
from ..rendering.packet_traversal import enter
from ..rendering.render import filled, march_rays
from ..scene.scene import Scene

CAMERAS = 8  # looked from, spread over all
RAYS = 128  # of each


def hole_errors(field: Field, snerg: Scene, cameras: Sequence[Camera], seed: int, tell: Callable[[float], None]) -> dict[str, float]:
    """{"with": ..., "without": ...}: how far the rays of a scene that does without equation 9 are from the field's, with it and without it:
    root mean square of colour and transmittance.

    The equation makes up for light that a bake lets through surfaces (supplement C.3). Where the field itself is translucent, or was
    trained to let its background shine through, it takes away what belongs there. tell: called with the fraction done.
    """
    rng = np.random.default_rng(seed)
    values: dict[str, list[NDArray[Any]]] = {"field": [], "with": [], "without": []}
    some = cameras[:: -(-len(cameras) // CAMERAS)]
    for index, camera in enumerate(some):
        tell(index / len(some))
        origins, directions = camera.rays(rng.integers(0, (camera.width, camera.height), (RAYS, 2)))
        near = max(snerg.near, camera.near)
        baked = march_rays(snerg, origins, directions, near=near)
        for name, rays in (("field", field_rays(field, snerg, origins, directions, near)), ("with", filled(baked)), ("without", baked)):
            colour = shade(snerg.network, rays, directions @ snerg.view_rotation.T)
            values[name].append(np.concatenate([colour, rays.transmittance[:, None]], axis=-1))
    truth = np.concatenate(values.pop("field"))
    return {name: round(float(np.sqrt(np.mean((np.concatenate(parts) - truth) ** 2))), 5) for name, parts in values.items()}


def field_rays(field: Field, snerg: Scene, origins: NDArray[Any], directions: NDArray[Any], near: float) -> Composited:
    """What rays of the world [N, 3] gather of a field inside a scene's grid."""
    *_, start, stop = enter(snerg, origins, directions, near)
    o, d, *_ = space_rays(snerg.ndc, origins, directions, near)
    gathered, through = through_space(field, o, d, start * snerg.voxel_size, directions, stop * snerg.voxel_size)
    return Composited(gathered[:, :3], gathered[:, 3:-1], through, gathered[:, -1])
