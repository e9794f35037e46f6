"""Which step the artist is at, and which steps the main panel shows open."""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

import bpy
from bpy.props import BoolProperty, StringProperty

from .bridge import box_of
from .project import project_of

NEXT = {
    "box": "Next: add a box, or import a dataset",
    "dataset": "Next: render or import a dataset",
    "field": "Next: train a field",
    "bake": "Next: bake",
    "export": "Next: export the web page",
}


class SNERG_PG_steps(bpy.types.PropertyGroup):
    """Which steps, and whether the list of results, are open in the sidebar"""

    box: BoolProperty(name="Box", default=True)
    dataset: BoolProperty(name="Dataset", default=False)
    field: BoolProperty(name="Field", default=False)
    bake: BoolProperty(name="Bake", default=False)
    preview: BoolProperty(name="Preview", default=False)
    study: BoolProperty(name="Study", default=False)
    export: BoolProperty(name="Export", default=False)
    results: BoolProperty(name="Results", description="The project's datasets, fields and scenes", default=False)
    followed: StringProperty(name="Followed", description="The project and its step that were opened last", options={"HIDDEN"})


def current(scene: bpy.types.Scene) -> str:
    """The step that comes next: a key of NEXT; '' where all are done."""
    project = project_of(scene)
    if project.has("scene"):
        return "" if project.has("web") else "export"
    if not project.has("field") and not project.has("dataset"):
        return "box" if box_of(scene) is None else "dataset"
    if box_of(scene) is None:
        return "box" if project.has("field") else "field"
    return "bake" if project.has("field") else "field"


def next_step(scene: bpy.types.Scene) -> str:
    """What the artist can do next, in a few words."""
    return NEXT.get(current(scene), "All steps are done")


def follow(scene: bpy.types.Scene) -> bool:
    """Open the step that comes next and close the others, when it has changed. Returns whether it has."""
    state, step = bpy.context.window_manager.snerg_steps, current(scene)
    now = f"{project_of(scene).folder}: {step}"
    if state.followed == now:
        return False
    state.followed = now
    for name in (*NEXT, "preview", "study"):
        setattr(state, name, name == (step or "export"))
    return True


def register() -> None:
    """Keep which steps are open with the window manager: it is not part of the scene, nor of undo."""
    bpy.types.WindowManager.snerg_steps = bpy.props.PointerProperty(type=SNERG_PG_steps)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.snerg_steps


CLASSES = (SNERG_PG_steps,)
