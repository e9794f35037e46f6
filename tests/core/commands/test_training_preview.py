"""Previews of a training: they grow, change nothing in the field, cost what they may, and are gone afterwards."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("jax")

from scenes import make_frame
from snerg.core.commands import training_preview
from snerg.core.commands.train import train_field
from snerg.core.commands.training_preview import TrainingPreview
from snerg.core.errors import Cancelled
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.nerf.checkpoint import read_field
from snerg.core.nerf.field import Field
from snerg.core.nerf.model import HashModelConfig, init_field
from snerg.core.nerf.sampling import Domain
from snerg.core.progress import Note, silent
from snerg.core.training import saving
from snerg.core.training import trainer as train_module
from snerg.core.training.saving import PREVIEW_EVERY, PREVIEW_SHARE, Saver, TrainProgress


@pytest.fixture
def often(monkeypatch):
    """A preview after every step, small enough for a test."""
    monkeypatch.setattr(train_module, "TELL_EVERY", -1.0)
    monkeypatch.setattr(saving, "PREVIEW_EVERY", 0.0)
    monkeypatch.setattr(saving, "PREVIEW_SHARE", math.inf)
    monkeypatch.setattr(training_preview, "SETTINGS", replace(training_preview.SETTINGS, resolution=32))


class Look:
    """Progress that reads the preview in `folder` each time it changed; it cancels the training once there were `last`."""

    def __init__(self, folder, last=None):
        self.folder, self.last, self.seen, self.notes = folder / "preview", last, [], []

    def __call__(self, fraction, text):
        if isinstance(text, Note) and "preview" in text:
            self.notes.append(text)
        if (self.folder / "scene.json").is_file():
            scene = read_scene(self.folder)
            if not self.seen or not np.array_equal(scene.cells, self.seen[-1].cells):
                self.seen.append(scene)
        if self.last is not None and len(self.seen) >= self.last:
            raise Cancelled("Stopped by the test.")


@pytest.mark.slow  # it compiles a training twice
def test_a_preview_grows_and_is_gone_when_the_training_stops_or_ends(tmp_path, dataset, often):
    look, out, values = Look(tmp_path / "field", last=2), tmp_path / "field", {"view_dependence": "diffuse", "warm_up": "0"}
    with pytest.raises(Cancelled):
        train_field(dataset, out, steps=9, values=values, progress=look, preview=True)
    assert len(look.seen) == 2 and max(look.seen[0].shape) < 40 and not look.notes
    assert np.allclose(look.seen[0].box.box_to_world[:3, 3], read_field(out).domain.world_box().box_to_world[:3, 3], atol=0.1)
    assert not (out / "preview").exists()
    write_scene(look.seen[0], out / "preview")  # as a killed training leaves it
    result = train_field(dataset, out, steps=9, values=values)
    assert result["resumed"] and result["steps"] == 9 and not (out / "preview").exists()


@pytest.fixture
def field():
    """One that was not trained."""
    family = HashModelConfig()
    params = init_field(family, "diffuse", np.random.default_rng(0))["field"]
    return Field(family, params, None, Domain.around(np.full(3, -1.0), np.full(3, 1.0)), None, 0.01, view="diffuse")


def test_a_field_that_cannot_be_baked_ends_the_previews_and_not_the_training(tmp_path, field):
    notes = []
    preview = TrainingPreview(tmp_path / "preview", lambda fraction, text: notes.append((fraction, text)))
    for _ in range(2):
        preview(replace(field, view="tiny"), 0.3)
    [(fraction, note)] = notes
    assert fraction == 0.3 and isinstance(note, Note) and note.startswith("No preview while training: The field's view dependence")


def test_a_forward_facing_scene_has_no_preview_and_says_so(tmp_path, field):
    notes = []
    TrainingPreview(tmp_path / "preview", lambda fraction, text: notes.append(text))(replace(field, ndc=make_frame()), 0.3)
    assert len(notes) == 1 and "forward-facing" in notes[0] and not (tmp_path / "preview").exists()


def test_a_folder_of_the_artists_is_left_alone(tmp_path, field, often):
    notes, folder = [], tmp_path / "preview"
    folder.mkdir()
    (folder / "holiday.jpg").write_bytes(b"mine")
    TrainingPreview(folder, lambda fraction, text: notes.append(text))(field, 0.3)
    assert "holds other files" in notes[-1] and [path.name for path in folder.iterdir()] == ["holiday.jpg"]
    with training_preview.training_preview(tmp_path, True, silent):
        pass
    assert (folder / "holiday.jpg").is_file()


def test_a_slow_bake_is_given_up_and_tried_coarser(tmp_path, field, monkeypatch):
    monkeypatch.setattr(training_preview, "MOST_SECONDS", -1.0)
    notes, texts = [], []
    preview = TrainingPreview(tmp_path / "preview", lambda fraction, text: (notes if isinstance(text, Note) else texts).append(text))
    for _ in range(2):
        preview(field, 0.3)
        assert not notes and not (tmp_path / "preview").exists()
    for _ in range(2):
        preview(field, 0.3)
    assert len(notes) == 1 and "takes longer" in notes[0]


@pytest.mark.parametrize("seconds", [60.0, 300.0, 7200.0])
@pytest.mark.parametrize("cost", [0.5, 2.0, 6.0])
@pytest.mark.parametrize("resumed", [0.0, 0.5])
def test_previews_take_their_share_of_the_time(tmp_path, monkeypatch, seconds, cost, resumed):
    clock = [0.0]
    monkeypatch.setattr(saving.time, "perf_counter", lambda: clock[0])
    at = []

    def preview(field, fraction):
        clock[0] += cost
        at.append(fraction * seconds)

    saver = Saver(tmp_path, lambda: (None, {}), math.inf, preview=preview)
    monkeypatch.setattr(saver, "save", lambda: None)
    start = clock[0] = resumed * seconds
    while clock[0] < seconds:
        clock[0] += 0.2
        saver.after(TrainProgress(min(clock[0] / seconds, 1.0), 1, 0.1, 20.0, clock[0], 1, 1, 0.1))
    assert cost * len(at) <= PREVIEW_SHARE * (seconds - start) + cost + saving.FIRST_PREVIEW
    assert all(later - earlier >= PREVIEW_EVERY for earlier, later in pairwise(at))
    if seconds >= 300 and not resumed and cost <= 2:
        assert at[0] <= 0.1 * seconds and len(at) >= 5
        assert cost * len(at) < 0.05 * seconds
