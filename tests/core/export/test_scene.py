"""Baked scenes on disk."""

import json
import tracemalloc

import numpy as np
import pytest

from scenes import make_forward, make_snerg, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.scene import read_scene, write_scene
from snerg.core.grid.snerg import Snerg


def same(a: Snerg, b: Snerg) -> bool:
    numbers = (a.voxel_size, a.shape, a.near, a.about, a.effects) == (b.voxel_size, b.shape, b.near, b.about, b.effects)
    arrays = all(np.array_equal(x, y) for x, y in ((a.indirection, b.indirection), (a.cells, b.cells)))
    return numbers and arrays and np.allclose(a.grid_to_world, b.grid_to_world, rtol=0, atol=1e-15)


@pytest.mark.parametrize("make", [make_snerg, make_forward])
@pytest.mark.parametrize("diffuse", [False, True])
def test_what_is_written_is_read(tmp_path, make, diffuse):
    snerg = make(diffuse=diffuse)
    write_scene(snerg, tmp_path / "scene")
    back = read_scene(tmp_path / "scene")
    assert same(back, snerg) and (back.ndc is None) == (snerg.ndc is None)
    if snerg.ndc is not None:
        assert (back.ndc.focal, back.ndc.near) == (snerg.ndc.focal, snerg.ndc.near)
        assert np.allclose(back.ndc.camera_to_world, snerg.ndc.camera_to_world, rtol=0, atol=1e-15)


@pytest.mark.parametrize("ndc", [{"focal": [1, 1]}, 3, {"camera_to_world": np.eye(4).tolist(), "focal": [1, 0], "near": 1}])
def test_a_damaged_frame_is_told(tmp_path, ndc):
    write_scene(make_forward(), tmp_path / "scene")
    path = tmp_path / "scene" / "scene.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "ndc": ndc}))
    with pytest.raises(SnergError, match=r"damaged|forward-facing frame"):
        read_scene(tmp_path / "scene")


@pytest.mark.hard_case(56)
def test_the_atlas_is_written_and_read_by_the_slab(tmp_path):
    """Beside the scene itself only a few pictures are in memory, not the atlas once more."""
    noise = np.random.default_rng(0).integers(0, 256, (180, 150, 180, 4), np.uint8)  # takes longer to write than to cut up
    snerg = snerg_from_volume(noise, None, grid_to_world=np.eye(4), voxel_size=0.01)
    size = snerg.cells.nbytes
    tracemalloc.start()
    try:
        write_scene(snerg, tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] < 0.8 * size
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        back = read_scene(tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] - before < 1.7 * size
    finally:
        tracemalloc.stop()
    assert np.array_equal(back.cells, snerg.cells)
