"""Use, rename and delete versions of the field and of the baked scene, and use another project."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import shutil
from pathlib import Path

import bpy

from ..core.errors import SnergError
from ..core.io.files import cannot_write
from ..core.jobs import folder as folders
from ..snerg_addon.owner import adopt
from ..snerg_addon.project import VERSIONS, Project, project_of
from .task_operator import redraw


class VersionOperator:
    """Mixed into an operator on one version. step: 'field' or 'scene'. version: the name of its folder."""

    step: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})
    version: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Find the version and call `act`; report what went wrong."""
        project = project_of(context.scene)
        try:
            there = project.versions(self.step) if self.step in VERSIONS else []
            chosen = next((path for path in there if path.name == self.version), None)
            if chosen is None:
                raise SnergError(f"There is no version {self.version!r} of the {self.step}; choose one that the panel lists.")
            self.act(project, chosen)
        except SnergError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}

    def act(self, project: Project, chosen: Path) -> None:
        """Do the operator's work on the version `chosen`. Raises SnergError."""
        raise NotImplementedError


class SNERG_OT_use_version(VersionOperator, bpy.types.Operator):
    """Use this version in the next steps. The other versions are kept"""

    bl_idname = "snerg.use_version"
    bl_label = "Use This Version"
    bl_options = {"REGISTER", "INTERNAL"}

    def act(self, project: Project, chosen: Path) -> None:
        """Put the version in use."""
        project.use(self.step, chosen)


class SNERG_OT_rename_version(VersionOperator, bpy.types.Operator):
    """Give this version a name"""

    bl_idname = "snerg.rename_version"
    bl_label = "Rename Version"
    bl_options = {"REGISTER", "INTERNAL"}

    name: bpy.props.StringProperty(name="Name", description="Name of the version. Empty: its number", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask for the name."""
        return set(context.window_manager.invoke_props_dialog(self))

    def act(self, project: Project, chosen: Path) -> None:
        """Record the name."""
        project.rename(chosen, self.name)


class SNERG_OT_delete_version(VersionOperator, bpy.types.Operator):
    """Delete this version and its files"""

    bl_idname = "snerg.delete_version"
    bl_label = "Delete Version"
    bl_options = {"REGISTER", "INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first, because there is no undo."""
        name = f"{self.step} {self.version}"
        return set(context.window_manager.invoke_confirm(self, event, title=f"Delete the {name}?", message="This cannot be undone."))

    def act(self, project: Project, chosen: Path) -> None:
        """Delete the version's folder, unless a job reads or writes it."""
        for job in folders.live_jobs(project.folder):
            if str(chosen) in folders.read_record(job).get("command", []):
                raise SnergError(f"{folders.label_of(job)} uses this version; wait for it or stop it first.")
        try:
            doomed = chosen.with_name(f".{chosen.name}.deleted")
            chosen.rename(doomed)  # in one step, so that a half-deleted version is never in use
        except OSError as error:
            raise cannot_write(chosen, error) from error
        shutil.rmtree(doomed, ignore_errors=True)


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
