"""When a weight counts as resting on the contact."""

from __future__ import annotations

import numpy as np
import pytest

from rig.control.weight import RESTING_S, RestingWeight

TICK_S = 0.01


def rested_s(forces_N: list[float], ways_mm: list[float]) -> float:
    """Return for how long a weight of 2 N, 0.5 mm/s at most, has rested at the end."""
    weight = RestingWeight(2.0, 0.5)
    for number, (force_N, way_mm) in enumerate(zip(forces_N, ways_mm, strict=True)):
        weight.add(number * TICK_S, force_N, way_mm)
    return weight.rested_s


def test_one_that_is_carried_at_one_place_rests_from_the_first_tick_on() -> None:
    assert rested_s([2.0] * 101, [0.1] * 101) == pytest.approx(1.0)


def test_nothing_is_known_before_the_time_over_which_it_is_judged() -> None:
    assert rested_s([2.0] * round(RESTING_S / TICK_S), [0.1] * 20) == 0.0


def test_noise_of_the_force_does_not_interrupt_a_rest() -> None:
    noise_N = np.random.default_rng(0).normal(0, 0.1, 101)
    assert rested_s(list(2.0 + noise_N), [0.1] * 101) == pytest.approx(1.0)


@pytest.mark.parametrize("slides_with_N", [1.8, 1.95, 2.0])
def test_one_that_slides_does_not_rest_however_much_friction_carries(slides_with_N: float) -> None:
    ways_mm = [0.5 * TICK_S * number for number in range(101)]
    assert rested_s([slides_with_N] * 101, ways_mm) == 0.0


def test_one_that_the_contact_does_not_carry_does_not_rest_even_where_x_stands() -> None:
    assert rested_s([1.8] * 101, [0.1] * 101) == 0.0


def test_a_rest_begins_anew_after_a_slip() -> None:
    ways_mm = [0.1] * 50 + [0.2] * 51
    assert rested_s([2.0] * 50 + [0.5] * 5 + [2.0] * 46, ways_mm) < 0.5
