"""Export a SNeRG object as an OpenVDB volume, and add the volume beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..snerg_addon.project import Project, remember
from ..snerg_addon.scene_object import folder_of
from ..snerg_addon.volume import add_volume
from .scene_object_operator import SceneObjectOperator
from .task_operator import TaskOperator


class SNERG_OT_export_vdb(SceneObjectOperator, TaskOperator, bpy.types.Operator):
    """Export the object's scene as an OpenVDB volume and add that as a volume object, which Cycles and EEVEE light"""

    bl_idname = "snerg.export_vdb"
    bl_label = "Make Volume"
    bl_options = {"REGISTER"}
    step, label = "export", "Exporting the volume"
    changes_file = True

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `export-vdb`."""
        folder = folder_of(context.object)
        name = folder.parent.name + "_" + folder.name if folder.name.isdigit() else folder.name
        return start_command(["export-vdb", str(folder), "--out", str(project.folder / "volumes" / f"{name}.vdb")])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Add the volume to the objects that show the scene which it was made from."""
        path = project.folder / "volumes" / Path(result["out"]).name
        remember(project, "volume", path, result)
        add_volume(scene, path, Path(result["scene"]))
        return f"Wrote {path.name} ({result['bytes'] / 1e6:.1f} MB) and added it as a volume. {result['left_out']}".strip()
