"""Times and sizes in the unit that suits."""

import pytest

from snerg.core.commands.command import table
from snerg.core.units import duration, file_size


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((0, "0 ms"), (0.0004, "0.4 ms"), (0.0996, "0.1 s"), (0.42, "0.4 s"), (9.96, "10 s")),
        *(
            (95, "95 s"),
            (300, "5 min"),
            (99.4, "99 s"),
            (100, "1.7 min"),
            (1.7e3, "28 min"),
            (5940, "99 min"),
            (6000, "1.7 h"),
            (1e6, "278 h"),
        ),
    ],
)
def test_a_time_of_any_length_is_read_at_a_glance(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 kB"), (640, "0.6 kB"), (64e3, "64 kB"), (999.6e3, "1 MB"), (2.43e6, "2.4 MB"), (999e6, "999 MB"), (1.26e9, "1.3 GB")],
)
def test_a_size_of_any_number_of_bytes_is_read_at_a_glance(count, text):
    assert file_size(count) == text


def test_a_terminal_shows_times_and_sizes_in_the_unit_that_suits():
    stages = {"start": 0.5, "prefilter": 200.0}
    shown = table({"bake_seconds": 1.7e3, "seconds": stages, "peak_megabytes": 1260, "views": 100, "psnr": None})
    assert shown.splitlines() == [
        "bake time  28 min",
        "time       start 0.5 s, prefilter 3.3 min",
        "peak size  1.3 GB",
        "views      100",
        "psnr       —",
    ]
    shown = table({"seconds_per_view": 0.0423, "bytes": 2_430_000, "seconds": None})
    assert shown.splitlines() == ["time per view  42 ms", "size           2.4 MB", "time           —"]
