"""Cameras spread evenly round a box, for scenes that have no cameras of their own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera, focal_from_angle

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
LOWEST = 0.02  # sine of the lowest elevation in a hemisphere: none looks along the ground exactly
MARGIN = 1.05  # distance, against the one at which the box's corners touch the picture's edge


@dataclass(frozen=True)
class RigSettings:
    """count: cameras. hemisphere: only from above the box's centre (world z up), or from all round.

    angle: field of view across the picture's shorter side, radians. distance: from the box's centre, world
    units; 0 chooses the one at which the whole box just fits.
    """

    count: int = 100
    hemisphere: bool = True
    angle: float = math.radians(40)
    distance: float = 0.0


def directions(count: int, hemisphere: bool) -> NDArray[Any]:
    """[count, 3] unit vectors spread evenly (Fibonacci lattice), z from the top down."""
    if count < 1:
        raise SnergError(f"The rig has {count} cameras; it needs at least 1.")
    lowest = LOWEST if hemisphere else -1.0
    z = 1 - (np.arange(count) + 0.5) / count * (1 - lowest)
    around = GOLDEN_ANGLE * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(around), radius * np.sin(around), z], axis=-1)


def look_at(position: NDArray[Any], target: NDArray[Any]) -> NDArray[Any]:
    """[4, 4] camera-to-world at `position` [3] that looks at `target` [3] with world z upwards in the picture."""
    back = position - target
    back = back / np.linalg.norm(back)
    up = np.array([0.0, 1.0, 0.0]) if abs(back[2]) > 0.9999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=-1)
    pose[:3, 3] = position
    return pose


def rig_cameras(box: Box, settings: RigSettings, width: int, height: int) -> tuple[Camera, ...]:
    """Cameras of `width` x `height` pixels that look at the box's centre.

    Raises SnergError when the field of view is not between 0 and pi, or the cameras would stand inside the box.
    """
    focal = focal_from_angle(settings.angle, min(width, height), "The rig")
    centre, radius = box.box_to_world[:3, 3], float(np.linalg.norm(box.size)) / 2
    distance = settings.distance or MARGIN * radius / math.sin(settings.angle / 2)
    if distance <= float(box.size.min()) / 2:
        raise SnergError(f"The rig stands {distance:.3g} from the box's centre, which is inside the box; move it further out.")
    common: dict[str, Any] = {"width": width, "height": height, "focal": (focal, focal), "centre": (width / 2, height / 2)}
    return tuple(
        Camera(**common, camera_to_world=look_at(centre + distance * direction, centre), name=f"Rig {index:03d}")
        for index, direction in enumerate(directions(settings.count, settings.hemisphere))
    )
