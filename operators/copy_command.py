"""Copy what a step would run as a line for the terminal."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation as a value, hence no postponed evaluation here.

import shlex
import subprocess
import sys

import bpy

from ..core.errors import SnergError
from ..core.geometry.camera_path import CameraPath
from ..snerg_addon.project import Project, project_of
from .bake import baking_arguments
from .camera_move_operator import CameraMoveOperator
from .export_web import takes_move, web_arguments
from .study import study_arguments
from .train import training_arguments

STEPS = ("dataset", "field", "bake", "preview", "study", "export")
RENDER_DATASET = "import bpy; bpy.ops.snerg.render_dataset()"


class SNERG_OT_copy_command(CameraMoveOperator, bpy.types.Operator):
    """Copy the line that does this step in a terminal, with the settings as they are now"""

    bl_idname = "snerg.copy_command"
    bl_label = "Copy as Command"
    bl_options = {"REGISTER"}

    step: bpy.props.EnumProperty(name="Step", items=[(step, step.title(), f"The step {step.title()}") for step in STEPS])

    def needs_move(self, context: bpy.types.Context) -> bool:
        """Whether the line is for a page that is to play an animated camera."""
        return self.step == "export" and takes_move(context.scene)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the line into the clipboard."""
        try:
            line = command_of(self.step, context, project_of(context.scene), self._move)
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.window_manager.clipboard = quoted(line)
        self.report({"INFO"}, f"Copied: {quoted(line)}")
        return {"FINISHED"}


def command_of(step: str, context: bpy.types.Context, project: Project, move: CameraPath | None = None) -> list[str]:
    """The program and arguments of a step. move: see `web_arguments`.

    Raises SnergError where the step cannot be run from a terminal yet.
    """
    blender = bpy.app.binary_path or "blender"
    if step in ("dataset", "preview"):
        if not bpy.data.filepath or bpy.data.is_dirty:
            raise SnergError("The terminal's Blender opens the file from the disk; save it first.")
        scene = ["-b", bpy.data.filepath, "-S", context.scene.name]
        if step == "dataset":
            return [blender, *scene, "--python-exit-code", "1", "--python-expr", RENDER_DATASET]
        return [blender, *scene, "-E", "SNERG", "-f", str(context.scene.frame_current)]
    arguments = {
        "field": lambda: training_arguments(context.scene, project, project.next_version("field")),
        "bake": lambda: ["bake", str(project.field), "--out", str(project.next_version("scene")), *baking_arguments(context, project)],
        "study": lambda: study_arguments(context, project),
        "export": lambda: web_arguments(context, project, move),
    }[step]
    needed = {"field": "dataset", "bake": "field", "study": "field", "export": "scene"}[step]
    if not project.has(needed):
        raise SnergError(f"There is no {needed} yet for this command to start from; make it first.")
    return [blender, "--command", "snerg", *arguments()]


def quoted(arguments: list[str]) -> str:
    """The arguments as one line for the system's shell."""
    return subprocess.list2cmdline(arguments) if sys.platform == "win32" else shlex.join(arguments)
