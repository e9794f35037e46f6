"""A rig of cameras spread evenly around a box, for Blender scenes without cameras of their own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera, focal_from_angle
from ..io.schema import FAR
from ..io.settings import check_number, is_whole

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
MIN_ELEVATION_SINE = 0.02  # of a camera in a hemisphere, so that none looks exactly along the ground
CLIP_RATIO = 100.0  # of the clip planes to the distance: the far one to it, and it to the near one
MARGIN = 1.05  # distance relative to that at which the box's circumscribed sphere touches the image's border


@dataclass(frozen=True)
class RigSettings:
    """The number and the arrangement of a rig's cameras. Raises SnergError for values that no rig has."""

    count: int = 100  # cameras
    hemisphere: bool = True  # only above the box's centre (world z up), else on the whole sphere
    angle: float = math.radians(40)  # field of view across the image's shorter side, radians
    distance: float = 0.0  # from the box's centre, world units; 0: the smallest at which the whole box is visible

    def __post_init__(self) -> None:
        if not (is_whole(self.count) and self.count >= 1):
            raise SnergError(f"The rig has {self.count} cameras; it needs at least 1.")
        check_number("The field of view of the rig's cameras, in radians,", self.angle, 0, math.pi)
        check_number("The distance of the rig's cameras", self.distance, 0, FAR)


def directions(count: int, hemisphere: bool) -> NDArray[Any]:
    """Unit vectors [count, 3] spread evenly (Fibonacci lattice), in order of decreasing z. Raises SnergError when count is below 1."""
    if count < 1:
        raise SnergError(f"The rig has {count} cameras; it needs at least 1.")
    lowest = MIN_ELEVATION_SINE if hemisphere else -1.0
    z = 1 - (np.arange(count) + 0.5) / count * (1 - lowest)
    around = GOLDEN_ANGLE * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(around), radius * np.sin(around), z], axis=-1)


def look_at(position: NDArray[Any], target: NDArray[Any]) -> NDArray[Any]:
    """The camera-to-world matrix [4, 4] of a camera at `position` [3] that looks at `target` [3], with world z up in the image."""
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
    """Cameras of `width` x `height` pixels that look at the box's centre, with clip planes for the box's size.

    Raises SnergError when the field of view is not between 0 and pi, or the cameras would stand inside the box.
    """
    focal = focal_from_angle(settings.angle, min(width, height), "The rig")
    centre, radius = box.box_to_world[:3, 3], float(np.linalg.norm(box.size)) / 2
    distance = settings.distance or MARGIN * radius / math.sin(settings.angle / 2)
    if distance <= float(box.size.min()) / 2:
        raise SnergError(f"The rig stands {distance:.3g} from the box's centre, which is inside the box; move it further out.")
    common: dict[str, Any] = {"width": width, "height": height, "focal": (focal, focal), "centre": (width / 2, height / 2)}
    common |= {"near": distance / CLIP_RATIO, "far": distance * CLIP_RATIO}
    return tuple(
        Camera(**common, camera_to_world=look_at(centre + distance * direction, centre), name=f"Rig {index:03d}")
        for index, direction in enumerate(directions(settings.count, settings.hemisphere))
    )
