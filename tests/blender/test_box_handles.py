"""The box's handles, and what is drawn of the bake and the rig beforehand."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from snerg.core.data.rig import rig_cameras
from snerg.core.geometry.box import Box
from snerg.operators.resize_box import FACES, face_line, moved_face
from snerg.snerg_addon import overlay
from snerg.snerg_addon.bridge import add_box, box_from_blender, rig_settings


@pytest.fixture
def box(scene):
    empty = add_box(Box.axis_aligned(np.array([-1.0, -2, 0]), np.array([1.0, 2, 3])), scene)
    bpy.context.view_layer.update()
    return empty


@pytest.mark.parametrize("face", [face for face, *_ in FACES])
@pytest.mark.parametrize("turned", [False, True])
def test_a_face_moves_and_the_opposite_one_stays(box, face, turned):
    if turned:
        parent = bpy.data.objects.new("Parent", None)
        bpy.context.scene.collection.objects.link(parent)
        parent.matrix_world = Matrix.LocRotScale((1, 2, 3), Euler((0.3, 0.4, 0.5)), (2, 2, 2))
        box.parent = parent
        bpy.context.view_layer.update()
    other = ("-" if face[0] == "+" else "+") + face[1]
    (centre, outwards), (stays, _) = face_line(box, face), face_line(box, other)
    assert bpy.ops.snerg.resize_box(face=face, distance=0.5) == {"FINISHED"}
    bpy.context.view_layer.update()
    (moved, same), (stayed, _) = face_line(box, face), face_line(box, other)
    assert (moved - (centre + 0.5 * outwards)).length < 1e-5 and (stayed - stays).length < 1e-5 and (same - outwards).length < 1e-5
    box_from_blender(box)  # not sheared


def test_a_face_never_passes_the_opposite_one(box):
    box.matrix_world = moved_face(box, "+X", -5.0)
    bpy.context.view_layer.update()
    size = box_from_blender(box).size
    assert 0 < size[0] < 0.01 and size[1:] == pytest.approx([4, 3])


def test_a_linked_or_missing_box_has_no_handles(scene):
    assert not bpy.ops.snerg.resize_box.poll()


def test_voxel_lines_are_those_of_the_bake(box, scene):
    scene.snerg.resolution = 20
    shown = box_from_blender(box)
    cells, each = overlay.lines_of(shown, overlay.bake_settings(scene))
    assert each == 1 and cells.tolist() == [10, 20, 15]
    ends = overlay.voxel_lines(shown, cells)
    assert len(ends) == 2 * (11 + 21 + 16) and np.ptp(ends.reshape(-1, 3), axis=0) == pytest.approx([2, 4, 3])
    assert sorted(set(ends[:, 0, 1].round(6)))[:3] == [-2, -1.8, -1.6]
    scene.snerg.resolution = 400
    assert overlay.voxels_a_line(scene) == 8
    box.scale = (0, 1, 1)
    bpy.context.view_layer.update()
    assert overlay.voxels_a_line(scene) == 0


def test_the_rigs_cameras_are_drawn_where_they_will_stand(box, scene):
    scene.snerg.rig_count = 7
    shown = box_from_blender(box)
    cameras = rig_cameras(shown, rig_settings(scene), 40, 30)
    ends = overlay.camera_lines(cameras, shown).reshape(7, 8, 2, 3)
    for camera, lines in zip(cameras, ends, strict=True):
        assert lines[:4, 0] == pytest.approx(np.tile(camera.position, (4, 1)))
        seen = camera.camera_to_world[:3, :3].T @ (lines[0, 1] - camera.position)
        assert seen[0] / -seen[2] == pytest.approx(-40 / 2 / camera.focal[0]) and seen[1] / -seen[2] == pytest.approx(
            -30 / 2 / camera.focal[1]
        )
