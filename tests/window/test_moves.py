"""The export of a camera's move by clicks. The walk is in moves.py; pictures: build/window."""

from __future__ import annotations

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene

from .conftest import OUT


def test_a_camera_that_turns_round_the_scene_is_counted_and_exported(blender):
    write_scene(make_snerg((34, 30, 40), diffuse=True), OUT / "turned scene" / "scene")
    seen = blender.walk("camera_move", OUT / "turned scene" / "scene" / "scene.json")
    assert "No camera is animated" in seen["still"] and "No camera is animated" not in seen["moving"], seen
    assert "snerg.count_keyframes" in seen["moving"]
    assert seen["counting"] and seen["stopped after"] < 5, seen  # a second, and what a busy machine adds
    assert "snerg.count_keyframes" in seen["stopped"] and seen["stopped at"] == 20
    assert any("keyframes, " in text for text in seen["counted"]), seen["counted"]
    assert seen["frame"] == 20, "the timeline stays where it was"
    assert {"optional", "path.json"} <= set(seen["files"]), seen["files"]
    assert (seen["path"]["start"], seen["path"]["end"]) == (1, 60) and len(seen["path"]["shots"][0]["keys"]) > 3
    assert "snergOptional" in seen["script"]
