"""The whole panel by clicks and keys, by the search and by dropped files. The walks are in panel.py; pictures: build/window."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from scenes import make_snerg
from snerg.core.export.scene_files import write_scene

from .conftest import OUT

LONG = 1500  # seconds that a walk through all steps may take where Blender draws by software
TABS = 20  # pixels of the sidebar that its tabs take
MARGINS = 28  # pixels beside the content of a step
NAMES_SHARE = 0.4  # of the content's width, which Blender gives to the names of settings
PADDING = {"setting": 6, "check box": 26, "line": 12, "button": 32}  # pixels round a text, and for the icon beside it


@pytest.fixture(scope="module")
def opened(blender, photos, trained):
    return blender.walk("steps_opened", photos, trained, seconds=LONG)


def test_every_name_is_readable_at_the_sidebars_default_width(opened):
    content = opened["width"] - TABS - MARGINS
    room = {"setting": NAMES_SHARE * content, "check box": (1 - NAMES_SHARE) * content, "line": content, "button": content}
    assert opened["cut"] > room["setting"] - PADDING["setting"], "The measure finds no name too long"
    cut = [(kind, name) for kind, name, width in opened["names"] if width > room[kind] - PADDING[kind]]
    assert len(opened["names"]) > 50 and not cut, f"Blender cuts these names at the default width: {cut}"


def test_the_estimate_follows_the_box_while_it_is_scaled(opened, blender):
    left, width = opened["sidebar"]
    pictures = [blender.folder("steps_opened") / f"live-{name}.png" for name in ("before", "scaled")]
    before, scaled = (np.asarray(Image.open(path).convert("L")) for path in pictures)
    changed = np.flatnonzero((before != scaled)[:, left : left + width - TABS].any(axis=1))
    assert len(changed) > 5, "The estimate stays as it was while the box is scaled; see live-before.png and live-scaled.png"


@pytest.fixture(scope="module")
def page(blender):
    return blender.walk("empty_to_page", seconds=LONG)


def test_clicks_and_keys_lead_from_the_empty_file_to_the_page(page):
    assert "<!doctype html>" in page["page"].lower(), page


def test_every_step_is_undone_and_redone(page):
    for name, (before, undone, redone) in page["states"].items():
        assert redone == before != undone, f"{name}: {page['states'][name]}"
        assert undone[-1] == before[-1], f"{name}: undo changed the project's files"
    assert page["states"]["all"][1][:5] == [None, "ALL", 100, 256, 0]


def test_the_search_leads_from_a_scene_with_cameras_to_the_page(blender):
    seen = blender.walk("found_by_f3", seconds=LONG)
    assert "<!doctype html>" in seen["page"].lower(), seen
    assert seen["state"][4:] == [1, ["dataset", "field", "scene", "web"]]


def test_dropped_files_lead_to_the_page(blender, photos, trained):
    baked = OUT / "dropped scene"
    write_scene(make_snerg((34, 30, 40), diffuse=True), baked)
    seen = blender.walk("dropped", next(photos.glob("transforms*.json")), trained / "field.npz", baked / "scene.json", seconds=LONG)
    assert seen["state"][4:] == [1, ["dataset", "field", "scene"]], seen
    assert "<!doctype html>" in seen["page"].lower(), seen
