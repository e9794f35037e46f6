"""The operators as a menu of the 3D view: Blender's search (F3) finds only operators that are in a menu."""

from __future__ import annotations

import bpy

STEPS = (
    ("snerg.render_dataset", "snerg.use_views", "snerg.import_dataset"),
    ("snerg.apply_preset", "snerg.train", "snerg.import_field"),
    ("snerg.add_box", "snerg.fit_box", "snerg.fit_box_to_field", "snerg.estimate", "snerg.bake", "snerg.import_scene", "snerg.add_scene"),
    ("snerg.hide_originals", "snerg.show_originals"),
    ("snerg.preview", "snerg.composite", "snerg.proxy", "snerg.study"),
    ("snerg.add_annotation",),
    (
        "snerg.count_keyframes",
        "snerg.export_web",
        "snerg.open_page",
        "snerg.export_scene",
        "snerg.export_vdb",
        "snerg.pack_scene",
        "snerg.unpack_scene",
    ),
    ("snerg.copy_command", "snerg.import_file", "snerg.send_to_flamenco"),
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


def draw_import(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entries in File > Import."""
    self.layout.operator("snerg.import_dataset", text="SNeRG Dataset (transforms.json, COLMAP, LLFF)")
    self.layout.operator("snerg.import_field", text="SNeRG Field or Checkpoint")
    self.layout.operator("snerg.import_scene", text="SNeRG Scene")


def draw_export(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entries in File > Export."""
    self.layout.operator("snerg.export_web", text="SNeRG Web Page")
    self.layout.operator("snerg.export_scene", text="SNeRG Scene Files (published layout)")


def draw_entry(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the submenu in the 3D view's Object menu."""
    self.layout.separator()
    self.layout.menu(SNERG_MT_steps.bl_idname)


def register() -> None:
    """Append the submenu and the entries."""
    bpy.types.VIEW3D_MT_object.append(draw_entry)
    bpy.types.VIEW3D_MT_add.append(draw_add)
    bpy.types.TOPBAR_MT_file_import.append(draw_import)
    bpy.types.TOPBAR_MT_file_export.append(draw_export)


def unregister() -> None:
    """Remove the submenu and the entries."""
    bpy.types.TOPBAR_MT_file_export.remove(draw_export)
    bpy.types.TOPBAR_MT_file_import.remove(draw_import)
    bpy.types.VIEW3D_MT_add.remove(draw_add)
    bpy.types.VIEW3D_MT_object.remove(draw_entry)


class SNERG_FH_files(bpy.types.FileHandler):
    """Files that are dropped into the 3D view: datasets, fields, checkpoints and baked scenes"""

    bl_idname = "SNERG_FH_files"
    bl_label = "SNeRG"
    bl_import_operator = "snerg.import_file"
    bl_file_extensions = ".json;.npz;.npy;.html"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Whether they are dropped into a 3D view."""
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = (SNERG_MT_steps, SNERG_FH_files)
