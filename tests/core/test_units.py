"""Times and numbers of things as a person reads them."""

from __future__ import annotations

import pytest

from rig.core.units import counted, time_span


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [
        (0.0, "0.0 s"),
        (4.63, "4.6 s"),
        (9.96, "10 s"),
        (59.7, "1 min"),
        (160.2, "2 min 40 s"),
        (3599.6, "1 h"),
        (25_500.0, "7 h 5 min"),
        (86_400.0, "24 h"),
    ],
)
def test_a_time_span_has_two_units_at_most(seconds: float, shown: str) -> None:
    assert time_span(seconds) == shown


def test_one_thing_is_singular() -> None:
    assert [counted(number, "run") for number in (0, 1, 2)] == ["0 runs", "1 run", "2 runs"]
