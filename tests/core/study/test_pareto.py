"""Which rows are worth having, and which one a target calls for."""

import pytest

from snerg.core.study.pareto import StudyTarget, choose, pareto_front


def row(key, psnr, ms, megabytes):
    return {"key": key, "psnr": psnr, "ms": ms, "megabytes": megabytes}


ROWS = [row("coarse", 25, 10, 1), row("fine", 31, 40, 20), row("small", 30.5, 41, 5), row("beaten", 29, 50, 21), row("same", 31, 40, 20)]


def keys(rows):
    return [one["key"] for one in rows]


def test_a_row_is_on_the_front_unless_another_is_as_good_in_everything_and_better_in_one_thing():
    assert keys(pareto_front(ROWS, "ms", "megabytes")) == ["coarse", "fine", "same", "small"]
    assert keys(pareto_front(ROWS, "ms")) == ["coarse", "fine", "same"]
    marked = pareto_front(ROWS, "megabytes")
    assert keys(marked) == ["coarse", "small", "fine", "same"]
    assert [one["psnr"] for one in marked] == sorted(one["psnr"] for one in marked)


@pytest.mark.parametrize(
    ("target", "taken"),
    [
        (StudyTarget(db=30), "small"),  # as quick as 'fine' within a twentieth, and smaller
        (StudyTarget(db=30.8), "fine"),
        (StudyTarget(db=20), "coarse"),
        (StudyTarget(mb=6), "small"),  # the best that fits
        (StudyTarget(ms=15), "coarse"),
        (StudyTarget(mb=20, ms=40), "fine"),
    ],
)
def test_the_cheapest_row_that_has_the_target_is_taken(target, taken):
    chosen, closest = choose(ROWS, target)
    assert chosen["key"] == taken and closest is None and target.misses(chosen) == 0


def test_where_none_has_it_the_closest_is_told():
    chosen, closest = choose(ROWS, StudyTarget(db=31.5, ms=39))
    assert chosen is None and closest["key"] == "fine"
    assert choose([], StudyTarget(db=1)) == (None, None)
    assert StudyTarget(db=31.5, mb=2.5).text() == "at least 31.5 dB, at most 2.5 MB" and not StudyTarget()
