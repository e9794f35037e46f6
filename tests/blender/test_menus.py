"""Blender's search (F3) finds operators that are in a menu: every operator of the add-on that an artist starts."""

from __future__ import annotations

import bpy

from snerg.operators import classes
from snerg.snerg_addon import menus


def test_the_menu_has_every_operator_that_is_not_internal(addon):
    offered = {operator for group in menus.STEPS for operator in group}
    wanted = {cls.bl_idname for cls in classes() if "INTERNAL" not in cls.bl_options}
    assert offered == wanted, "An operator belongs into menus.STEPS, or is INTERNAL"


def test_the_object_menu_has_it_while_the_addon_is_registered(addon):
    assert menus.draw_entry in bpy.types.VIEW3D_MT_object._dyn_ui_initialize()
    menus.unregister()
    assert menus.draw_entry not in bpy.types.VIEW3D_MT_object._dyn_ui_initialize()
    menus.register()
