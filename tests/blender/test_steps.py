"""The main panel's steps: which comes next, which are open, and the presets."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from snerg.core.geometry.box import Box
from snerg.snerg_addon import presets, steps
from snerg.snerg_addon.bridge import add_box
from snerg.snerg_addon.panels.main import STEPS
from snerg.snerg_addon.project import project_of


def opened() -> set[str]:
    """The steps that are open."""
    state = bpy.context.window_manager.snerg_steps
    return {step.key for step in STEPS if getattr(state, step.key)}


def make(scene, step: str) -> None:
    """What a step leaves in the project."""
    project = project_of(scene)
    marks = {
        "dataset": project.own_dataset / "transforms_train.json",
        "field": project.folder / "field" / "field.npz",
        "scene": project.folder / "scene" / "scene.json",
        "web": project.web / "index.html",
    }
    marks[step].parent.mkdir(parents=True, exist_ok=True)
    marks[step].write_text("{}")


def test_the_step_that_comes_next_opens_and_the_others_close(scene):
    assert steps.follow(scene) and opened() == {"box"}
    bpy.context.window_manager.snerg_steps.export = True  # the artist looks ahead
    assert not steps.follow(scene) and opened() == {"box", "export"}, "what the artist opened stays until a step is done"
    add_box(Box.axis_aligned(np.zeros(3), np.ones(3)), scene)
    assert steps.follow(scene) and opened() == {"dataset"}
    for made, comes in (("dataset", "field"), ("field", "bake"), ("scene", "export"), ("web", "export")):
        make(scene, made)
        assert steps.follow(scene) and opened() == {comes}
    assert steps.next_step(scene) == "All steps are done"


def test_every_step_has_its_property_and_a_name(addon):
    known = {prop.identifier for prop in steps.SNERG_PG_steps.bl_rna.properties}
    assert {step.key for step in STEPS} <= known and {step.label for step in STEPS} == {step.label.strip() for step in STEPS}


@pytest.mark.parametrize("name", list(presets.PRESETS))
def test_a_preset_sets_training_and_bake_and_nothing_else(scene, name):
    scene.snerg.steps, scene.snerg.voxel_size, scene.snerg.seed = 50, 0.1, 7
    preset = presets.PRESETS[name]
    assert not presets.is_set(preset, scene)
    assert bpy.ops.snerg.apply_preset(preset=name) == {"FINISHED"}
    assert presets.is_set(preset, scene) and scene.snerg.seed == 7
    assert [presets.is_set(other, scene) for other in presets.PRESETS.values()].count(True) == 1
    assert presets.takes(preset, bpy.context).startswith(f"{preset.minutes:g} min"), "without a measured field, the training alone is known"
