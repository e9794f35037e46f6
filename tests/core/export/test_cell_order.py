"""The order of cells in a page: what the first camera sees comes first, and no picture changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scenes import make_cameras, make_forward, make_forward_cameras, make_frame, make_snerg
from snerg.core.export.cell_order import cell_order
from snerg.core.geometry.camera import Camera
from snerg.core.progress import silent
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene

SOLID = make_snerg(shape=(95, 95, 95))
SOLID = replace(SOLID, cells=np.full_like(SOLID.cells, 255))


@pytest.mark.parametrize(
    ("scene", "camera"),
    [(SOLID, make_cameras()[0]), (SOLID, make_cameras()[2]), (make_forward(), make_forward_cameras(make_frame())[0])],
    ids=["perspective", "orthographic", "forward-facing"],
)
def test_the_seen_cells_give_the_whole_picture(scene: Scene, camera: Camera) -> None:
    order = cell_order(scene, camera, silent)
    assert sorted(order.cells.tolist()) == list(range(len(scene.cells)))
    arranged = order.sorted(scene)
    whole = render_scene(scene, camera).over()
    assert np.abs(render_scene(arranged, camera).over() - whole).max() < 1e-6
    cells = arranged.cells.copy()
    cells[order.seen :] = 0
    assert np.abs(render_scene(replace(arranged, cells=cells), camera).over() - whole).mean() < 0.1 / 255
    if scene is SOLID:
        assert order.seen < 0.8 * len(cells), "what lies behind others is not seen"


@pytest.mark.parametrize("in_order", [True, False])
def test_layers(in_order: bool) -> None:
    """The first `seen` layers hold every cell that is seen, and the order has each layer once."""
    order = cell_order(SOLID, make_cameras()[0], silent)
    layers = order.layers(in_order)
    assert sorted(layers["order"]) == list(range(4)) and 0 < layers["seen"] <= 4 and len(SOLID.cells) == 45
    seen = {cell // 12 for cell in (range(order.seen) if in_order else order.cells[: order.seen].tolist())}
    assert seen <= set(layers["order"][: layers["seen"]])
    assert layers["order"] == sorted(layers["order"]) or not in_order
