"""The sidebar's panel by clicks and keys. The walks are in panel.py; pictures: build/window."""

from __future__ import annotations


def test_each_step_opens(blender, photos, trained):
    assert blender.walk("steps_opened", photos, trained)["width"] > 200
