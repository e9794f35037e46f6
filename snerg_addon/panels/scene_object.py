"""The panel of a SNeRG object, in the properties editor's Object tab."""

from __future__ import annotations

import bpy

from ...core.errors import SnergError
from ...core.units import file_size
from .. import packing
from ..originals import hidden_in
from ..scene_object import folder_of, is_own, is_snerg_object, problem_of, source_of
from ..viewport import card, draw
from ..viewport.loading import has_scene, loaded
from .layout import draw_box, draw_sentence

NAMES = 8  # of hidden objects that the panel lists


class SNERG_PT_object(bpy.types.Panel):
    """The baked scene that the object shows"""

    bl_label = "SNeRG"
    bl_idname = "SNERG_PT_object"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "object"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the object shows a baked scene."""
        return is_snerg_object(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        """The folder, what is wrong with it, and what the scene holds."""
        layout, thing = self.layout, context.object
        layout.use_property_split = True
        if thing.snerg.temporary:
            draw_sentence(layout, "The training so far, baked coarsely. It goes away when the training ends; a bake stays", "INFO")
            return
        row = layout.row()
        row.enabled = is_own(thing)  # an override would lose another folder when the file is opened again
        row.prop(thing.snerg, "folder")
        try:
            draw_packing(layout, thing)
            entry = loaded(source_of(thing))
        except SnergError as error:
            draw_sentence(layout, str(error), "ERROR")
            return
        if context.scene.render.engine != "SNERG":
            layout.operator("snerg.composite", icon="NODE_COMPOSITING")
        if problem := problem_of(thing) or entry.problem:
            draw_sentence(layout, problem, "ERROR")
        elif entry.scene is None:
            layout.label(text="Reading the scene", icon="TIME")
        else:
            layout.operator("snerg.export_vdb", icon="VOLUME_DATA")
            layout.operator_menu_enum("snerg.proxy", "kind", icon="MESH_DATA")
            draw_originals(layout, context.scene)
            voxels = " x ".join(str(n) for n in entry.scene.shape)
            kind = "View-dependent" if entry.scene.network is not None else "Diffuse"
            if entry.scene.ndc is not None:
                draw_sentence(layout, "A forward-facing scene: the processor draws it in the viewport, coarse and then refined", "INFO")
            if not draw.works():
                draw_sentence(layout, "The viewport cannot draw it here; the console says why. F12 and the preview work", "ERROR")
            elif said := card.problem_in_viewport(thing):
                draw_sentence(layout, said, "ERROR")
            draw_box(
                layout,
                f"{kind}, {voxels} voxels in {len(entry.scene.cells)} blocks",
                f"{file_size(card.memory())} of graphics memory in all",
            )


def draw_packing(layout: bpy.types.UILayout, thing: bpy.types.Object) -> None:
    """Packing and unpacking, and how a packed copy and the folder differ. Raises SnergError where the copy is damaged."""
    folder, packed = folder_of(thing), packing.is_packed(thing)
    if packed:
        layout.operator("snerg.unpack_scene", icon="PACKAGE")
    problem = packing.state_of(thing, folder)
    if not packed or (problem and has_scene(folder)):
        layout.operator("snerg.pack_scene", icon="UGLYPACKAGE")
    if problem:
        draw_sentence(layout, problem, "INFO")


def draw_originals(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Hiding the objects that were baked, and which are hidden."""
    layout.operator("snerg.hide_originals", icon="HIDE_ON")
    if hidden := sorted(thing.name for thing in hidden_in(scene)):
        layout.operator("snerg.show_originals", icon="HIDE_OFF")
        more = f" and {len(hidden) - NAMES} more" if len(hidden) > NAMES else ""
        draw_sentence(layout, f"Hidden originals: {', '.join(hidden[:NAMES])}{more}", "INFO")
