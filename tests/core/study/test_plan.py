"""What a study tries, and in which order."""

from dataclasses import replace

import pytest

from snerg.core.baking.bake import BakeSettings
from snerg.core.export.codecs import CodecSettings
from snerg.core.rendering.render import MarchSettings
from snerg.core.study.plan import RESOLUTION, STAGES, WATERFALL, Configuration, Part, plan_steps

BASELINE = Configuration(BakeSettings(resolution=64))
ALL = ["webp", "jpeg", "avif", "h264"]


def test_coarse_comes_first_and_each_configuration_once():
    plan = plan_steps(BASELINE, True, True, True, ALL)
    assert [step.config.bake.resolution for step in plan[:5]] == [16, 24, 32, 48, 64] and plan[4].config == BASELINE
    assert len({step.config.key for step in plan}) == len(plan)
    stages = {value: step.config for step in plan for parameter, value in step.parameters if parameter == WATERFALL}
    assert tuple(stages) and set(stages) == set(STAGES)
    assert not stages["grid"].bake.visibility and not stages["grid"].bake.quantise and stages["refining"] == BASELINE
    assert stages["web page"].page and not stages["codec"].codec.lossless


def test_every_parameter_changes_alone_from_the_baseline():
    """But the paths of coarse resolutions that are stored or marched otherwise, whose name says so."""
    plan = plan_steps(BASELINE, True, True, True, ALL, ["10 s of training"])
    parameters = {parameter for step in plan for parameter, _ in step.parameters}
    for parameter in parameters - {WATERFALL}:
        path = [step.config for step in plan if parameter in dict(step.parameters)]
        if not parameter.startswith(RESOLUTION + ","):
            changed = [{n for n in vars(c) if getattr(c, n) != getattr(BASELINE, n)} for c in path]
            turned = set().union(*changed)
            assert len(turned) == 1 or parameter == "network", (parameter, turned)
            assert BASELINE in path or parameter == "training", parameter


def test_what_a_scene_lacks_is_not_tried():
    plan = plan_steps(BASELINE, False, False, False, [])
    assert not any(step.config.refine or step.config.march.per_sample_network or not step.config.bake.network for step in plan)
    assert not any(parameter == "visibility threshold" for step in plan for parameter, _ in step.parameters)


@pytest.mark.parametrize(
    "other",
    [
        replace(BASELINE, bake=BakeSettings(resolution=65)),
        replace(BASELINE, refine=False),
        replace(BASELINE, codec=CodecSettings("jpeg", 70)),
        replace(BASELINE, march=MarchSettings(tolerance=0.01)),
        replace(BASELINE, field="10 s of training"),
        replace(BASELINE, page=True),
        replace(BASELINE, fit=True),
        replace(BASELINE, prune=0.01),
    ],
)
def test_a_key_stands_for_one_configuration(other):
    assert other.key != BASELINE.key and Configuration.from_json(other.to_json()) == other
    assert (other.baked == BASELINE.baked) is (other.bake == BASELINE.bake and other.field == BASELINE.field)
    assert replace(BASELINE, march=MarchSettings(batch=1024)).key == BASELINE.key  # which changes no result


@pytest.mark.parametrize("count", [1, 2, 8, 100])
def test_parts_are_the_whole_and_share_no_bake(count):
    plan = plan_steps(BASELINE, True, True, True, ALL)
    shares = [Part(number, count).share(plan) for number in range(1, count + 1)]
    assert sorted(step.config.key for share in shares for step in share) == sorted(step.config.key for step in plan)
    bakes = [{step.config.baked for step in share} for share in shares]
    assert sum(map(len, bakes)) == len(set().union(*bakes)), "a bake is made in one part"
    assert all([step for step in plan if step in share] == share for share in shares), "in the order of the plan"
    largest = max(sum(step.config.baked == baked for step in plan) for baked in set().union(*bakes))
    loads = [len(share) + len(made) for share, made in zip(shares, bakes, strict=True)]
    assert max(loads) - min(loads) <= largest + 1


@pytest.mark.parametrize("text", ["0/8", "9/8", "1", "1/2/3", "a/b", "-1/2", ""])
def test_what_is_no_part_is_refused(text):
    with pytest.raises(ValueError):
        Part.read(text)
