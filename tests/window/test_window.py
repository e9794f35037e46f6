"""Blender's window by clicks and keys: what the panels say afterwards. The walks are in walks.py; pictures: build/window."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image

STATUS_ROWS, STATUS_COLUMNS = 18, 200  # pixels of the status bar's left part, where it tells what runs
FIELD = r"\b40 steps"  # of the field `trained`, where a panel shows it


def says(texts: list[str], pattern: str) -> bool:
    """One of a panel's texts has the pattern in it."""
    return any(re.search(pattern, text) for text in texts)


def test_the_sidebar_has_its_tab_and_buttons(blender):
    seen = blender.walk("sidebar")
    assert seen["closed"] <= 1 < seen["open"]
    assert seen["box"], "A click on Add Box added none"


@pytest.fixture(scope="module")
def training(blender, photos):
    """Where the pictures are, and what the walk `training` saw."""
    seen = blender.walk("training", photos)
    assert seen["started"] and seen["advanced"], f"A click on Train Field started nothing: {seen}"
    return seen


def test_esc_while_the_timeline_plays_stops_the_timeline_alone(training):
    assert training["plays"], "Space did not play the timeline"
    assert training["busy_after_esc"], "Esc over the 3D view stopped the training"
    assert training["ends"], "Esc did not stop the timeline"


def test_a_job_is_stopped_by_its_button_and_leaves_the_status_bar(training, blender):
    assert training["PAGE_DOWN"] and training["PAGE_UP"] and training["stopped"]
    before, after = (picture(blender.folder("training") / f"{name}.png") for name in ("before", "after"))
    assert before.std() > 0, "The pictures show nothing: install ImageMagick where Blender runs"
    change = np.abs(before - after)[-STATUS_ROWS:, :STATUS_COLUMNS]
    assert change.mean() < 1, "The status bar still tells of the job that ended; compare before.png and after.png"


def test_the_panel_tells_of_the_end_before_the_next_event(training, blender):
    untouched, touched = (picture(blender.folder("training") / f"{name}.png") for name in ("untouched", "touched"))
    change = np.abs(untouched - touched).mean()
    assert change < 0.2, f"The window was drawn again only when the pointer moved ({change:.2f}); compare untouched.png and touched.png"


def picture(path):
    """[H, W] grey levels of a picture of the window."""
    with Image.open(path) as opened:
        return np.asarray(opened.convert("L"), np.float32)


def test_a_box_deleted_with_x_is_none(blender):
    seen = blender.walk("box_deleted")
    assert says(seen["box_before"], " x ") and not says(seen["dataset_before"], "needs a box") and seen["deleted"]
    assert not says(seen["box"], " x "), f"The panel still shows the deleted box: {seen['box']}"
    assert says(seen["dataset"], "needs a box"), "The rig still goes round the deleted box"


def test_what_an_unsaved_file_made_moves_along_when_it_is_saved(blender):
    seen = blender.walk("unsaved")
    assert seen["started"] and seen["ended"] and says(seen["main_before"], "Next: train"), seen
    assert says(seen["main"], "Next: train"), f"After saving, the dataset rendered before is lost: {seen['main']}"
    assert seen["views"] == 4, f"{seen['views']} of 4 rendered views lie beside the saved file"


def test_nothing_shows_another_files_or_scenes_results(blender, trained):
    seen = blender.walk("second_file", trained)
    assert says(seen["first"], FIELD) and seen["again"] == seen["first"]
    assert not says(seen["scene"], FIELD), f"A new scene shows the first one's field: {seen['scene']}"
    assert not says(seen["second"], FIELD), f"A new file beside the first shows that one's field: {seen['second']}"


def test_the_search_finds_the_operators(blender):
    assert blender.walk("search")["box"], "F3, 'snerg add box', Enter added no box; see search.png"


def test_import_dataset_proposes_no_name_and_keeps_a_relative_path(blender, photos):
    seen = blender.walk("import_dialog", photos)
    assert seen["proposed"] == "", f"The file browser proposes {seen['proposed']!r}"
    assert seen["shows"] == [True, True, "*.json;poses_bounds.npy;*.xml;*.csv;*.out"], (
        "The file browser does not filter by what can be chosen"
    )
    assert seen["dataset"].startswith("//") and says(seen["main"], "Next: train"), seen
    assert says(seen["wrong"], "nowhere"), f"No panel says what is wrong with the folder //nowhere: {seen['wrong']}"


def test_the_window_answers_while_a_dataset_is_rendered(blender):
    seen = blender.walk("rendering")
    bound = max(1.5, seen["seconds_a_view"] / 4)  # a window that renders would not answer for a whole view; a busy machine slows both
    assert seen["longest_pause"] < bound, f"The window did not answer for {seen['longest_pause']:.1f} s"
    assert seen["started"] and seen["ended"] and says(seen["main"], "Next: train"), seen


def test_a_training_goes_on_when_blender_quits(blender, photos):
    steps = 200
    left = blender.walk("leave", photos, steps)
    assert left["started"]
    back = blender.walk_on("come_back", blender.folder("leave"))
    assert says(back["field"], rf"\b{steps} steps"), f"The training did not reach its {steps} steps: {back['field']}"


def test_a_bake_goes_on_when_blender_quits_and_is_shown_afterwards(blender, trained):
    left = blender.walk("leave_in_mid_bake", trained, 256)
    assert left["started"] and left["busy"], "The bake ended before Blender quit; choose a finer one"
    back = blender.walk_on("come_back", blender.folder("leave_in_mid_bake"))
    assert says(back["bake"], r"\d+ blocks"), f"The bake is not there: {back['bake']}"
    assert back["objects"], "No object shows the bake"


def test_undo_and_redo_over_a_bake(blender, trained):
    seen = blender.walk("undo_a_bake", trained)
    assert seen["started"] and seen["steps"] == [[1, 1, 1], [1, 1, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]]
    assert seen["mode"] == "EDIT" and seen["waits"] and seen["in_edit_mode"] == ["001"], "A bake that ends in Edit Mode waits"
    assert (seen["left_edit_mode"], seen["undone"], seen["redone"]) == (["002"], ["001"], ["002"])
    assert "Hide Originals in its Object tab hides that" in " ".join(seen["main"])


def test_a_flat_box_starts_no_bake(blender, trained):
    seen = blender.walk("flat_box", trained)
    assert says(seen["box"], "x 0 m") and not seen["busy"] and says(seen["main"], "Next: bake"), f"See after.png: {seen}"


def test_a_project_folder_that_cannot_be_written_starts_no_training(blender, photos):
    seen = blender.walk("unwritable", photos, "/proc/nowhere")
    assert not seen["busy"] and says(seen["main"], "Next: train"), f"See after.png: {seen}"
