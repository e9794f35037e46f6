"""Scenes as OpenVDB volumes: densities that let just 1 - alpha through a voxel, colours without their alpha."""

import numpy as np
import pytest

from scenes import make_forward, make_snerg, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export import vdb
from snerg.core.export.scene_files import write_scene
from snerg.core.io.images import linear_to_srgb
from snerg.core.rendering.render import MarchSettings, march_rays
from snerg.core.scene.blocks import DATA_VOXELS

from snerg.core.commands.export_vdb import export_vdb  # isort: skip


def test_through_a_voxel_passes_what_its_alpha_leaves():
    alpha = np.arange(256) / 255
    for length in (1e-3, 0.01, 7.0):
        passes = np.exp(-vdb.density_of(alpha, length).astype(np.float64) * length)
        np.testing.assert_allclose(passes[:-1], 1 - alpha[:-1], atol=1e-6)
        assert 0 < passes[-1] < 0.5 / 255 + 1e-6  # an opaque voxel's density is finite


@pytest.mark.parametrize("correction", [False, True])
def test_rays_pass_as_in_the_marcher(correction):
    """Rays along the voxels' rows, whose samples are the voxels' centres: through none, one, or several of random opacities, or a haze."""
    rng = np.random.default_rng(0)
    kind = np.arange(30)[:, None].repeat(30, 1) % 4
    alpha = np.where((kind == 2)[..., None] & (np.arange(30) % 7 == 0), rng.integers(1, 256, (30, 30, 30)), 0)
    alpha[kind == 1, 12] = rng.integers(1, 256, (kind == 1).sum())
    alpha[kind == 3, :20] = 8
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[..., -1] = alpha
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=1 / 30, opacity_correction=correction)
    ((_, densities, _),) = vdb.blocks(scene)
    through = np.exp(-densities.astype(np.float64).sum(axis=2) / 30)
    starts = np.stack([*np.meshgrid(np.arange(30) + 0.5, np.arange(30) + 0.5, indexing="ij"), np.full((30, 30), -3.0)], axis=-1) / 30
    rays = march_rays(scene, starts.reshape(-1, 3), np.tile([0.0, 0, 1], (900, 1)), MarchSettings(tolerance=1e-6))
    more = through - rays.transmittance.reshape(30, 30)
    solid = 0.5 / 255 + 1e-5
    assert np.abs(more[kind < (2 if correction else 4)]).max() < solid
    assert more.min() > -1e-5 and more.max() < (0.2 if correction else solid)
    if correction:
        assert more[kind == 3].max() > 0.05 and through[alpha.max(axis=-1) >= 170].max() < solid
        assert np.abs(through[kind == 1] - np.maximum(1 - 1.5 * alpha.max(axis=-1)[kind == 1] / 255, 0)).max() < solid
    assert vdb.left_out(scene) == (vdb.PER_VOXEL if correction else "")


def test_colours_are_straight_and_linear_and_stand_where_they_stood():
    scene = make_snerg((34, 30, 40), fog=False, angles=(0.3, 0.1, -0.2), centre=(1, 2, 3))
    found = list(vdb.blocks(scene))
    assert len(found) == len(scene.cells)
    transform, pose = vdb.voxel_transform(scene), scene.box.box_to_world
    for (corner, densities, colours), cell in zip(found, scene.cells, strict=True):
        inside = cell[1:-1, 1:-1, 1:-1].astype(float)
        full = inside[..., -1] > 0
        np.testing.assert_array_equal(densities > 0, full)
        np.testing.assert_allclose(
            linear_to_srgb(colours[full]) * inside[full][:, -1:], inside[full][:, :3].clip(max=inside[full][:, -1:]), atol=0.01
        )
        assert not colours[~full].any()
        index = np.array(corner) + np.array([3, 5, 7])
        local = transform @ [*index, 1]
        world = scene.grid_to_world @ [*((index + 0.5) * scene.voxel_size), 1]
        np.testing.assert_allclose(pose @ local, world, atol=1e-9)
    assert all(n % DATA_VOXELS == 0 for corner, *_ in found for n in corner)


def test_what_cannot_be_written_is_said(tmp_path, monkeypatch):
    write_scene(make_snerg((34, 30, 40), diffuse=True), tmp_path / "scene")
    with pytest.raises(SnergError, match=r"ends in \.vdb"):
        export_vdb(tmp_path / "scene", tmp_path / "volume.txt")
    monkeypatch.setattr(vdb, "open_vdb", lambda: None)
    with pytest.raises(SnergError, match="forward-facing"):
        vdb.write_vdb(make_forward(), tmp_path / "volume.vdb")
    assert not (tmp_path / "volume.vdb").exists()


def test_without_openvdb_a_sentence_says_where_it_is(tmp_path):
    try:
        vdb.open_vdb()
    except SnergError as error:
        assert "blender.org" in str(error)
    else:
        pytest.skip("openvdb is there")


def test_the_file_holds_the_grids(tmp_path):
    try:
        openvdb = vdb.open_vdb()
    except SnergError:
        pytest.skip("openvdb is not there")
    scene = make_snerg((34, 30, 40), diffuse=True)
    told = vdb.write_vdb(scene, tmp_path / "volume.vdb")
    grids = {grid.name: grid for grid in openvdb.readAll(str(tmp_path / "volume.vdb"))[0]}
    assert set(grids) == {"density", "color"} and grids["density"].activeVoxelCount() == told["voxels"]
