"""Panoramas and fisheyes past 180 degrees: rays, projections and where they end, against formulas written out here."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from scenes import looking
from snerg.core.errors import SnergError
from snerg.core.geometry import wide
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion

POSE = looking((1.0, -4.0, 2.0), (0.3, 0.2, 0.1))
PANORAMA = Camera(64, 32, panorama_focal(64, 32), (32, 16), POSE, "equirectangular")
LENS = Distortion("fisheye", (0.03, -0.01, 0.002, -0.0002))
FISHEYE = Camera(
    60, 60, (16.0, 16.5), (30, 29), POSE, "fisheye", distortion=LENS
)  # sees 100 degrees from its axis, and more in the corners


def local(camera: Camera, directions: np.ndarray) -> np.ndarray:
    return directions @ camera.camera_to_world[:3, :3]


def test_a_panorama_looks_where_nerfstudio_and_blender_say():
    """The middle of the picture is ahead, its quarter to the left is left, its top is up."""
    at = np.array([[31.5, 15.5], [15.5, 15.5], [47.5, 15.5], [31.5, -0.5], [-0.5, 15.5]])
    found = local(PANORAMA, PANORAMA.rays(at)[1])
    assert np.allclose(found, [[0, 0, -1], [-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE, replace(FISHEYE, distortion=None)], ids=["panorama", "fisheye", "ideal fisheye"])
def test_projection_is_the_inverse_of_rays(camera):
    pixels = camera.pixels()
    origins, directions = camera.rays(pixels)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    seen = camera.valid_pixels()
    kept = np.ones(len(pixels), bool) if seen is None else seen.reshape(-1)
    distance = np.linspace(1, 5, len(pixels))
    found, depth = camera.project(origins + directions * distance[:, None])
    assert np.allclose(found[kept], pixels[kept] + 0.5, atol=1e-6) and np.allclose(depth, distance)
    assert camera.shows(origins + directions).reshape(-1)[kept].all()


def test_a_fisheye_past_180_degrees():
    """Kannala and Brandt's polynomial of the angle, also behind the camera."""
    angle = math.radians(105)
    point = FISHEYE.position + FISHEYE.camera_to_world[:3, :3] @ [math.sin(angle), 0, -math.cos(angle)]
    k1, k2, k3, k4 = LENS.coefficients
    radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    assert np.allclose(FISHEYE.project(point[None])[0], [30 + 16 * radius, 29])


def test_where_a_fisheye_ends():
    """Beyond `widest` or the fold of its polynomial nothing is shown, and no pixel is trained on."""
    narrow = replace(FISHEYE, distortion=None, widest=math.radians(60))
    seen = narrow.valid_pixels()
    assert seen is not None and seen[29, 30] and not seen[0, 0] and 0.25 < seen.mean() < 0.3
    outside = narrow.rays(np.array([[0, 0]]))
    assert not narrow.shows(outside[0] + outside[1])[0]
    folded = replace(FISHEYE, distortion=Distortion("fisheye", (-0.2,)))
    assert wide.last_angle((-0.2, 0, 0, 0)) == pytest.approx(math.sqrt(1 / 0.6), abs=1e-2)
    assert folded.valid_pixels() is not None and np.isfinite(folded.rays()[1]).all()


def test_a_lens_that_reaches_past_its_limit_becomes_wide():
    """OpenCV's fisheye is computed with x / depth up to 90 degrees; a picture that shows more is computed in angles."""
    narrow = Camera(60, 60, (40.0, 40.0), (30, 30), POSE, distortion=LENS)
    assert narrow.widened() is narrow
    past = replace(narrow, focal=(16.0, 16.0))
    assert past.widened().projection == "fisheye" and past.widened().valid_pixels().sum() > past.valid_pixels().sum()
    middle = np.array([[30, 20], [12, 30]])
    assert np.allclose(past.widened().rays(middle)[1], past.rays(middle)[1])


def test_equisolid_as_a_polynomial():
    angle = np.linspace(0, math.pi, 50)
    assert np.allclose(wide.distorted(angle, wide.EQUISOLID), 2 * np.sin(angle / 2), atol=2e-5)


def test_wide_cameras_as_json_and_at_other_sizes():
    for camera in (PANORAMA, replace(FISHEYE, widest=2.0)):
        again = Camera.from_json(camera.to_json())
        assert np.allclose(again.rays()[1], camera.rays()[1]) and again.widest == camera.widest
        small = camera.resized(camera.width // 4, camera.height // 4)
        assert np.allclose(small.rays(np.array([[2, 3]]))[1], camera.rays(np.array([[9.5, 13.5]]))[1])
        by = np.eye(4)
        by[:3, :3] *= 3
        assert camera.moved(by).focal == camera.focal
        assert np.allclose(camera.cosines(camera.rays()[1]), 1)


def test_what_a_wide_camera_cannot_have():
    for bad in (
        lambda: replace(PANORAMA, distortion=LENS),
        lambda: replace(FISHEYE, distortion=Distortion("opencv", (0.1,))),
        lambda: replace(FISHEYE, widest=4.0),
        lambda: replace(PANORAMA, projection="cylindrical"),
    ):
        with pytest.raises(SnergError, match="Camera"):
            bad()


def test_angles_are_the_inverse_to_1e_11():
    k = LENS.coefficients
    angle = np.random.default_rng(0).uniform(0, wide.last_angle(k), 2000)
    assert np.abs(wide.angles(wide.distorted(angle, k), k) - angle).max() < 1e-11
