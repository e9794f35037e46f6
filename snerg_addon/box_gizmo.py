"""Arrows on the six faces of the box, by which they are dragged."""

from __future__ import annotations

import bpy
from mathutils import Matrix

from ..operators.resize_box import FACES, face_line
from .bridge import box_of

COLOURS = {"X": (1.0, 0.2, 0.32), "Y": (0.55, 0.86, 0.0), "Z": (0.16, 0.56, 1.0)}  # of the axes, as Blender's own gizmos have them


class SNERG_GGT_box(bpy.types.GizmoGroup):
    """The arrows of the scene's box, while it is the active object"""

    bl_idname = "SNERG_GGT_box"
    bl_label = "SNeRG Box"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"3D", "PERSISTENT", "SHOW_MODAL_ALL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the box is active and can be changed."""
        box = box_of(context.scene)
        return box is not None and context.object == box and context.mode == "OBJECT" and box.library is None and box.visible_get()

    def setup(self, _context: bpy.types.Context) -> None:
        """An arrow a face."""
        self.arrows = {}
        for face, *_ in FACES:
            arrow = self.gizmos.new("GIZMO_GT_arrow_3d")
            arrow.draw_style, arrow.length, arrow.scale_basis = "BOX", 0.4, 0.8
            arrow.color, arrow.alpha = COLOURS[face[1]], 0.6
            arrow.color_highlight, arrow.alpha_highlight = (1.0, 1.0, 1.0), 1.0
            arrow.target_set_operator("snerg.resize_box").face = face
            self.arrows[face] = arrow

    def draw_prepare(self, context: bpy.types.Context) -> None:
        """Put each arrow on its face."""
        box = box_of(context.scene)
        if box is None:
            return
        for face, arrow in self.arrows.items():
            centre, outwards = face_line(box, face)
            turned = outwards.to_track_quat("Z", "Y").to_matrix().to_4x4()
            arrow.matrix_basis = Matrix.Translation(centre) @ turned


CLASSES = (SNERG_GGT_box,)
