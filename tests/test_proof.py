"""The promises that `make proof` measures on a thousand scenes, here on a few."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "bench"))

from proof import PROMISES, Promise, measure, prove


@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.name)
def test_every_promise_holds_on_a_few_scenes(promise):
    assert measure(promise, -(-4 // promise.share), seed=1) <= promise.claim


def test_a_promise_that_does_not_hold_is_told(capsys):
    """The table's last column, and what the exit status is made of; NaN is no small error."""
    broken = Promise("half", 0.5, "of anything", lambda draw: 0.75), Promise("number", 0.5, "of anything", lambda draw: float("nan"))
    kept = Promise("kept", 0.5, "of anything", lambda draw: float(draw.random()) / 2)
    assert prove([kept], 3, 0) and not prove([broken[0]], 3, 0) and not prove([broken[1]], 3, 0)
    assert capsys.readouterr().out.count("DOES NOT HOLD") == 2
