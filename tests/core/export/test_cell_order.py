"""The order of cells in a page: what the first camera sees comes first, and no picture changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scenes import looking, make_cameras, make_forward, make_forward_cameras, make_frame, make_snerg, rotation
from snerg.core.export.cell_order import CellOrder, cell_order
from snerg.core.geometry.camera import Camera
from snerg.core.progress import silent
from snerg.core.rendering.render import MarchSettings, march_rays, render_scene
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


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_the_order_is_by_what_is_seen_and_how_near(projection: str) -> None:
    """Cells that lie in another order than their blocks, of a grid that is turned and moved, some behind others."""
    draw = np.random.default_rng(4)
    sides = (5, 4, 3)
    indirection = np.full(sides, -1, np.int32)
    chosen = np.sort(draw.choice(60, 54, replace=False))
    indirection.reshape(-1)[chosen] = draw.permutation(54)
    cells = np.zeros((54, 32, 32, 32, 4), np.uint8)
    cells[:, 1:31, 1:31, 1:31] = (9, 9, 9, 60)
    cells[::3, 1:31, 1:31, 1:31] = (9, 9, 9, 12)
    pose, voxel = np.eye(4), 0.02
    pose[:3, :3], pose[:3, 3] = rotation((0.4, -0.7, 1.9)), (3, -2, 1)
    scene = Scene(pose, voxel, (150, 120, 90), indirection, cells, None)
    world = ((np.argwhere(indirection >= 0) + 0.5) * 30 * voxel) @ pose[:3, :3].T + pose[:3, 3]
    eye = world.mean(axis=0) + np.array([1.0, -3.6, 2.2])
    focal = (60.0, 60.0) if projection == "perspective" else (20.0, 20.0)
    camera = Camera(64, 64, focal, (32, 32), looking(tuple(eye), tuple(world.mean(axis=0))), projection)
    order = cell_order(scene, camera, silent)
    far = np.linalg.norm(world - eye, axis=1) if projection == "perspective" else (eye - world) @ camera.camera_to_world[:3, 2]
    distance = np.zeros(54)
    distance[indirection[indirection >= 0]] = far
    origins, directions = camera.rays()
    group = np.zeros(54, int)
    for limit in (0.3, 1 / 255):
        visited = np.zeros(cells.size // 4, bool)
        march_rays(scene, origins, directions, MarchSettings(stop_transmittance=limit), visited=visited)
        group += ~visited.reshape(54, -1).any(axis=1)
    assert order.cells.tolist() == sorted(range(54), key=lambda cell: (group[cell], distance[cell]))
    assert order.seen == (group < 2).sum() and set(group.tolist()) == {0, 1, 2}
    assert np.array_equal(order.sorted(scene).indirection < 0, indirection < 0)


def test_layers_come_by_the_mean_of_their_cells() -> None:
    """Of four layers of twelve cells, the last one is needed first, and one cell of it comes late."""
    cells = np.array([*range(36, 47), *range(12), *range(24, 36), *range(12, 24), 47])
    layers = CellOrder(cells, 11).layers(in_order=False)
    assert layers == {"order": [3, 0, 2, 1], "seen": 1}
    assert CellOrder(cells, 12).layers(in_order=False)["seen"] == 2
