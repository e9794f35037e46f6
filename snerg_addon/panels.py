"""The sidebar of the 3D view: one panel a step, each saying what is there and what to do."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..operators.train import unfinished
from . import activity, ahead, saving
from .bridge import PREVIEW, STUDY, box_of, resolution
from .capture import views_there
from .curve import Curve, curve_of
from .owner import offered
from .project import Project, no_dataset, project_of
from .properties import LOSSY

LINE = 44  # characters of a sentence in the sidebar as it opens


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SNeRG"


class SNERG_PT_main(_Sidebar, bpy.types.Panel):
    """The project, and what is under way"""

    bl_label = "SNeRG"
    bl_idname = "SNERG_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """Progress while something runs, else what to do next."""
        layout, scene = self.layout, context.scene
        row = layout.row(align=True)
        row.prop(scene.snerg, "folder", text="", icon="FILE_FOLDER", placeholder="Beside the .blend")
        row.operator("snerg.open_folder", text="", icon="FILEBROWSER")
        project = project_of(scene).folder
        draw_owner(layout, scene)
        for busy in activity.current(project):
            draw_progress(layout, busy)
        draw_last(layout, activity.said(project))
        if not activity.current(project):
            layout.label(text=next_step(scene), icon="FORWARD")


def draw_owner(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Whose project is shown, and the other one that the artist may mean."""
    if not bpy.data.filepath:
        layout.label(text="Saving the file moves the project beside it", icon="INFO")
        for folder in saving.forgotten()[:1]:
            row = layout.row()
            row.label(text="Work of a file that was never saved")
            row.operator("snerg.adopt_project", text="Use It Here").folder = str(folder)
        return
    layout.label(text=f"Project of {Path(bpy.data.filepath).name}, {scene.name}", icon="FILE_BLEND")
    if other := offered(scene):
        column = layout.box().column(align=True)
        said = f"The folder {other[0].parent.name}/{other[0].name} belongs to {other[1]}. This scene begins a project of its own."
        for index, line in enumerate(textwrap.wrap(said, LINE)):
            column.label(text=line, icon="BLANK1" if index else "INFO")
        column.operator("snerg.adopt_project").folder = str(other[0])


def draw_progress(layout: bpy.types.UILayout, busy: activity.Activity) -> None:
    """A bar with the message, and the button that stops it."""
    work = busy.work
    column = layout.column(align=True)
    column.label(text=busy.label, icon="SORTTIME")
    row = column.row(align=True)
    row.progress(factor=work.fraction, text=work.message or f"{work.fraction:.0%}")
    stop = row.row(align=True)
    stop.enabled = not work.cancelling
    stop.operator("snerg.cancel", text="", icon="CANCEL").work = busy.key
    column.label(text="Goes on when Blender closes" if busy.outlives else "Ends when Blender closes")
    for note in work.notes:
        facts(column, *textwrap.wrap(note, LINE - 6))


def draw_last(layout: bpy.types.UILayout, said: tuple[str, bool] | None) -> None:
    """What came of the last work, on as many lines as it takes."""
    if said is not None:
        column = layout.column(align=True)
        for index, line in enumerate(textwrap.wrap(said[0], LINE - 6)):
            column.label(text=line, icon="BLANK1" if index else "INFO" if said[1] else "ERROR")


def next_step(scene: bpy.types.Scene) -> str:
    """What the artist does next, in a few words."""
    project = project_of(scene)
    if not project.has("scene"):
        if not project.has("field"):
            return "Next: train a field" if project.has("dataset") else "Next: render or import a dataset"
        return "Next: bake" if box_of(scene) else "Next: add a box, then bake"
    if bpy.data.images.get(PREVIEW) is None:
        return "Next: preview or export"
    return "Next: export the web page" if not project.has("web") else "All steps are done"


