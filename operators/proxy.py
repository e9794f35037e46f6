"""Add a proxy mesh of a baked scene."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations as values, hence no postponed evaluation here.

import bpy

from ..core.errors import SnergError
from ..snerg_addon.proxy import add_proxy
from ..snerg_addon.scene_object import source_of
from ..snerg_addon.viewport.loading import cached
from .scene_object_operator import SceneObjectOperator


class SNERG_OT_proxy(SceneObjectOperator, bpy.types.Operator):
    """Add a mesh of the baked scene's surface as a child of its object, which catches shadows, or cuts its outline out of a render"""

    bl_idname = "snerg.proxy"
    bl_label = "Add Proxy"
    bl_options = {"REGISTER", "UNDO"}

    kind: bpy.props.EnumProperty(
        name="Kind",
        description="What the proxy is for",
        items=[
            ("SHADOW_CATCHER", "Shadow Catcher", "The scene receives shadows of meshes, in Cycles with a transparent film"),
            ("HOLDOUT", "Holdout", "The scene's outline is cut out of what is behind it, to put a render of the scene there"),
        ],
        default="SHADOW_CATCHER",
    )
    threshold: bpy.props.FloatProperty(
        name="Opacity", description="Opacity of a voxel at which the surface lies", default=0.5, min=0.01, max=0.99, subtype="FACTOR"
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the mesh, or update the one there is."""
        try:
            proxy = add_proxy(context.object, cached(source_of(context.object)), self.kind, self.threshold)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{proxy.name!r} has {len(proxy.data.polygons)} faces.")
        return {"FINISHED"}
