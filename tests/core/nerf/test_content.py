"""The box of a field's content, against boxes of known cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scenes import make_frame
from snerg.core.errors import SnergError
from snerg.core.nerf.content import content_of
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.sampling import CELLS, Domain

DOMAIN = Domain.around(np.array([0.0, 10, 20]), np.array([4.0, 14, 24]))
CELL = 4 / CELLS  # world units


def field_with(*ranges: tuple[tuple[int, int, int], tuple[int, int, int]]) -> Field:
    """A field whose occupied cells are those from each first to each last index, the last included."""
    cells = np.zeros((CELLS,) * 3, bool)
    for first, last in ranges:
        cells[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True
    return Field(HashModelConfig(HashGrid()), {}, None, DOMAIN, cells.ravel(), 0.01)


def test_the_box_ends_at_the_outermost_cells():
    content = content_of(field_with(((10, 20, 30), (19, 49, 69))))
    assert content.cells == 10 * 30 * 40 and (content.stray, content.groups) == (0, 0)
    low = np.array([10, 20, 30]) * CELL + [0, 10, 20]
    np.testing.assert_allclose(content.box.corners().min(axis=0), low)
    np.testing.assert_allclose(content.box.size, np.array([10, 30, 40]) * CELL)


def test_a_floater_is_left_out_and_counted_but_a_second_object_is_not():
    body, bird, floater = ((10, 20, 30), (39, 49, 69)), ((100, 100, 100), (107, 107, 107)), ((2, 120, 2), (3, 121, 3))
    content = content_of(field_with(body, bird, floater))
    assert (content.groups, content.stray, content.cells) == (1, 8, 30 * 30 * 40 + 512)
    np.testing.assert_allclose(content.box.size, np.array([98, 88, 78]) * CELL)


def test_a_turned_box_holds_every_cell_and_touches_some():
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation[:, 0] *= np.linalg.det(rotation)
    content = content_of(field_with(((10, 20, 30), (19, 49, 69))), rotation)
    corners = np.array([[x, y, z] for x in (10, 20) for y in (20, 50) for z in (30, 70)]) * CELL + [0, 10, 20]
    local = (corners - content.box.box_to_world[:3, 3]) @ content.box.box_to_world[:3, :3]
    np.testing.assert_allclose(np.abs(local).max(axis=0), content.box.size / 2)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"occupancy": None}, "has no occupancy grid"),
        ({"occupancy": np.zeros(CELLS**3, bool)}, "holds nothing"),
        ({"ndc": make_frame()}, "forward-facing"),
    ],
)
def test_a_field_without_a_box_of_its_own_is_refused(changes, match):
    with pytest.raises(SnergError, match=match):
        content_of(replace(field_with(((0, 0, 0), (1, 1, 1))), **changes))
