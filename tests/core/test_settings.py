"""Settings: strict values whose names carry their unit, and a hash of them that can be trusted."""

from __future__ import annotations

import math
import subprocess
import sys

import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, ValidationError

from rig.core.settings import (
    UNIT_BY_SUFFIX,
    Settings,
    fingerprint,
    leaves,
    name_without_unit,
    unit_of,
)


class Inner(Settings):
    speed_mm_s: float = Field(default=5.0, gt=0)
    label: str = "a"


class Outer(Settings):
    preload_N: float = 2.0
    count: int = 3
    inner: Inner = Inner()
    times_s: tuple[float, ...] = (1.0, 2.0)


@pytest.mark.parametrize(
    ("name", "unit", "bare"),
    [
        ("normal_force_N", "N", "normal_force"),
        ("speed_mm_s", "mm/s", "speed"),
        ("acceleration_mm_s2", "mm/s^2", "acceleration"),
        ("sensitivity_V_N", "V/N", "sensitivity"),
        ("rate_S_s", "1/s", "rate"),
        ("area_mm2", "mm^2", "area"),
        ("frequencies_Hz", "Hz", "frequencies"),
        ("noise_density_V_sqrtHz", "V/sqrt(Hz)", "noise_density"),
        ("settling_s", "s", "settling"),
        ("samples_per_cycle", None, "samples_per_cycle"),
        ("cycles", None, "cycles"),
        ("names", None, "names"),
        ("film", None, "film"),
    ],
)
def test_a_name_carries_its_unit(name: str, unit: str | None, bare: str) -> None:
    assert unit_of(name) == unit
    assert name_without_unit(name) == bare


@pytest.mark.parametrize("unit", sorted(set(UNIT_BY_SUFFIX.values())))
def test_every_unit_is_one_that_pint_reads(unit: str) -> None:
    assert pint.Quantity(1.0, unit.replace("sqrt(Hz)", "Hz^0.5")).magnitude == 1.0


@pytest.mark.parametrize("suffix", UNIT_BY_SUFFIX)
def test_no_suffix_hides_behind_a_shorter_one(suffix: str) -> None:
    assert unit_of(f"value_{suffix}") == UNIT_BY_SUFFIX[suffix]
    assert name_without_unit(f"value_{suffix}") == "value"


@pytest.mark.parametrize(
    ("values", "reported"),
    [
        ({"colour": "red"}, "colour"),
        ({"inner": {"speed_mm_s": 1, "sped_mm_s": 2}}, "sped_mm_s"),
        ({"preload_N": float("nan")}, "preload_N"),
        ({"preload_N": float("inf")}, "preload_N"),
        ({"times_s": (1.0, float("nan"))}, "times_s"),
        ({"inner": {"speed_mm_s": 0}}, "speed_mm_s"),
    ],
)
def test_what_cannot_be_meant_is_refused(values: dict[str, object], reported: str) -> None:
    with pytest.raises(ValidationError, match=reported):
        Outer.model_validate(values)


def test_settings_cannot_be_changed_afterwards() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Outer().preload_N = 3.0  # type: ignore[misc]


def test_leaves_are_all_plain_values_with_dotted_names_and_units() -> None:
    assert list(leaves(Outer())) == [
        ("preload_N", 2.0, "N"),
        ("count", 3, None),
        ("inner.speed_mm_s", 5.0, "mm/s"),
        ("inner.label", "a", None),
        ("times_s", (1.0, 2.0), "s"),
    ]


def test_a_fingerprint_is_the_same_in_every_process_and_order() -> None:
    program = (
        "from rig.core.settings import fingerprint; "
        "print(fingerprint({'b': [1, 2.5], 'a': None}, 'x'))"
    )
    other = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert fingerprint({"a": None, "b": [1, 2.5]}, "x") == other.stdout.strip()


def test_a_fingerprint_sees_settings_as_their_values() -> None:
    assert fingerprint(Outer()) == fingerprint(Outer.model_validate({"preload_N": 2}))
    assert fingerprint(Outer()) != fingerprint(Outer(preload_N=2.0000000001))
    assert fingerprint("a", "b") != fingerprint("ab")
    assert fingerprint(["a", "b"]) != fingerprint("a", "b")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=5))
def test_a_fingerprint_tells_any_two_numbers_apart(values: list[float]) -> None:
    neighbour = math.nextafter(values[-1], 0.0 if values[-1] else 1.0)
    assert fingerprint(values) == fingerprint(list(values))
    assert fingerprint(values) != fingerprint([*values[:-1], neighbour])


def test_a_fingerprint_of_what_json_cannot_say_is_refused() -> None:
    with pytest.raises(ValueError, match="JSON"):
        fingerprint(float("nan"))
