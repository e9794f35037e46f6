"""Which part of a viewport's picture is marched for an object: a rectangle that holds all that NumPy sees of it, and little more."""

from __future__ import annotations

import numpy as np
import pytest

from scenes import looking, make_snerg
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import render_scene
from snerg.snerg_addon.viewport.view import Part, Projection, screen_part

SIZE = (64, 36)
FOCAL = 50.0


def part_of(scene, pose: np.ndarray, projection: str) -> Part:
    near, far = 0.01, 1000.0
    matrix = np.diag([2 * FOCAL / SIZE[0], 2 * FOCAL / SIZE[1], -2 / (far - near), 1.0])
    if projection == "perspective":
        matrix[2:, 2:] = [[-(far + near) / (far - near), -2 * far * near / (far - near)], [-1, 0]]
    else:
        matrix[:2] /= 5  # as the camera below
    return screen_part(scene, scene.box.box_to_world, pose, Projection.from_matrix(matrix), SIZE)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_all_that_is_seen_lies_in_the_part(projection):
    scene = make_snerg(shape=(30, 26, 34), angles=(0.2, 0.1, 0.3), fog=False)
    for eye, target in (((0, -6, 1), (0, 0, 0)), ((5, -9, 4), (1, 0.5, 0)), ((3, 2, 14), (-2, 0, 0)), ((0, -7, 0), (2, 0, 1))):
        pose = looking(eye, target)
        focal = FOCAL if projection == "perspective" else FOCAL / 5
        camera = Camera(*SIZE, (focal, focal), (SIZE[0] / 2, SIZE[1] / 2), pose, projection)
        part = part_of(scene, pose, projection)
        seen = render_scene(scene, camera).alpha[::-1] > 0  # from the bottom, as the part
        inside = np.zeros_like(seen)
        inside[part.bottom : part.bottom + part.height, part.left : part.left + part.width] = True
        assert seen.any() and not (seen & ~inside).any()
        assert part.pixels < 0.6 * seen.size


def test_nothing_is_marched_beside_the_picture_and_all_from_within():
    scene = make_snerg(shape=(30, 26, 34), fog=False)
    assert part_of(scene, looking((0, -6, 0), (7, 0, 0)), "perspective").pixels == 0
    assert part_of(scene, looking((0, -0.3, 0), (0, 1, 0)), "perspective") == Part(0, 0, *SIZE)


def test_bands_fill_the_part_from_its_top_and_a_draft_holds_it():
    part = Part(10, 5, 31, 20)
    assert part.rows(0, 20) == part
    assert part.rows(0, 8) == Part(10, 17, 31, 8) and part.rows(8, 12) == Part(10, 5, 31, 12)
    small = part.scaled((64, 36), (23, 13))
    for low, count, before, after, at in ((10, 31, 64, 23, (small.left, small.width)), (5, 20, 36, 13, (small.bottom, small.height))):
        assert at[0] / after <= low / before and (low + count) / before <= sum(at) / after <= 1
