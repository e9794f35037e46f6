"""Export a SNeRG object as an OpenVDB volume, and add the volume beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..core.units import file_size
from ..snerg_addon.project import Project, remember
from ..snerg_addon.scene_object import folder_of, source_of
from ..snerg_addon.volume import add_volume, parent_of, volume_path
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
        """The command `export-vdb`, of a packed scene from its copy. The project remembers which object the volume is for."""
        path = volume_path(project, folder_of(context.object))
        project.note(f"object of {path.name}", {"name": context.object.name_full})
        return start_command(["export-vdb", str(source_of(context.object)), "--out", str(path)])

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Add the volume to the object that it was made for; where that is gone, to another one that shows the same scene."""
        path = project.folder / "volumes" / Path(result["out"]).name
        remember(project, "volume", path, result)
        parent = parent_of(scene, project, path, str(project.notes().get(f"object of {path.name}", {}).get("name")))
        if parent is None:
            return f"Wrote {path}, but no object shows its scene any more; Add > Volume > Import OpenVDB adds it."
        add_volume(parent, path, scene)
        return f"Wrote {path.name} ({file_size(result['bytes'])}) and added it to {parent.name!r} as a volume. {result['left_out']}".strip()
