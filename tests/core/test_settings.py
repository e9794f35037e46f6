"""Every settings class of core refuses what it cannot use, with a sentence."""

import dataclasses
import importlib
import math
import pkgutil

import numpy as np
import pytest

import snerg.core
from snerg.core.errors import SnergError
from snerg.core.geometry.camera import Camera

NUMBERS = {"int", "float", "float | None", "int | None"}


def settings_classes() -> list[type]:
    """All dataclasses of core that are called settings or options and can be made without arguments."""
    found = {}
    for module in pkgutil.walk_packages(snerg.core.__path__, "snerg.core."):
        if module.name.endswith(("__main__", ".start")):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if (
                isinstance(value, type)
                and dataclasses.is_dataclass(value)
                and value.__name__.endswith(("Settings", "Options", "Finishing"))
            ):
                found[value.__name__] = value
    return [found[name] for name in sorted(found)]


CLASSES = settings_classes()


def test_the_settings_of_every_stage_are_found():
    names = {one.__name__ for one in CLASSES}
    assert names >= {"MarchSettings", "BakeSettings", "TrainSettings", "RefineSettings", "FitSettings", "StudySettings", "RigSettings"}


@pytest.mark.hard_case(68)
@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_no_setting_takes_nan_or_numbers_below_all_others(kind):
    for field in dataclasses.fields(kind):
        if str(field.type) not in NUMBERS:
            continue
        for wrong in (math.nan, -math.inf, -1, *((2.5,) if str(field.type).startswith("int") else ())):
            with pytest.raises(SnergError, match=r"^[A-Z\d-].* .*\.$"):
                kind(**{field.name: wrong})


@pytest.mark.hard_case(68)
@pytest.mark.parametrize(
    "wrong",
    [
        {"batch": 0},
        {"threads": 0},
        {"threads": 1.5},
        {"tolerance": math.nan},
        {"tolerance": -1e-4},
        {"stop_transmittance": math.nan},
        {"stop_transmittance": 2.0},
        {"skip": "no"},
    ],
)
def test_a_march_that_cannot_be(wrong):
    from snerg.core.rendering.render import MarchSettings

    with pytest.raises(SnergError, match="choose"):
        MarchSettings(**wrong)


@pytest.mark.hard_case(68)
@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"width": math.nan},
        {"height": 8.5},
        {"near": math.nan},
        {"near": -1.0},
        {"near": math.inf},
        {"far": math.nan},
        {"far": 0.0},
        {"focal": (math.nan, 1.0)},
        {"centre": (math.inf, 1.0)},
        {"widest": math.nan},
        {"camera_to_world": np.full((4, 4), np.nan)},
    ],
)
def test_a_camera_that_cannot_be(wrong):
    with pytest.raises(SnergError, match=r"must|finite"):
        Camera(**{"width": 8, "height": 8, "focal": (8.0, 8.0), "centre": (4.0, 4.0), "camera_to_world": np.eye(4)} | wrong)
