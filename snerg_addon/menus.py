"""The operators as a menu of the 3D view: Blender's search (F3) finds only operators that are in a menu."""

from __future__ import annotations

import bpy

STEPS = (
    ("snerg.render_dataset", "snerg.use_views", "snerg.import_dataset"),
    ("snerg.train", "snerg.import_field"),
    ("snerg.add_box", "snerg.estimate", "snerg.bake", "snerg.import_scene", "snerg.add_scene"),
    ("snerg.hide_originals", "snerg.show_originals"),
    ("snerg.preview", "snerg.composite", "snerg.proxy", "snerg.study"),
    ("snerg.export_web", "snerg.export_scene", "snerg.export_vdb", "snerg.pack_scene", "snerg.unpack_scene"),
    ("snerg.send_to_flamenco",),
)


class SNERG_MT_steps(bpy.types.Menu):
    """Train, bake and export a radiance field"""

    bl_label = "SNeRG"
    bl_idname = "SNERG_MT_steps"

    def draw(self, _context: bpy.types.Context) -> None:
        """One group of operators a step."""
        for index, operators in enumerate(STEPS):
            if index:
                self.layout.separator()
            for operator in operators:
                self.layout.operator(operator)


def draw_add(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entry in the Add menu."""
    self.layout.operator("snerg.add_scene", icon="OUTLINER_OB_VOLUME")


def draw_entry(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the submenu in the 3D view's Object menu."""
    self.layout.separator()
    self.layout.menu(SNERG_MT_steps.bl_idname)


def register() -> None:
    """Append the submenu and the entry."""
    bpy.types.VIEW3D_MT_object.append(draw_entry)
    bpy.types.VIEW3D_MT_add.append(draw_add)


def unregister() -> None:
    """Remove the submenu and the entry."""
    bpy.types.VIEW3D_MT_add.remove(draw_add)
    bpy.types.VIEW3D_MT_object.remove(draw_entry)


CLASSES = (SNERG_MT_steps,)
