"""Quantities as a person writes them, times and numbers of things as a person reads them."""

from __future__ import annotations

import pytest

from rig.core.units import counted, is_unit, quantity, time_span


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


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("200ms", "s", 0.2),
        ("1 mm / s", "mm/s", 1.0),
        ("2e3 um/s", "mm/s", 2.0),
        ("3 m/s^2", "mm/s^2", 3000.0),
        ("3 m s**-2", "mm/s^2", 3000.0),
        ("5 µm", "mm", 0.005),
    ],
)
def test_a_quantity_is_read_in_any_unit_that_converts(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit) == pytest.approx(value)


@pytest.mark.parametrize(
    "written",
    [
        "mm**9999999**9999999",
        "mm^99999999",
        "mm/",
        "/mm",
        "mm**",
        "(" * 30,
        "mm;",
        "m" * 5000,
        "s[0]",
    ],
)
def test_what_is_no_unit_is_refused_at_once_with_the_unit_to_write(written: str) -> None:
    with pytest.raises(ValueError, match="is not a unit; write it as mm"):
        quantity(f"1{written}", "mm")
    assert not is_unit(written)


@pytest.mark.parametrize(
    "text", ["V s/N", "mm/s^2", "1/s", "%", "", "dB/decade", "1/Pa", "furlong"]
)
def test_units_of_files_and_figures_are_units(text: str) -> None:
    assert is_unit(text)