class _Step(_Sidebar):
    """A sub-panel. done: the project's step whose presence ticks it."""

    bl_parent_id = "SNERG_PT_main"
    done: ClassVar[str] = ""

    def is_done(self, context: bpy.types.Context) -> bool:
        return project_of(context.scene).has(self.done)

    def draw_header(self: Any, context: bpy.types.Context) -> None:
        self.layout.label(text="", icon="CHECKMARK" if self.is_done(context) else "RADIOBUT_OFF")

    def draw(self: Any, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        self.draw_step(layout, context.scene.snerg, context)


def facts(layout: bpy.types.UILayout, *lines: str) -> None:
    """What is known of a step's result, small and set off."""
    lines = tuple(line for line in lines if line)
    if lines:
        column = layout.box().column(align=True)
        for line in lines:
            column.label(text=line)


def megabytes(note: dict[str, Any]) -> str:
    """'12.3 MB', or nothing when the size is not known."""
    size = note.get("bytes")
    return f"{size / 1e6:.1f} MB" if isinstance(size, int | float) else ""


def decibels(note: dict[str, Any], key: str = "psnr") -> str:
    """'31.2 dB', or nothing when the quality is not known."""
    value = note.get(key)
    return f"{value:.1f} dB" if isinstance(value, int | float) else ""


def joined(*parts: str) -> str:
    """The parts that say something, with commas."""
    return ", ".join(part for part in parts if part)


class SNERG_PT_dataset(_Step, bpy.types.Panel):
    """Photographs to learn from"""

    bl_label = "Dataset"
    bl_idname = "SNERG_PT_dataset"
    done = "dataset"

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """Cameras, what is rendered, and a folder of one's own."""
        layout.prop(settings, "cameras")
        column = layout.column(align=True)
        if settings.cameras == "RIG":
            column.prop(settings, "rig_count")
            column.prop(settings, "rig_shape")
            column.prop(settings, "rig_angle")
            column.prop(settings, "rig_distance")
            if box_of(context.scene) is None:
                column.label(text="The rig needs a box", icon="INFO")
        column.prop(settings, "test_every")
        layout.label(text=joined(camera_count(context), "{} x {} px".format(*resolution(context.scene))), icon="OUTLINER_OB_CAMERA")
        draw_render(layout, project_of(context.scene))
        layout.operator("snerg.import_dataset", icon="IMPORT")
        layout.prop(settings, "dataset", text="Train On")
        if settings.dataset and (wrong := no_dataset(project_of(context.scene), settings.dataset)):
            facts(layout, *textwrap.wrap(wrong, LINE))
        note = project_of(context.scene).notes().get("dataset", {})
        if note and not settings.dataset:
            views = f"{note.get('train')} + {note.get('test')} test views"
            facts(layout, views, joined(f"{note.get('width')} x {note.get('height')} px", megabytes(note)))


def draw_render(layout: bpy.types.UILayout, project: Project) -> None:
    """The button, and what there is of a rendering that was stopped."""
    there, views = views_there(project.own_dataset)
    if not there or any(busy.step == "dataset" for busy in activity.current(project.folder)):
        layout.operator("snerg.render_dataset", icon="RENDER_STILL")
        return
    column = layout.column(align=True)
    column.label(text=f"{there} of {views} views were rendered", icon="INFO")
    column.operator("snerg.render_dataset", icon="RENDER_STILL", text="Render the Others").goes_on = True
    column.operator("snerg.render_dataset", text="Render All Anew").goes_on = False
    column.operator("snerg.use_views")


def camera_count(context: bpy.types.Context) -> str:
    """How many views there will be."""
    settings = context.scene.snerg
    if settings.cameras == "RIG":
        count = settings.rig_count
    else:
        cameras = [thing for thing in context.scene.objects if thing.type == "CAMERA"]
        count = len(cameras) if settings.cameras == "ALL" else sum(camera.select_get() for camera in cameras)
    return "1 camera" if count == 1 else f"{count} cameras"


class SNERG_PT_field(_Step, bpy.types.Panel):
    """The radiance field"""

    bl_label = "Field"
    bl_idname = "SNERG_PT_field"
    done = "field"

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """How to train, how it goes, and what it came to."""
        project = project_of(context.scene)
        layout.prop(settings, "preset")
        column = layout.column(align=True)
        time = column.row(align=True)
        time.active = settings.steps == 0
        time.prop(settings, "minutes")
        column.prop(settings, "steps")
        column.prop(settings, "seed")
        layout.prop(settings, "view_dependence")
        layout.prop(settings, "train_background")
        if settings.train_background == "colour":
            layout.prop(settings, "train_colour")
        layout.prop(settings, "downscale")
        curve = curve_of(shown_training(project))
        layout.operator("snerg.train", icon="PLAY", text="Continue Training" if goes_on(context.scene) else "Train Field")
        layout.operator("snerg.import_field", icon="IMPORT")
        note = project.notes().get("field", {})
        if curve is not None:
            facts(layout, curve.bars, *curve_texts(curve))
        if project.has("field"):
            facts(layout, joined(decibels(note), steps_text(note), megabytes(note)) or "A field is there", *made(project, "field"))
            for decision in note.get("decisions", []):
                draw_decision(layout, decision)
        draw_versions(layout, project, "field")


def goes_on(scene: bpy.types.Scene) -> bool:
    """Whether training now would go on with one that was stopped: it did not reach its end, and nothing was set otherwise since."""
    project = project_of(scene)
    return not training_runs(project) and unfinished(scene, project) is not None


def training_runs(project: Project) -> bool:
    """Whether a training of the project is under way."""
    return any(begun.step == "field" for begun in activity.current(project.folder))


def shown_training(project: Project) -> Path:
    """The version whose curve is shown: the one that is trained now, else the one in use."""
    last = project.notes().get("training", {}).get("out")
    return project.folder / str(last) if last and training_runs(project) else project.field


def made(project: Project, step: str) -> list[str]:
    """When the version in use was made, and with which settings, on as many lines as it takes."""
    version = project.in_use(step)
    return textwrap.wrap(joined(str(project.note_of(version).get("when", "")), project.settings_of(version)), LINE)


def draw_versions(layout: bpy.types.UILayout, project: Project, step: str) -> None:
    """A line a version, the newest first: which is in use, its quality, and what can be done with it."""
    in_use = project.in_use(step)
    column = layout.column(align=True)
    for version in reversed(project.versions(step)):
        note, row = project.note_of(version), column.row(align=True)
        quality = decibels(note) or ("" if note else "stopped" if step == "field" else "")
        use = row.operator(
            "snerg.use_version",
            text=joined(project.name_of(version), quality, megabytes(note)),
            icon="RADIOBUT_ON" if version == in_use else "RADIOBUT_OFF",
            depress=version == in_use,
        )
        rename = row.operator("snerg.rename_version", text="", icon="GREASEPENCIL")
        delete = row.operator("snerg.delete_version", text="", icon="TRASH")
        for button in (use, rename, delete):
            button.step, button.version = step, version.name


def curve_texts(curve: Curve) -> tuple[str, str]:
    """('31.2 dB on held-out views', '4200 steps, 2:31 min'); both empty before the first line of the log."""
    if curve.held_out is not None:
        quality = f"{curve.held_out:.1f} dB on held-out views"
    else:
        quality = f"{curve.psnr:.1f} dB on training rays" if curve.psnr is not None else ""
    if not curve.steps:  # the log of a training that has only begun says nothing yet
        return quality, ""
    return quality, joined(f"{curve.steps} steps", f"{int(curve.seconds) // 60}:{int(curve.seconds) % 60:02d} min")


def draw_decision(layout: bpy.types.UILayout, decision: Any) -> None:
    """What training decided, and the evidence on as many lines as it takes."""
    if not isinstance(decision, dict):
        return
    value = decision.get("chosen")
    chosen = ("yes" if value else "no") if isinstance(value, bool) else str(value)
    lines = textwrap.wrap(str(decision.get("evidence", "")), LINE)
    facts(layout, f"{decision.get('effect')}: {chosen}{' (as set)' if decision.get('overridden') else ''}", *lines)


def steps_text(note: dict[str, Any]) -> str:
    """'4200 steps'"""
    steps = note.get("steps")
    return f"{steps} steps" if isinstance(steps, int) else ""


class SNERG_PT_box(_Step, bpy.types.Panel):
    """What is baked"""

    bl_label = "Box"
    bl_idname = "SNERG_PT_box"

    def is_done(self, context: bpy.types.Context) -> bool:
        """A box is chosen, and was not deleted since."""
        return box_of(context.scene) is not None

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """Choose or add one; move it like any object."""
        layout.prop(settings, "box", icon="EMPTY_AXIS")
        layout.operator("snerg.add_box", icon="CUBE")
        box = box_of(context.scene)
        if settings.box and box is None:
            facts(layout, f"{settings.box.name} was deleted: there is no box")
        if box:
            size = [2 * abs(s) * box.empty_display_size for s in box.matrix_world.to_scale()]
            unit = context.scene.unit_settings
            texts = [bpy.utils.units.to_string(unit.system, "LENGTH", s * unit.scale_length, precision=3) for s in size]
            facts(layout, " x ".join(texts), "Move, turn and scale it in the view")


class SNERG_PT_bake(_Step, bpy.types.Panel):
    """The baked scene"""

    bl_label = "Bake"
    bl_idname = "SNERG_PT_bake"
    done = "scene"

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """How fine, and how large it came out."""
        project = project_of(context.scene)
        column = layout.column(align=True)
        number = column.row(align=True)
        number.active = settings.voxel_size == 0
        number.prop(settings, "resolution")
        column.prop(settings, "voxel_size")
        column.prop(settings, "samples")
        layout.prop(settings, "refine")
        lines = ahead.texts(context)
        facts(layout, *(part for line in lines for part in textwrap.wrap(line, LINE)))
        layout.operator("snerg.estimate", icon="TIME", text="Estimate Again" if lines else "Estimate")
        layout.operator("snerg.bake", icon="RENDER_STILL")
        layout.operator("snerg.import_scene", icon="IMPORT")
        note = project.notes().get("scene", {})
        if project.has("scene"):
            blocks = f"{note['blocks']} blocks" if isinstance(note.get("blocks"), int) else ""
            facts(layout, joined(decibels(note), blocks, megabytes(note)) or "A baked scene is there", *made(project, "scene"))
        draw_versions(layout, project, "scene")


class SNERG_PT_preview(_Step, bpy.types.Panel):
    """The baked scene in Blender"""

    bl_label = "Preview"
    bl_idname = "SNERG_PT_preview"

    def is_done(self, context: bpy.types.Context) -> bool:
        """There is a picture."""
        return PREVIEW in bpy.data.images

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """From the active camera."""
        layout.prop(context.scene, "camera")
        row = layout.row()
        row.active = not settings.transparent
        row.prop(settings, "background")
        layout.prop(settings, "transparent")
        layout.operator("snerg.preview", icon="IMAGE_DATA")
        if self.is_done(context):
            width, height = bpy.data.images[PREVIEW].size
            facts(layout, f"{width} x {height} px in the image {PREVIEW!r}")


class SNERG_PT_study(_Step, bpy.types.Panel):
    """What accuracy costs"""

    bl_label = "Study"
    bl_idname = "SNERG_PT_study"
    bl_options = {"DEFAULT_CLOSED"}

    def is_done(self, context: bpy.types.Context) -> bool:
        """There is a report."""
        return "study" in project_of(context.scene).notes()

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """How long to measure, and where the report is."""
        column = layout.column(align=True)
        column.prop(settings, "study_minutes")
        column.prop(settings, "target_db")
        layout.operator("snerg.study", icon="GRAPH")
        note = project_of(context.scene).notes().get("study", {})
        if note:
            left = f"{note['left_out']} left for later" if note.get("left_out") else ""
            facts(layout, f"{note.get('configurations', 0)} configurations", left)
            layout.operator("wm.path_open", text="Open Report", icon="URL").filepath = str(note.get("report", ""))
        if STUDY in bpy.data.images:
            facts(layout, f"Beside the truth: the image {STUDY!r}")


class SNERG_PT_export(_Step, bpy.types.Panel):
    """The baked scene elsewhere"""

    bl_label = "Export"
    bl_idname = "SNERG_PT_export"

    def is_done(self, context: bpy.types.Context) -> bool:
        """Either export is there."""
        project: Project = project_of(context.scene)
        return project.has("web") or project.has("reference")

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """A page for everyone, and files for other tools."""
        notes = project_of(context.scene).notes()
        layout.prop(settings, "web_cameras")
        column = layout.column(align=True)
        column.prop(settings, "codec")
        if settings.codec in LOSSY:
            column.prop(settings, "quality")
        layout.prop(settings, "single_file")
        layout.operator("snerg.export_web", icon="URL")
        layout.operator("snerg.export_scene", icon="EXPORT")
        facts(
            layout,
            joined("Web page", megabytes(notes["web"])) if "web" in notes else "",
            joined("Scene files", megabytes(notes["reference"])) if "reference" in notes else "",
        )


CLASSES = (
    SNERG_PT_main,
    SNERG_PT_dataset,
    SNERG_PT_field,
    SNERG_PT_box,
    SNERG_PT_bake,
    SNERG_PT_preview,
    SNERG_PT_study,
    SNERG_PT_export,
)
