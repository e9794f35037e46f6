"""Training settings: the paper's numbers are the paper's, nonsense is refused in a sentence, text comes back as it was."""

from dataclasses import replace

import numpy as np
import pytest

from snerg.core.errors import SnergError
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig
from snerg.core.training.config import FINEST_SPACING, PRESETS, TrainSettings, suited
from snerg.core.training.config_values import setting_names, with_values
from snerg.core.training.losses import backgrounds, over


def test_the_paper_is_the_paper():
    """Sections 4.3 and 6; for the small one JAXNeRF's sizes (supplement C.4)."""
    paper, small = PRESETS["paper"], PRESETS["paper-small"]
    for settings in (paper, small):
        assert settings.sampler == "hierarchical" and settings.view_dependence == "deferred"
        assert (settings.rate, settings.final_rate, settings.warm_up, settings.steps) == (2e-3, 2e-5, 2500, 250_000)
        assert (settings.clip_value, settings.clip_norm, settings.sparsity, settings.rays) == (0.01, 0.01, 1e-4, 8192)
    assert isinstance(paper.family, MlpModelConfig) and (paper.family.width, paper.family.depth, paper.coarse, paper.fine) == (
        512,
        8,
        192,
        384,
    )
    assert isinstance(small.family, MlpModelConfig) and (small.family.width, small.family.depth, small.coarse, small.fine) == (
        256,
        8,
        64,
        128,
    )


def test_values_by_name():
    values = {"family.depth": "3", "family": "mlp", "family.width": " 64 ", "clip_norm": "1e-2", "rays": "1e3", "opaque": "Yes"}
    got = with_values(TrainSettings(), {**values, "sampler": "hierarchical"})
    assert got.family == MlpModelConfig(width=64, depth=3) and got.clip_norm == 0.01 and got.rays == 1000 and got.opaque is True
    assert with_values(got, {"clip_norm": "none", "family": "hash"}) == replace(got, clip_norm=None, family=HashModelConfig())
    assert with_values(TrainSettings(), {"family.grid.levels": "4"}).family.grid.levels == 4
    timed = with_values(PRESETS["paper"], {"seconds": "60"})
    assert timed.steps is None and timed.seconds == 60


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_every_name_that_is_offered_is_taken(preset):
    settings = PRESETS[preset]
    for name in setting_names(settings)[1:]:
        holder = settings
        for part in name.split("."):
            holder = getattr(holder, part)
        if name != "seconds":  # it replaces steps
            assert with_values(settings, {name: str(holder)}) == settings, name


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"famly": "x"}, "did you mean family"),
        ({"family": "cnn"}, "one of hash, mlp"),
        ({"family.grid": "1"}, "no setting 'family.grid'"),
        ({"family.degrees": "3"}, "no setting 'family.degrees'"),
        ({"family.width.real": "3"}, "no setting"),
        ({"from_json": "1"}, "no setting"),
        ({"rate": "fast"}, "must be a number"),
        ({"rate": "nan"}, "must be above 0"),
        ({"rays": "1.5"}, "must be a whole number"),
        ({"rays": "inf"}, "must be a whole number"),
        ({"rays": "-1"}, "rays is -1"),
        ({"opaque": "maybe"}, "must be yes or no"),
        ({"opaque": "yes"}, "sampler=hierarchical"),
        ({"hierarchy": "on"}, "sampler=hierarchical"),
        ({"view_dependence": "some"}, "one of auto, deferred"),
        ({"background": "#12345"}, "white, black, random"),
        ({"distances": "log"}, "linear, disparity"),
        ({"spacing": "0"}, "spacing is 0"),
        ({"clip_value": "0"}, "clip_value is 0"),
        ({"beta_2": "1"}, "beta_2 is 1"),
        ({"family.grid.log2_size": "60"}, "log2_size is 60"),
        ({"family.grid.log2_size": "24", "family.grid.features": "16", "family.grid.levels": "32"}, "GiB"),
        ({"family.grid.finest": "4"}, "finest is 4"),
        ({"family.width": "0"}, "width is 0"),
        ({"seed": "-1"}, "seed is -1"),
    ],
)
def test_nonsense_is_refused_in_a_sentence(values, sentence):
    with pytest.raises(SnergError, match=sentence) as caught:
        with_values(TrainSettings(), values)
    assert "\n" not in str(caught.value)


@pytest.mark.hard_case(28)
@pytest.mark.parametrize(
    "values", [{"rate": "0"}, {"final_rate": "0"}, {"final_rate": "1"}, {"steps": "0"}, {"seconds": "0"}, {"seconds": "none"}]
)
def test_schedules_that_make_no_sense(values):
    with pytest.raises(SnergError):
        with_values(TrainSettings(), values)


def test_what_stands_behind_transparent_pixels():
    draw = np.random.default_rng(0)
    assert (backgrounds("white", 3, draw) == 1).all() and (backgrounds("black", 3, draw) == 0).all()
    assert np.allclose(backgrounds("#ff8000", 2, draw), [[1, 128 / 255, 0]] * 2) and backgrounds("white", 3, draw).dtype == np.float32
    noise = backgrounds("random", 1000, draw)
    assert noise.shape == (1000, 3) and abs(noise.mean() - 0.5) < 0.02 and len(np.unique(noise, axis=0)) == 1000
    colour, alpha = over(np.float32([[0.2, 0.4, 0.6, 0.25]]), np.float32([[1, 0, 0.5]]))
    assert np.allclose(colour, [[0.05 + 0.75, 0.1, 0.15 + 0.375]]) and alpha == 0.25


def test_settings_follow_the_time_and_the_pictures():
    short, long, fine = (replace(TrainSettings(), seconds=60.0 * minutes) for minutes in (5, 10, 30))
    assert suited(short, 2 / 800) == short
    grid = HashGrid(log2_size=HashGrid().log2_size + 1)
    assert suited(long, 2 / 800) == replace(long, family=HashModelConfig(grid))
    assert suited(fine, 2 / 400) == replace(fine, family=HashModelConfig(grid), spacing=2 / 400, hardness=0.0)
    assert suited(fine, 2 / 3000).spacing == FINEST_SPACING, "a step must have enough rays"
    assert suited(fine, 2 / 200).spacing == TrainSettings().spacing, "finer pictures never make the samples coarser"
    steps = replace(TrainSettings(), seconds=None, steps=100_000)
    assert suited(steps) == steps and suited(PRESETS["paper"]) == PRESETS["paper"]
