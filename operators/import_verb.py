"""What importing a dataset, a field and a scene have in common."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `filepath` as a value, hence no postponed evaluation here.

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..core.errors import SnergError
from ..core.jobs.runner import start_verb
from ..snerg_addon.activity import Work
from ..snerg_addon.project import Project, remember
from ..snerg_addon.properties import RELATIVE_PATHS
from .job_runner import LongVerb


class ImportVerb(LongVerb):
    """key: the step of the project that the import fills, and the end of the operator's name. what: its name in a sentence."""

    key: ClassVar[str]
    what: ClassVar[str]
    accepted: ClassVar[str] = "*"  # the files that the browser shows beside folders: those that can be chosen

    filepath: bpy.props.StringProperty(
        name="Path", description="The file or folder to import", subtype="FILE_PATH", options={"SKIP_SAVE", *RELATIVE_PATHS}
    )

    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the path first, where there is a window to ask in."""
        if self.filepath or bpy.app.background or context.window is None:
            return super().invoke(context, event)
        self._asked = True
        self.filepath = bpy.path.abspath("//") if bpy.data.filepath else ""  # else the browser proposes the .blend's own name
        self.filter_glob = self.accepted
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Wait, unless the path comes from the file browser: then start again with the path, beside everything else."""
        if getattr(self, "_asked", False):
            verb = getattr(bpy.ops.snerg, f"import_{self.key}")
            return set(verb("INVOKE_DEFAULT", filepath=self.filepath))
        return super().execute(context)

    def start(self, context: bpy.types.Context, project: Project) -> Work:
        """`import` of the command line."""
        return start_verb(["import", str(self.path()), "--out", str(project.new_version(self.key))])

    def path(self) -> Path:
        """What to import. Raises SnergError when nothing was chosen."""
        if not self.filepath:
            raise SnergError(f"No path was given; choose the {self.what} to import.")
        return Path(bpy.path.abspath(self.filepath))

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Note what it came to."""
        folder = project.version_made(self.key, result["to"])
        remember(project, self.key, folder, result)
        return f"Imported the {self.what} into {folder}"
