"""The field panel: how to train, the training curve, and what training decided."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import bpy

from ...operators.train import unfinished
from .. import activity, pictures, training_python
from ..curve import Curve, curve_of
from ..presets import PRESETS, is_set, takes
from ..project import Project, project_of
from .layout import LINE_WIDTH, Step, decibels, draw_box, draw_sentence, joined, megabytes
from .versions import made_with

CURVE_SCALE = 8.0  # of the curve's picture, in rows of the panel


class FieldStep(Step):
    """The radiance field"""

    key, label, done = "field", "Field", "field"

    def draw_header(self, header: bpy.types.UILayout) -> None:
        """Importing, in place of training."""
        header.operator("snerg.import_field", text="", icon="IMPORT", emboss=False)

    def draw_step(self, layout: bpy.types.UILayout, settings: Any, context: bpy.types.Context) -> None:
        """The settings, the buttons, the training curve, and what the version in use is."""
        project = project_of(context.scene)
        draw_presets(layout, context)
        layout.prop(settings, "minutes")
        layout.prop(settings, "view_dependence")
        layout.prop(settings, "show_training")
        draw_advanced(layout, settings)
        if answer := training_python.devices():
            draw_sentence(layout.column(align=True), f"Another Python trains. {answer.text}", answer.icon)
        layout.operator("snerg.train", icon="PLAY", text="Continue Training" if can_continue(context.scene) else "Train Field")
        layout.operator("snerg.import_field", icon="IMPORT")
        if curve := curve_of(shown_training(project)):
            if len(curve.points) > 1:
                layout.template_icon(pictures.icon_of_curve(curve), scale=CURVE_SCALE)
            draw_box(layout, *curve_texts(curve))
        if project.has("field"):
            note = project.notes().get("field", {})
            draw_box(layout, joined(decibels(note), steps_text(note), megabytes(note)), *made_with(project, "field"))
            for decision in note.get("decisions", []):
                draw_decision(layout, decision)


def draw_presets(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """A row for each preset: its button, and what it takes."""
    column = layout.column(align=True)
    for key, preset in PRESETS.items():
        row = column.split(factor=0.3, align=True)
        row.operator("snerg.apply_preset", text=preset.name, depress=is_set(preset, context.scene)).preset = key
        row.label(text=takes(preset, context))


def draw_advanced(layout: bpy.types.UILayout, settings: Any) -> None:
    """What few change, closed at first."""
    header, body = layout.panel("SNERG_advanced_field", default_closed=True)
    header.label(text="Advanced")
    if body is None:
        return
    body.prop(settings, "preset")
    column = body.column(align=True)
    column.prop(settings, "steps")
    column.prop(settings, "seed")
    body.prop(settings, "train_background")
    if settings.train_background == "colour":
        body.prop(settings, "train_colour")
    body.prop(settings, "downscale")


def can_continue(scene: bpy.types.Scene) -> bool:
    """Whether training now would continue an unfinished training: one with the same settings, while none runs."""
    project = project_of(scene)
    return not training_runs(project) and unfinished(scene, project) is not None


def training_runs(project: Project) -> bool:
    """Whether a training of the project waits or runs."""
    return any(running.step == "field" for running in activity.current(project.folder))


def shown_training(project: Project) -> Path:
    """The version whose training curve is shown: the one that is being trained, else the one in use."""
    last = project.notes().get("training", {}).get("out")
    return project.folder / str(last) if last and training_runs(project) else project.field


def curve_texts(curve: Curve) -> tuple[str, str]:
    """('31.2 dB on held-out views', '4200 steps, 2:31 min'); both empty before the first line of the log."""
    if curve.held_out is not None:
        quality = f"{curve.held_out:.1f} dB on held-out views"
    else:
        quality = f"{curve.psnr:.1f} dB on training rays" if curve.psnr is not None else ""
    if not curve.steps:
        return quality, ""
    return quality, joined(f"{curve.steps} steps", f"{int(curve.seconds) // 60}:{int(curve.seconds) % 60:02d} min")


def draw_decision(layout: bpy.types.UILayout, decision: Any) -> None:
    """What training decided about an effect, and the evidence for it."""
    if not isinstance(decision, dict):
        return
    value = decision.get("chosen")
    chosen = ("yes" if value else "no") if isinstance(value, bool) else str(value)
    evidence = textwrap.wrap(str(decision.get("evidence", "")), LINE_WIDTH)
    draw_box(layout, f"{decision.get('effect')}: {chosen}{' (as set)' if decision.get('overridden') else ''}", *evidence)


def steps_text(note: dict[str, Any]) -> str:
    """'4200 steps'; '' where that is not known."""
    steps = note.get("steps")
    return f"{steps} steps" if isinstance(steps, int) else ""
