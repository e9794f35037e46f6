"""What a study tries, and in which order."""

from dataclasses import replace

import pytest

from snerg.core.baking.bake import BakeSettings
from snerg.core.export.codecs import CodecSettings
from snerg.core.rendering.render import MarchSettings
from snerg.core.study.plan import RESOLUTION, STAGES, WATERFALL, Config, steps

USUAL = Config(BakeSettings(resolution=64))
ALL = ["webp", "jpeg", "avif", "h264"]


def test_coarse_comes_first_and_each_configuration_once():
    plan = steps(USUAL, True, True, True, ALL)
    assert [step.config.bake.resolution for step in plan[:5]] == [16, 24, 32, 48, 64] and plan[4].config == USUAL
    assert len({step.config.key for step in plan}) == len(plan)
    stages = {value: step.config for step in plan for knob, value in step.knobs if knob == WATERFALL}
    assert tuple(stages) and set(stages) == set(STAGES)
    assert not stages["grid"].bake.visibility and not stages["grid"].bake.quantise and stages["refining"] == USUAL
    assert stages["web page"].page and not stages["codec"].codec.lossless


def test_every_knob_turns_alone_through_the_usual_configuration():
    """But the paths of coarse resolutions that are stored or marched otherwise, whose name says so."""
    plan = steps(USUAL, True, True, True, ALL, ["10 s of training"])
    knobs = {knob for step in plan for knob, _ in step.knobs}
    for knob in knobs - {WATERFALL}:
        path = [step.config for step in plan if knob in dict(step.knobs)]
        if not knob.startswith(RESOLUTION + ","):
            changed = [{n for n in vars(c) if getattr(c, n) != getattr(USUAL, n)} for c in path]
            turned = set().union(*changed)
            assert len(turned) == 1 or knob == "network", (knob, turned)
            assert USUAL in path or knob == "training", knob


def test_what_a_scene_lacks_is_not_tried():
    plan = steps(USUAL, False, False, False, [])
    assert not any(step.config.refine or step.config.march.per_sample_network or not step.config.bake.network for step in plan)
    assert not any(knob == "visibility threshold" for step in plan for knob, _ in step.knobs)


@pytest.mark.parametrize(
    "other",
    [
        replace(USUAL, bake=BakeSettings(resolution=65)),
        replace(USUAL, refine=False),
        replace(USUAL, codec=CodecSettings("jpeg", 70)),
        replace(USUAL, march=MarchSettings(tolerance=0.01)),
        replace(USUAL, field="10 s of training"),
        replace(USUAL, page=True),
    ],
)
def test_a_key_stands_for_one_configuration(other):
    assert other.key != USUAL.key and Config.from_json(other.to_json()) == other
    assert (other.baked == USUAL.baked) is (other.bake == USUAL.bake and other.field == USUAL.field)
    assert replace(USUAL, march=MarchSettings(batch=1024)).key == USUAL.key  # which changes no result
