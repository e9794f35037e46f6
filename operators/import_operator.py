"""The base of the three import operators: dataset, field and baked scene."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `filepath` as a value, hence no postponed evaluation here.

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..core.artifact import check_kind
from ..core.errors import SnergError
from ..core.jobs.runner import start_command
from ..core.jobs.task import Task
from ..snerg_addon.project import Project, remember
from ..snerg_addon.properties import RELATIVE_PATHS
from .task_operator import TaskOperator, hand_over


class ImportOperator(TaskOperator):
    """key: the step of the project that the import fills, and the end of the operator's name. noun: what it imports, in a sentence.

    kinds: what it imports, as core.artifact.kind_of names it. accepted: a filter for the files that the file browser shows, besides
    folders.
    """

    key: ClassVar[str]
    noun: ClassVar[str]
    kinds: ClassVar[tuple[str, ...]]
    accepted: ClassVar[str] = "*"

    filepath: bpy.props.StringProperty(
        name="Path", description="The file or folder to import", subtype="FILE_PATH", options={"SKIP_SAVE", *RELATIVE_PATHS}
    )

    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Open the file browser first, where there is a window and no path yet."""
        if self.filepath or bpy.app.background or context.window is None:
            return super().invoke(context, event)
        self._from_browser = True
        self.filepath = bpy.path.abspath("//") if bpy.data.filepath else ""  # else the browser proposes the .blend's own name
        self.filter_glob = self.accepted
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run and wait. After the file browser: invoke the operator again with the path, so that the window stays free."""
        if getattr(self, "_from_browser", False):
            return hand_over(self, f"import_{self.key}", "INVOKE_DEFAULT", filepath=self.filepath)  # type: ignore[arg-type]
        return super().execute(context)

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """The command `import`. Raises SnergError, before anything is written, where something of another kind was chosen."""
        return start_command(["import", str(self.path()), "--out", str(project.new_version(self.key))])

    def path(self) -> Path:
        """The file or folder to import; for a file inside a folder of what is imported, that folder.

        Raises SnergError when none was chosen, or something of another kind.
        """
        if not self.filepath:
            raise SnergError(f"No path was given; choose the {self.noun} to import.")
        return check_kind(Path(bpy.path.abspath(self.filepath)), self.kinds, self.noun)

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Record the new version and put it in use."""
        folder = project.version_made(self.key, result["to"])
        remember(project, self.key, folder, result)
        return f"Imported the {self.noun} into {folder}"
