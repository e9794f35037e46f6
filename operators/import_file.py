"""Import whatever a file belongs to: a dataset, a field or a baked scene."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotation of `filepath` as a value, hence no postponed evaluation here.

import re
from pathlib import Path

import bpy

from ..core.artifact import FIELDS, SCENES, is_dataset, kind_of
from ..core.errors import SnergError
from ..snerg_addon.properties import RELATIVE_PATHS
from .task_operator import hand_over

SPLIT = re.compile(r"transforms_(train|val|test)\.json")


class SNERG_OT_import_file(bpy.types.Operator):
    """Import a dataset, a field, a checkpoint or a baked scene, whichever the file or its folder is"""

    bl_idname = "snerg.import_file"
    bl_label = "Import Any"
    bl_options = {"REGISTER"}

    filepath: bpy.props.StringProperty(
        name="Path", description="The file or folder to import", subtype="FILE_PATH", options={"SKIP_SAVE", *RELATIVE_PATHS}
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the file browser, unless a file was dropped."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the import of its kind."""
        try:
            name, path = importer_of(Path(bpy.path.abspath(self.filepath)))
        except SnergError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        how = "EXEC_DEFAULT" if bpy.app.background or context.window is None else "INVOKE_DEFAULT"
        return hand_over(self, name, how, filepath=str(path))


def importer_of(path: Path) -> tuple[str, Path]:
    """(the operator that imports a path, the path for it): the file itself, else the folder that it lies in. Raises SnergError.

    A file that holds one split of a dataset stands for its folder: no folder can be dropped.
    """
    if SPLIT.fullmatch(path.name) and is_dataset(path.parent):
        return "import_dataset", path.parent
    try:
        kind, found = kind_of(path), path
    except SnergError:
        if not path.is_file():
            raise
        kind, found = kind_of(path.parent), path.parent
    if kind in FIELDS:
        return "import_field", found
    return ("import_scene" if kind in SCENES else "import_dataset"), found
