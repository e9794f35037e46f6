"""A scene's OpenVDB volume in Blender: what it lets through, and that it follows the SNeRG object."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from stage import add_camera

from scenes import snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.scene_files import write_scene
from snerg.core.export.vdb import open_vdb
from snerg.core.io.images import read_image
from snerg.snerg_addon.volume import add_volume

HAZE = Path(__file__).parents[1] / "data" / "haze.vdb"  # what `export-vdb` writes of `haze`
ALPHA, THICK = 5 / 255, 26  # of each voxel, voxels


def haze():
    """A cube of 26 voxels a side that lets some light through, in a box of side 1."""
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (4, 2, 1, 5)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30)


@pytest.fixture
def thing(scene, tmp_path):
    """A SNeRG object of the haze."""
    write_scene(haze(), tmp_path / "haze")
    bpy.ops.snerg.add_scene(directory=str(tmp_path / "haze"))
    return bpy.context.object


def test_a_volume_lets_through_what_the_voxels_do_at_any_scale(scene, thing, tmp_path):
    volume = add_volume(scene, Path(shutil.copy(HAZE, tmp_path)), tmp_path / "haze")
    assert volume.parent == thing and add_volume(scene, tmp_path / "haze.vdb", tmp_path / "haze") == volume
    thing.scale = (2, 2, 2)
    scene.camera = add_camera("Above", (0, 0, 6))
    render = scene.render
    render.film_transparent, render.filepath = True, str(tmp_path / "haze.png")
    scene.cycles.samples, scene.cycles.seed = 64, 0
    render.resolution_x = render.resolution_y = 12
    bpy.ops.render.render(write_still=True)
    render.film_transparent = False
    alpha = read_image(tmp_path / "haze.png")[4:8, 4:8, 3] / 255
    assert abs(alpha.mean() - (1 - (1 - ALPHA) ** THICK)) < 0.05  # three times the spread of 1024 samples


def test_without_openvdb_the_operator_says_so(thing):
    try:
        open_vdb()
    except SnergError:
        with pytest.raises(RuntimeError, match="needs the package openvdb"):
            bpy.ops.snerg.export_vdb()
    else:
        assert bpy.ops.snerg.export_vdb() == {"FINISHED"} and thing.children[0].type == "VOLUME"
