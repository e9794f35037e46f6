"""Fields on disk."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from scenes import make_cameras, make_frame, random_network
from snerg.core.errors import SnergError
from snerg.core.geometry.distortion import Distortion
from snerg.core.nerf.checkpoint import read_field, write_field
from snerg.core.nerf.field import CHUNK, Field, in_chunks
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, init_field
from snerg.core.nerf.sampling import Domain


@pytest.fixture
def field():
    family = HashModelConfig(HashGrid(levels=2, coarsest=4, finest=8, log2_size=8), width=8)
    params = init_field(family, "deferred", np.random.default_rng(0))["field"]
    domain = Domain.around(np.array([-1.0, -0.9, -1.0]), np.array([1.0, 0.9, 1.0]))
    return Field(family, params, random_network(), domain, None, 0.01)


def test_the_space_the_lenses_and_the_view_mode_come_back(field, tmp_path):
    lens = Distortion("opencv", (0.1, -0.02, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0))
    cameras = (replace(make_cameras()[1], distortion=lens), *make_cameras()[2:])
    write_field(replace(field, ndc=make_frame(), cameras=cameras, view="tiny"), tmp_path)
    back = read_field(tmp_path)
    assert back.view == "tiny" and back.ndc is not None
    assert np.allclose(back.ndc.camera_to_world, make_frame().camera_to_world, rtol=0, atol=1e-15)
    assert (back.ndc.focal, back.ndc.near) == (make_frame().focal, make_frame().near)
    for here, there in zip(back.cameras, cameras, strict=True):
        assert here.distortion == there.distortion and (here.name, here.projection) == (there.name, there.projection)
        assert np.allclose(here.rays()[1], there.rays()[1], rtol=0, atol=1e-15)


def test_the_world_is_the_space_otherwise(field, tmp_path):
    write_field(field, tmp_path)
    back = read_field(tmp_path)
    assert back.ndc is None and back.view == "deferred" and back.cameras == ()


def test_saving_needs_no_memory_for_the_file(field, tmp_path):
    state = {"moments": np.ones(2**24, np.float32)}  # 67 MB
    tracemalloc.start()
    write_field(field, tmp_path, state)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2**25 and (tmp_path / "field.npz").stat().st_size > 2**26
    assert {path.name for path in tmp_path.iterdir()} == {".snerg", "field.npz"}


def test_another_version_is_told_apart(field, tmp_path):
    write_field(field, tmp_path)
    with np.load(tmp_path / "field.npz") as archive:
        arrays = dict(archive)
    arrays["json"] = np.frombuffer(re.sub(rb'"version": *\d+', b'"version":1', arrays["json"].tobytes()), np.uint8)
    np.savez(tmp_path / "field.npz", **arrays)
    with pytest.raises(SnergError, match="snerg-field 1; this SNeRG reads snerg-field 3"):
        read_field(tmp_path)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 24])
def test_chunks_are_of_one_shape_and_leave_no_trace(count):
    shapes = []

    def function(x):
        shapes.append(x.shape)
        return x.sum(axis=-1), 2 * x[:, :2]

    x = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    total, double = in_chunks(function, x, 8)
    assert np.array_equal(total, x.sum(axis=-1)) and np.array_equal(double, 2 * x[:, :2]) and double.shape == (count, 2)
    assert set(shapes) == {(8, 3)} and CHUNK > 8
