"""Blender's panoramic cameras as core's wide ones (see core/geometry/wide.py), and back.

Measured on renders of Cycles: the middle of an equirectangular picture is ahead, its right is the camera's right; an equidistant fisheye
stretches its circle over the whole picture, and shows nothing outside of the circle. The clip planes are distances along the rays.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np

from ..core.errors import SnergError
from ..core.geometry.camera import Camera

SUPPORTED = ("EQUIRECTANGULAR", "FISHEYE_EQUIDISTANT")


def lens_of(data: bpy.types.Camera) -> Any:
    """What holds a camera's panoramic settings: the camera, or before Blender 5.0 Cycles' part of it."""
    return data if hasattr(data, "panorama_type") else data.cycles


def panoramic_camera(camera: bpy.types.Object, name: str, pose: np.ndarray, width: int, height: int) -> Camera:
    """The core camera of an evaluated panoramic one. pose: [4, 4], its matrix; width, height: pixels.

    Raises SnergError where its panorama type is not one of SUPPORTED, or it is shifted.
    """
    data = camera.data
    lens = lens_of(data)
    kind = lens.panorama_type
    if kind not in SUPPORTED:
        title = lens.bl_rna.properties["panorama_type"].enum_items[kind].name
        raise SnergError(
            f"The camera {name!r} is pano with the type {title}; of panoramic cameras Equirectangular and Fisheye Equidistant can be used."
        )
    if data.shift_x or data.shift_y:
        raise SnergError(f"The panoramic camera {name!r} is shifted, which is not supported; set its shift to 0, or turn it instead.")
    common: dict[str, Any] = {"width": width, "height": height, "camera_to_world": pose, "name": name}
    common |= {"near": float(data.clip_start), "far": float(data.clip_end)}
    if kind == "FISHEYE_EQUIDISTANT":
        angle = float(lens.fisheye_fov)
        widest = min(angle / 2, math.pi)
        return Camera(focal=(width / angle, height / angle), centre=(width / 2, height / 2), projection="fisheye", widest=widest, **common)
    across, up = lens.longitude_max - lens.longitude_min, lens.latitude_max - lens.latitude_min
    if not (0 < across <= 2 * math.pi + 1e-5 and 0 < up <= math.pi + 1e-5):
        raise SnergError(f"The panoramic camera {name!r} shows {across:.3g} x {up:.3g} radians; its minima must be below its maxima.")
    focal = width / across, height / up
    return Camera(
        focal=focal, centre=(-lens.longitude_min * focal[0], lens.latitude_max * focal[1]), projection="equirectangular", **common
    )


def set_panoramic(data: bpy.types.Camera, source: Camera) -> None:
    """Give a Blender camera the projection of a wide one. A fisheye's distortion, centre and other focal length along y are left out."""
    data.type, data.shift_x, data.shift_y = "PANO", 0.0, 0.0
    lens = lens_of(data)
    (width, height), (fx, fy), (cx, cy) = (source.width, source.height), source.focal, source.centre
    if source.projection == "fisheye":
        lens.panorama_type, lens.fisheye_fov = "FISHEYE_EQUIDISTANT", width / fx
        return
    lens.panorama_type = "EQUIRECTANGULAR"
    lens.longitude_min, lens.longitude_max = -cx / fx, (width - cx) / fx
    lens.latitude_min, lens.latitude_max = (cy - height) / fy, cy / fy
