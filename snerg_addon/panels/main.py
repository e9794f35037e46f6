"""The main panel: the running tasks, the scene's project, and the steps."""

from __future__ import annotations

import textwrap
from pathlib import Path

import bpy

from .. import activity, saving
from ..folder_pattern import problem
from ..owner import adoptable_project
from ..preferences import project_pattern
from ..project import project_of
from ..steps import next_step
from .bake import BakeStep
from .box import BoxStep
from .dataset import DatasetStep
from .export import ExportStep
from .field import FieldStep
from .layout import LINE_WIDTH, SidebarPanel, Step, draw_sentence
from .preview import PreviewStep
from .results import draw_results
from .study import StudyStep

STEPS: tuple[Step, ...] = (BoxStep(), DatasetStep(), FieldStep(), BakeStep(), PreviewStep(), StudyStep(), ExportStep())
"""In the order in which they are needed: the rig's cameras stand round the box."""


class SNERG_PT_main(SidebarPanel, bpy.types.Panel):
    """The scene's project and the running tasks"""

    bl_label = "SNeRG"
    bl_idname = "SNERG_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """The running tasks, the project, the outcome of the last task or else the next step, and the steps."""
        layout, scene = self.layout, context.scene
        project = project_of(scene).folder
        for running in activity.current(project):
            draw_task(layout, running)
        row = layout.row(align=True)
        row.prop(scene.snerg, "folder", text="", icon="FILE_FOLDER", placeholder="Beside the .blend")
        row.operator("snerg.open_folder", text="", icon="FOLDER_REDIRECT")
        draw_project(layout, scene)
        if report := activity.last_report(project):
            draw_sentence(layout.column(align=True), activity.within(project, report[0]), "INFO" if report[1] else "ERROR")
        if not activity.current(project):
            layout.label(text=next_step(scene), icon="FORWARD")
        draw_results(layout, scene)
        for step in STEPS:
            step.draw(layout, context)


def draw_project(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Which file and scene the project belongs to, and another project that the artist may want in its place."""
    if sentence := problem(project_pattern()):
        draw_sentence(layout.column(align=True), f"{sentence} That is in the preferences.", "ERROR")
    if not bpy.data.filepath:
        draw_sentence(layout.column(align=True), "The project moves beside the .blend when you save the file.", "INFO")
        for folder in saving.orphaned_projects()[:1] if not project_of(scene).folder.is_dir() else ():
            column = layout.box().column(align=True)
            draw_sentence(column, "There is the project of a file that was never saved.", "INFO")
            column.operator("snerg.adopt_project").folder = str(folder)
        return
    layout.label(text=f"Project of {Path(bpy.data.filepath).name}, {scene.name}", icon="FILE_BLEND")
    if other := adoptable_project(scene):
        folder, owner = other
        column = layout.box().column(align=True)
        sentence = f"The folder {folder.parent.name}/{folder.name} belongs to {owner}. This scene starts its own project."
        draw_sentence(column, sentence, "INFO")
        column.operator("snerg.adopt_project").folder = str(folder)


def draw_task(layout: bpy.types.UILayout, running: activity.Activity) -> None:
    """A task's progress bar, the button that stops it, and its sticky notes."""
    task = running.task
    column = layout.column(align=True)
    column.label(text=running.label, icon="PAUSE" if task.state == "waiting" else "SORTTIME")
    row = column.row(align=True)
    row.progress(factor=task.fraction, text=f"{task.fraction:.0%}")
    stop = row.row(align=True)
    stop.enabled = not task.cancelling
    stop.operator("snerg.cancel", text="", icon="CANCEL").work = running.key
    for line in textwrap.wrap(task.text, LINE_WIDTH):
        column.label(text=line)
    column.label(text="Continues when Blender closes" if running.outlives else "Stops when Blender closes")
    if not task.notes:
        return
    header, body = layout.panel(f"SNERG_notes_{running.step}", default_closed=True)
    header.label(text=f"{len(task.notes)} note{'s' if len(task.notes) > 1 else ''}", icon="INFO")
    if body:
        for note in task.notes:
            draw_sentence(body.column(align=True), note, "DOT")
