"""Delete versions of the field and of the baked scene, and use another project. The list (results.py) chooses and renames them."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import shutil
from pathlib import Path

import bpy

from ..core.errors import SnergError
from ..core.io.files import cannot_write
from ..core.jobs import folder as folders
from ..snerg_addon import results
from ..snerg_addon.owner import adopt
from ..snerg_addon.project import VERSIONS, Project, project_of
from .task_operator import redraw


class SNERG_OT_delete_version(bpy.types.Operator):
    """Delete this version of the field or the baked scene, and its files"""

    bl_idname = "snerg.delete_version"
    bl_label = "Delete Version"
    bl_options = {"REGISTER", "INTERNAL"}

    step: bpy.props.StringProperty(description="'field' or 'scene'", options={"HIDDEN", "SKIP_SAVE"})
    version: bpy.props.StringProperty(description="The name of its folder", options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first, because there is no undo."""
        name = f"{self.step} {self.version}"
        return set(context.window_manager.invoke_confirm(self, event, title=f"Delete the {name}?", message="This cannot be undone."))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete the version's folder, unless a job reads or writes it."""
        try:
            delete(project_of(context.scene), self.step, self.version)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        results.refresh()
        redraw()
        return {"FINISHED"}


def delete(project: Project, step: str, name: str) -> None:
    """Delete a version of 'field' or 'scene'; where it was in use, the newest is from now on. Raises SnergError."""
    there = project.versions(step) if step in VERSIONS else []
    chosen = next((path for path in there if path.name == name), None)
    if chosen is None:
        raise SnergError(f"There is no version {name!r} of the {step}; choose one that the panel lists.")
    for job in folders.live_jobs(project.folder):
        if str(chosen) in folders.read_record(job).get("command", []):
            raise SnergError(f"{folders.label_of(job)} uses this version; wait for it or stop it first.")
    used = project.in_use(step)
    try:
        doomed = chosen.with_name(f".{chosen.name}.deleted")
        chosen.rename(doomed)  # in one step, so that a half-deleted version is never in use
    except OSError as error:
        raise cannot_write(chosen, error) from error
    shutil.rmtree(doomed, ignore_errors=True)
    if used == chosen:
        project.use_newest(step)


class SNERG_OT_adopt_project(bpy.types.Operator):
    """Use this project for this scene. The file that it belonged to starts a new one"""

    bl_idname = "snerg.adopt_project"
    bl_label = "Use It Here"
    bl_options = {"REGISTER", "INTERNAL"}

    folder: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the scene the project's owner."""
        try:
            folder = Path(self.folder)
            if not folder.is_dir():
                raise SnergError(f"There is no project in {folder}; choose a folder with one.")
            if folders.live_jobs(folder):
                raise SnergError("A job runs in this project; wait for it or stop it first.")
            adopt(context.scene, folder)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}
