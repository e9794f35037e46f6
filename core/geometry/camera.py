"""Cameras: intrinsics, pose and the rays of their pixels.

OpenGL convention: x right, y up, looking down -z; the world is Blender's, z up. Pixel (column, row) has
its centre at (column + 0.5, row + 0.5), row 0 at the top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import why
from ..io.schema import FAR, text
from ..io.settings import is_whole
from . import wide
from .distortion import MAX_ANGLE, Distortion

PROJECTIONS = ("perspective", "orthographic", *wide.PROJECTIONS)
MAX_PIXELS = 2**28  # of an image; the rays of a larger one fill the memory
LEAST_COSINE = 1e-9  # to the view axis, of a ray that a picture holds: lenses of 180 degrees and more are wide ones
PART = 2**14  # points that are projected at a time: they stay in a processor's cache


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera, with lens distortion if it has any, an orthographic one, or a wide one: a panorama or a fisheye (see wide.py).

    Depth, and so the near and the far plane, is along the view axis, but of a wide camera along the ray.
    Raises SnergError when a value is out of range or not finite.
    """

    width: int  # pixels
    height: int  # pixels
    focal: tuple[float, float]  # (x, y) in pixels; of an orthographic camera, pixels per world unit; of a wide one, pixels per radian
    centre: tuple[float, float]  # (x, y) principal point in pixels from the top left corner
    camera_to_world: NDArray[Any]  # [4, 4] float64, rigid (see `rigid`)
    projection: str = "perspective"  # or 'orthographic', 'equirectangular' (a panorama) or 'fisheye'
    name: str = ""
    near: float = 0.0  # depth, in world units, before which nothing is visible
    distortion: Distortion | None = None  # of the lens; None for an ideal one
    far: float = math.inf  # depth, in world units, behind which nothing is visible
    widest: float = math.pi  # of a fisheye: radians from the view axis beyond which its picture shows nothing

    def __post_init__(self) -> None:
        if not all(is_whole(n) and n >= 1 for n in (self.width, self.height)):
            raise SnergError(
                f"Camera {self.name!r} has a picture of {self.width} x {self.height} pixels; both must be whole numbers of 1 or more."
            )
        if self.projection not in PROJECTIONS:
            raise SnergError(f"Camera {self.name!r} is {self.projection}; its projection must be one of {', '.join(PROJECTIONS)}.")
        if self.width * self.height > MAX_PIXELS:
            raise SnergError(f"Camera {self.name!r} has a picture of {self.width} x {self.height} pixels; the most is {MAX_PIXELS} in all.")
        if not (math.isfinite(self.near) and self.near >= 0):
            raise SnergError(f"Camera {self.name!r} has its near plane at {self.near}; it must be finite and not below 0.")
        if not self.far > self.near:
            raise SnergError(f"Camera {self.name!r} has its far plane at {self.far}; it must be behind its near plane at {self.near}.")
        if not all(math.isfinite(f) and f > 0 for f in self.focal):
            raise SnergError(f"Camera {self.name!r} has a focal length of {self.focal} pixels; it must be finite and above 0.")
        if not np.isfinite(self.centre).all():
            raise SnergError(f"Camera {self.name!r} has a principal point of {self.centre}; it must be finite.")
        if self.distortion is not None and self.projection not in ("perspective", "fisheye"):
            raise SnergError(f"Camera {self.name!r} is {self.projection} and has a lens; only perspective cameras and fisheyes have one.")
        if self.projection == "fisheye" and self.distortion is not None and self.distortion.model != "fisheye":
            raise SnergError(f"Camera {self.name!r} is a fisheye with a lens of the model {self.distortion.model}; it must be 'fisheye'.")
        if not 0 < self.widest <= math.pi:
            raise SnergError(f"Camera {self.name!r} sees {self.widest} radians from its axis; it must be above 0 and at most pi.")
        object.__setattr__(self, "camera_to_world", rigid(self.camera_to_world, f"Camera {self.name!r}"))

    @property
    def position(self) -> NDArray[Any]:
        """[3] float64, world units."""
        return self.camera_to_world[:3, 3]

    @property
    def is_wide(self) -> bool:
        """Whether it is a panorama or a fisheye that is computed in angles: its depth is the distance from the camera."""
        return self.projection in wide.PROJECTIONS

    def cosines(self, directions: NDArray[Any]) -> NDArray[Any]:
        """Depth per length along rays of unit directions [N, 3], [N]: the cosine to the view axis, which is 1 for a wide camera."""
        return np.ones(len(directions)) if self.is_wide else np.asarray(directions @ -self.camera_to_world[:3, 2])

    def clip_distances(self, directions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """World units along rays of unit directions [N, 3] to the near and to the far plane, [N] each.

        Both are planes across the view axis, so that a ray at a picture's edge meets them later than one in its middle; of a wide camera
        they are spheres. Of a direction that meets no plane they are finite, or inf, and say nothing.
        """
        cosines = np.maximum(self.cosines(directions), LEAST_COSINE)
        return self.near / cosines, self.far / cosines

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution in pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            centre=(self.centre[0] * sx, self.centre[1] * sy),
        )

    def rays(self, pixels: NDArray[Any] | None = None) -> tuple[NDArray[Any], NDArray[Any]]:
        """The rays through pixel centres: origins [N, 3] and unit directions [N, 3], world axes, float64.

        pixels: [N, 2] (column, row) integers; all pixels, row by row, when None.
        """
        pixels = self.pixels() if pixels is None else pixels
        flat = self._normalised(pixels)
        if self.is_wide:
            wide_directions = wide.directions(self.projection, flat, self._angular()) @ self.camera_to_world[:3, :3].T
            return np.broadcast_to(self.position, wide_directions.shape).copy(), wide_directions
        if self.distortion is not None:
            flat = self.distortion.undistort(flat)
        x, y = flat[:, 0], -flat[:, 1]
        rotation, position = self.camera_to_world[:3, :3], self.position
        if self.projection == "orthographic":
            origins = position + np.stack([x, y, np.zeros_like(x)], axis=-1) @ rotation.T
            return origins, np.broadcast_to(-rotation[:, 2], origins.shape).copy()
        directions = np.stack([x, y, -np.ones_like(x)], axis=-1) @ rotation.T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(position, directions.shape).copy(), directions

    def pixels(self) -> NDArray[Any]:
        """(column, row) of every pixel, row by row, int [H * W, 2]."""
        rows, columns = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack([columns.ravel(), rows.ravel()], axis=-1)

    def valid_pixels(self) -> NDArray[Any] | None:
        """The pixels for which the distortion model is valid (see Distortion.is_valid), and that a fisheye shows, bool [H, W]; None if
        these are all."""
        if self.projection == "fisheye":
            k = self._angular()
            seen = wide.angles(np.linalg.norm(self._normalised(self.pixels()), axis=-1), k) <= min(self.widest, wide.last_angle(k))
            return None if seen.all() else seen.reshape(self.height, self.width)
        if self.distortion is None:
            return None
        across, down = np.arange(self.width), np.arange(self.height)
        edges = [np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in ((across, 0), (across, self.height - 1))]
        edges += [np.stack(np.broadcast_arrays(x, down), axis=-1) for x in (0, self.width - 1)]
        if self.distortion.is_valid(self._normalised(np.concatenate(edges))).all():
            return None  # the valid region has no holes, so that its border decides
        return self.distortion.is_valid(self._normalised(self.pixels())).reshape(self.height, self.width)

    def reduced(self, factor: int) -> Camera:
        """The camera of an image reduced by `factor` (see images.reduced). Raises SnergError when no pixel is left."""
        if factor == 1:
            return self
        width, height = self.width // factor, self.height // factor
        if width < 1 or height < 1:
            raise SnergError(f"Camera {self.name!r} has {self.width} x {self.height} pixels; dividing by {factor} leaves nothing of them.")
        focal, centre = (
            (self.focal[0] / factor, self.focal[1] / factor),
            (self.centre[0] / factor, self.centre[1] / factor),
        )
        return replace(self, width=width, height=height, focal=focal, centre=centre)

    def moved(self, similarity: NDArray[Any]) -> Camera:
        """The camera transformed by a similarity [4, 4] to another world; its near and far distances are scaled as well."""
        scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
        focal = self.focal if self.projection != "orthographic" else (self.focal[0] / scale, self.focal[1] / scale)
        return replace(self, camera_to_world=similarity @ self.camera_to_world, near=self.near * scale, far=self.far * scale, focal=focal)

    def _normalised(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Pixels (column, row) [N, 2] to normalised image coordinates [N, 2] of their centres: at depth 1, x right, y down."""
        return np.asarray((pixels + 0.5 - np.array(self.centre)) / np.array(self.focal))

    def _angular(self) -> wide.Coefficients:
        return () if self.distortion is None else self.distortion.coefficients

    def widened(self) -> Camera:
        """The camera as a fisheye that is computed in angles, where its lens is a fisheye whose picture reaches past MAX_ANGLE."""
        if self.projection != "perspective" or self.distortion is None or self.distortion.model != "fisheye":
            return self
        corners = np.array([[x, y] for x in (0, self.width - 1) for y in (0, self.height - 1)])
        radius = np.linalg.norm(self._normalised(corners), axis=-1).max()
        k = self._angular()
        limit = math.radians(MAX_ANGLE)
        past = wide.last_angle(k) > limit and radius > wide.distorted(np.array([limit]), k)[0]
        return replace(self, projection="fisheye") if past else self

    def project(self, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """World points [N, 3] to (pixel coordinates [N, 2], depth [N]: along the view axis, or of a wide camera the distance)."""
        pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
        for start in range(0, len(points), PART):
            part = slice(start, start + PART)
            pixels[part], depth[part] = self._project(points[part])
        return pixels, depth

    def _project(self, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """The same, of as many points as stay in a processor's cache."""
        local = (points - self.position) @ self.camera_to_world[:3, :3]
        if self.is_wide:
            pixels = np.array(self.centre) + np.array(self.focal) * wide.flats(self.projection, local, self._angular(), self.widest)
            if self.projection == "equirectangular":
                pixels[:, 0] %= 2 * math.pi * self.focal[0]  # all round: from the left border on
            return pixels, np.linalg.norm(local, axis=-1)
        depth = -local[:, 2]
        scale = np.ones_like(depth) if self.projection == "orthographic" else 1 / np.where(depth == 0, np.inf, depth)
        flat = np.empty((len(local), 2))  # a column at a time: NumPy is slow where rows are short
        np.multiply(local[:, 0], scale, out=flat[:, 0])
        np.multiply(-local[:, 1], scale, out=flat[:, 1])
        if self.distortion is not None:
            flat = self.distortion.distort(flat)
        for axis in (0, 1):
            flat[:, axis] = self.centre[axis] + self.focal[axis] * flat[:, axis]
        return flat, depth

    def stretch(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """How much longer than in the middle an angle is at pixel coordinates [N, 2] of a wide camera, [N] (see wide.stretch)."""
        flat = (pixels - np.array(self.centre)) / np.array(self.focal)
        return wide.stretch(self.projection, flat, self._angular())

    def shows(self, points: NDArray[Any]) -> NDArray[Any]:
        """Whether world points [N, 3] lie in the camera's frustum, bool [N]. Occlusion is not considered."""
        pixels, depth = self.project(points)
        return np.asarray((depth > self.near) & (depth < self.far) & ((pixels >= 0) & (pixels <= [self.width, self.height])).all(axis=-1))

    def toward(self, points: NDArray[Any]) -> NDArray[Any]:
        """View directions of world points [N, 3], unit vectors [N, 3] float64; undefined for a point at the camera's position."""
        if self.projection == "orthographic":
            return np.broadcast_to(-self.camera_to_world[:3, 2], points.shape).copy()
        offset = points - self.position
        return np.asarray(offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-12))

    def to_json(self) -> dict[str, Any]:
        """The camera as JSON values, for `from_json`."""
        return {
            "name": self.name,
            "projection": self.projection,
            "width": self.width,
            "height": self.height,
            "focal": [float(f) for f in self.focal],
            "centre": [float(c) for c in self.centre],
            "near": float(self.near),
            **({"far": float(self.far)} if math.isfinite(self.far) else {}),
            "camera_to_world": self.camera_to_world.tolist(),
            **({"distortion": self.distortion.to_json()} if self.distortion is not None else {}),
            **({"widest": float(self.widest)} if self.widest < math.pi else {}),
        }

    @classmethod
    def from_json(cls, value: Any) -> Camera:
        """A camera from the result of `to_json`. Raises SnergError when a value is missing or out of range."""
        try:
            focal, centre = value["focal"], value["centre"]
            return cls(
                width=int(value["width"]),
                height=int(value["height"]),
                focal=(float(focal[0]), float(focal[1])),
                centre=(float(centre[0]), float(centre[1])),
                camera_to_world=np.array(value["camera_to_world"], np.float64),
                projection=str(value["projection"]),
                name=text(value["name"], "name"),
                near=float(value["near"]),
                far=float(value.get("far", math.inf)),
                distortion=Distortion.from_json(value["distortion"]) if value.get("distortion") is not None else None,
                widest=float(value.get("widest", math.pi)),
            )
        except SnergError:
            raise
        except Exception as error:  # whatever a value of another kind raises
            raise SnergError(f"A camera is incomplete or damaged ({why(error)}); write the file again.") from error


def panorama_focal(width: float, height: float) -> tuple[float, float]:
    """The focal lengths, in pixels per radian, of a panorama of `width` x `height` pixels that shows 360 x 180 degrees."""
    return width / (2 * math.pi), height / math.pi


def focal_from_angle(angle: float, pixels: int, where: str) -> float:
    """The focal length in pixels of a pinhole camera whose field of view is `angle` radians across `pixels` pixels.

    Raises SnergError, which begins with `where`, when the angle is not between 1e-6 and pi - 1e-6: outside, the focal length would not
    be a finite number above 0 (hard case 4).
    """
    if not (math.isfinite(angle) and 1e-6 < angle < math.pi - 1e-6):
        raise SnergError(f"{where} has a field of view of {angle} radians; it must lie between 0 and pi.")
    return 0.5 * pixels / math.tan(0.5 * angle)


def rigid(matrix: NDArray[Any], where: str) -> NDArray[Any]:
    """The rigid pose [4, 4] float64 nearest to `matrix` [4, 4] or [3, 4]: without scale and shear (hard case 5: scaled cameras).

    The rotation is the polar factor of the normalised axes (by SVD). Raises SnergError when the matrix is not finite, singular, or
    contains a reflection.
    """
    matrix = np.array(matrix, dtype=np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or not (np.abs(matrix) <= FAR).all():
        raise SnergError(f"{where} has a pose that is not a finite 4 x 4 matrix; check the file that it came from.")
    axes = matrix[:3, :3]
    lengths = np.linalg.norm(axes, axis=0)
    if lengths.min() < 1e-12:
        raise SnergError(f"{where} has a pose with an axis of length 0; give the object a scale other than 0.")
    determinant = np.linalg.det(axes / lengths)
    if determinant < 1e-3:
        what = "mirrors space" if determinant < -1e-3 else "is flat"
        raise SnergError(f"{where} has a pose that {what}; its scale must be positive and its axes independent.")
    u, _, vt = np.linalg.svd(axes / lengths)
    result = np.eye(4)
    result[:3, :3] = u @ vt
    result[:3, 3] = matrix[:3, 3]
    return result
