"""Boxes: from Blender's matrices, their corners, and what lies in them."""

from __future__ import annotations

import numpy as np
import pytest

from scenes import rotation
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box

TURN, SIDES, PLACE = rotation((0.3, -0.7, 1.1)), np.array([2.0, 0.5, 3.0]), np.array([4.0, -1.0, 2.0])


def matrix(turn: np.ndarray = TURN, sides: np.ndarray = SIDES) -> np.ndarray:
    """An empty's matrix: a cube from -1 to 1, scaled to half the sides, turned, and moved."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn * sides / 2, PLACE
    return result


def test_an_empty_is_twice_as_long_as_its_scale():
    box = Box.from_matrix(matrix())
    assert np.allclose(box.size, SIDES) and np.allclose(box.box_to_world[:3, :3], TURN) and np.allclose(box.box_to_world[:3, 3], PLACE)


def test_a_mirrored_empty_is_the_same_box():
    box = Box.from_matrix(matrix() @ np.diag([-1.0, 1, 1, 1]))
    assert np.linalg.det(box.box_to_world[:3, :3]) == pytest.approx(1) and np.allclose(box.size, SIDES)
    assert {tuple(np.round(c, 9)) for c in box.corners()} == {tuple(np.round(c, 9)) for c in Box.from_matrix(matrix()).corners()}


def test_corners_and_what_lies_inside():
    """Half a side each way along the box's own axes; a corner itself is inside, what is a little beyond a face is not."""
    box = Box.from_matrix(matrix())
    expected = [PLACE + TURN @ (np.array(signs) * SIDES / 2) for signs in np.ndindex(2, 2, 2) for signs in [2 * np.array(signs) - 1]]
    assert np.allclose(box.corners(), expected)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (3000, 3))
    points[:6], points[6:12] = np.concatenate([np.eye(3), -np.eye(3)]) * (1 - 1e-9), np.concatenate([np.eye(3), -np.eye(3)]) * (1 + 1e-9)
    world = points * SIDES / 2 @ TURN.T + PLACE
    assert np.array_equal(box.contains(world), (np.abs(points) <= 1).all(axis=-1))
    assert Box.axis_aligned([0, 0, 0], [1, 2, 3]).contains(np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3.0001]])).tolist() == [True, True, False]


def test_an_axis_aligned_box():
    box = Box.axis_aligned([-1, 0, 2], [3, 1, 8])
    assert box.box_to_world[:3, 3].tolist() == [1, 0.5, 5] and box.size.tolist() == [4, 1, 6]
    assert np.array_equal(box.corners().min(axis=0), [-1, 0, 2]) and np.array_equal(box.corners().max(axis=0), [3, 1, 8])


def sheared(amount: float) -> np.ndarray:
    """A matrix whose first two axes have a cosine of `amount`."""
    shear = np.eye(4)
    shear[:2, 1] = amount, np.sqrt(1 - amount**2)
    return shear


def test_shear_is_refused_and_rounding_is_not():
    with pytest.raises(SnergError, match="sheared"):
        Box.from_matrix(sheared(1.01e-4))
    with pytest.raises(SnergError, match="sheared"):
        Box.from_matrix(sheared(-0.2))
    assert np.allclose(Box.from_matrix(sheared(0.99e-4)).size, 2)
    assert np.allclose(Box.from_matrix(matrix().astype(np.float32)).size, SIDES)


@pytest.mark.parametrize(
    ("bad", "match"), [(np.diag([1.0, 0, 1, 1]), "no volume"), (np.full((4, 4), np.inf), "finite"), (np.eye(3), "finite")]
)
def test_matrices_that_are_no_box(bad, match):
    with pytest.raises(SnergError, match=match):
        Box.from_matrix(bad)


def test_a_box_comes_back_from_json():
    box = Box.from_matrix(matrix())
    for value in (box.to_json(), {"matrix": matrix().tolist()}):
        again = Box.from_json(value)
        assert np.allclose(again.box_to_world, box.box_to_world) and np.allclose(again.size, box.size)
    assert np.allclose(Box.from_json({"min": [0, 0, 0], "max": [1, 2, 3]}).size, [1, 2, 3])
