"""Annotations: empties with a text, from Blender's panel to the command of the export."""

from __future__ import annotations

import json

import bpy
import pytest
from stage import add_camera

from snerg.core.cli import parser
from snerg.core.export.annotations import Annotation, read_annotations
from snerg.snerg_addon.annotation_objects import core_annotations, notes_of, units_of
from snerg.tests.blender.test_operators import started


def add_empty(name, location=(0, 0, 0)):
    empty = bpy.data.objects.new(name, None)
    empty.location = location
    bpy.context.scene.collection.objects.link(empty)
    return empty


def test_empties_become_annotations(scene):
    """Selected ones with their names as texts; without a selection a new one at the cursor."""
    window, door = add_empty("Window", (1, 2, 3)), add_empty("Door")
    door.snerg_note.text = "The door\nof 1912"
    for thing in (window, door):
        thing.select_set(True)
    assert bpy.ops.snerg.add_annotation() == {"FINISHED"}
    assert window.snerg_note.text == "Window" and door.snerg_note.text == "The door\nof 1912", "a text is not overwritten"
    bpy.ops.object.select_all(action="DESELECT")
    scene.cursor.location = (4, 5, 6)
    assert bpy.ops.snerg.add_annotation() == {"FINISHED"}
    assert [thing.name for thing in notes_of(scene)] == ["Annotation", "Door", "Window"]
    assert tuple(notes_of(scene)[0].location) == (4, 5, 6)
    assert bpy.ops.snerg.remove_annotation(name="Annotation") == {"FINISHED"}
    assert "Annotation" in scene.objects and len(notes_of(scene)) == 2
    with pytest.raises(RuntimeError, match="no object 'Nothing'"):
        bpy.ops.snerg.remove_annotation(name="Nothing")


def test_they_are_exported_where_they_stand(scene, monkeypatch):
    """A parent moves them; the camera is named."""
    assert "--annotations" not in started(monkeypatch, "export_web")
    parent, empty, camera = add_empty("Parent", (10, 0, 0)), add_empty("Window", (1, 2, 3)), add_camera()
    empty.parent, empty.snerg_note.text, empty.snerg_note.camera = parent, "--out", camera
    parsed = parser().parse_args(started(monkeypatch, "export_web"))
    assert read_annotations(parsed.annotations) == (Annotation("--out", (11, 2, 3), camera.name),)
    assert json.loads(parsed.annotations.read_text())["format"] == "snerg-annotations"
    assert not parsed.measure and not parsed.vr
    scene.snerg.shows_annotations = False
    assert "--annotations" not in started(monkeypatch, "export_web")
    assert len(core_annotations(scene)) == 1


def test_the_page_measures_in_the_scenes_units(scene, monkeypatch):
    settings = scene.unit_settings
    for system, scale, expected in (("METRIC", 0.01, "metric"), ("IMPERIAL", 1.0, "imperial"), ("NONE", 1.0, "none")):
        settings.system, settings.scale_length = system, scale
        found = units_of(scene)
        assert found.metres == pytest.approx(scale) and found.system == expected
    settings.system, settings.scale_length = "METRIC", 0.01
    scene.snerg.measures, scene.snerg.enters_vr = True, True
    parsed = parser().parse_args(started(monkeypatch, "export_web"))
    assert parsed.measure and parsed.vr and parsed.unit_system == "metric" and parsed.unit_scale == pytest.approx(0.01)
