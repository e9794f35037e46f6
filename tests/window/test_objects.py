"""SNeRG objects in the window: instances, refused and forward-facing scenes, windows and regions, undo, files."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from scenes import make_forward, make_frame, snerg_from_volume
from snerg.core.export.scene_files import write_scene

from .conftest import OUT

GREEN = (0, 255, 0)
LONG = 2100  # blocks, more texels than software OpenGL takes along a side of a 3D texture


def is_green(colour) -> bool:
    return bool(np.abs(np.array(colour) - GREEN).max() < 40)


def block(length: int = 30):
    """A green block of 1 unit a side, at the beginning of a box of so many voxels along x."""
    values = np.zeros((length, 30, 30, 4), np.uint8)
    values[2:28, 2:-2, 2:-2] = (0, 255, 0, 255)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30)


def written(scene, name: str):
    folder = OUT / name
    shutil.rmtree(folder, ignore_errors=True)
    write_scene(scene, folder)
    return folder


@pytest.fixture(scope="module")
def small(blender):
    return written(block(), "green block")


def test_a_scene_that_the_card_refuses_is_drawn_slowly_and_the_others_as_ever(blender, small):
    seen = blender.walk("refused_scene", small, written(block(30 * LONG), "long block"))
    assert all(is_green(colour) for colour in seen["three"].values()), f"See three.png: {seen['three']}"
    assert seen["works"] and f"texture of {LONG} x" in seen["said"] and "fewer voxels" in seen["said"], seen["said"]


def test_pictures_count_as_graphics_memory_and_are_freed(blender, small):
    seen = blender.walk("little_memory", small)
    assert is_green(seen["room"]["block"]) and seen["pictures"] == 1 and seen["hidden"] == 0 and seen["counted"] == 0


def test_instances_are_drawn_where_blender_shows_them(blender, small):
    seen = blender.walk("instances", small)
    green = {name: {point for point, colour in seen[name].items() if is_green(colour)} for name in seen if isinstance(seen[name], dict)}
    assert green == {
        "shown": {"collection", "nodes"},
        "no empties": set(),
        "hidden": {"nodes"},
        "local view": {"nodes"},
        "all": {"own", "collection", "nodes"},
    }


def test_undo_and_redo_of_moving_and_adding(blender, small):
    seen = blender.walk("undo", small)
    green = {name: [point for point, colour in seen[name].items() if is_green(colour)] for name in seen if isinstance(seen[name], dict)}
    assert green == {
        "added": ["here"],
        "moved": ["there"],
        "unmoved": ["here"],
        "unadded": [],
        "added again": ["here"],
        "moved again": ["there"],
    }


def test_view_layers_files_and_libraries_keep_it(blender, small):
    seen = blender.walk("kept", small)
    green = {name: is_green(seen[name]["here"]) for name in seen if isinstance(seen[name], dict)}
    assert green == {
        "first layer": True,
        "second layer": False,
        "first again": True,
        "empty file": False,
        "opened": True,
        "linked": True,
    }
    assert seen["library"]


def test_each_window_and_each_of_four_views_has_its_own_picture(blender, small):
    seen = blender.walk("several_regions", small)
    assert is_green(seen["one"]["here"]) and (seen["in one"], seen["windows"], seen["in two"], seen["after closing"]) == (1, 2, 2, 1), seen
    assert len(seen["quad"]) == 4 and all(is_green(colour) for colour in seen["quad"]), f"See quad view.png: {seen['quad']}"
    assert seen["in quad"] == 4 and seen["no viewport"] == 0


def test_a_forward_facing_scene_is_drawn_and_the_window_answers(blender):
    frame = make_frame()
    (OUT / "pose.txt").write_text(" ".join(str(v) for v in frame.camera_to_world.ravel()))
    seen = blender.walk("forward_facing", written(make_forward(), "forward"), OUT / "pose.txt")
    assert seen["done"] and seen["size"] == seen["region"] and seen["longest_pause"] < 1.5 + 3 * seen["idle_pause"], seen
    most, mean, alpha = seen["difference"]
    assert most < 2 and mean < 0.5 and alpha > 0.05 and not seen["said"], seen


def test_the_picture_is_laid_over_a_meshs_edge_as_by_numpy(blender):
    seen = blender.walk("composite")
    for name in ("shown", "holdout"):
        levels, depth = seen[name]
        assert levels < 2 and depth < 1e-5, f"{name}: {levels:.2f} levels, {depth:.2g} of the depth"
