"""The box by clicks: its arrows, undo, and what is drawn beforehand."""

from __future__ import annotations

import pytest


def test_a_face_is_dragged_undone_and_let_be(blender):
    seen = blender.walk("box_handles")
    before, dragged, undone, redone, escaped = seen["sizes"]
    assert before == pytest.approx(2.1) and dragged - before == pytest.approx(1, abs=0.1), seen["sizes"]
    assert undone == pytest.approx(before) and redone == pytest.approx(dragged) and escaped == pytest.approx(dragged)
