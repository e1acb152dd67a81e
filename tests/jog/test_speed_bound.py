"""How fast z is jogged: no faster than what it stops from within the force sensor's limit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rig.core.errors import LimitError
from rig.core.settings import Settings
from rig.instruments.roles import Limits
from rig.jog.axes import JogSettings, axes_of

LIMIT_N = 40.0


class Stage(Settings):
    """Settings of a stage that brakes by this."""

    deceleration_mm_s2: float = 200.0


def bench(stiffest_N_mm: float, update_Hz: float = 1000.0) -> Any:
    """A bench with z and a force sensor, on a fixture with this stiffest contact."""
    stage = SimpleNamespace(
        limits=lambda: {
            "position": Limits(0.0, 14.0, "mm", "stage_z"),
            "speed": Limits(0.001, 50.0, "mm/s", "stage_z"),
            "update_rate": Limits(0.0, update_Hz, "Hz", "stage_z"),
        }
    )
    sensor = SimpleNamespace(limits=lambda: {"force": Limits(0.0, LIMIT_N, "N", "force_sensor")})
    return SimpleNamespace(
        instruments={"stage_z": stage, "force_sensor": sensor},
        stage_z=stage,
        force_sensor=sensor,
        plan=SimpleNamespace(instruments=(SimpleNamespace(role="stage_z", settings=Stage()),)),
        settings=SimpleNamespace(fixture=SimpleNamespace(stiffest_N_mm=stiffest_N_mm)),
    )


@pytest.mark.parametrize(("stiffest_N_mm", "update_Hz"), [(4000.0, 1000.0), (2000.0, 50.0)])
def test_z_is_jogged_no_faster_than_it_brakes_within_the_limit(
    stiffest_N_mm: float, update_Hz: float
) -> None:
    (z,), limited = axes_of(bench(stiffest_N_mm, update_Hz), JogSettings(largest_force_N=5.0))
    reaction_s = 0.02 + 1 / update_Hz
    pressed_N = (z.speed * reaction_s + z.speed**2 / 400.0) * stiffest_N_mm
    assert pressed_N == pytest.approx(LIMIT_N - 5.0)
    assert z.speed < 1.0
    assert limited[0].startswith(f"--speed 1 mm/s reduced to {z.speed:.3g} mm/s (")
    assert f"stiffest contact {stiffest_N_mm:g} N/mm" in limited[0]
    assert z.step <= 0.15 * z.speed


def test_a_largest_force_that_leaves_no_way_to_brake_is_refused_with_the_bound() -> None:
    with pytest.raises(LimitError, match="from which it stops within 0 N") as caught:
        axes_of(bench(1000.0), JogSettings(largest_force_N=LIMIT_N))
    assert "a smaller force" in str(caught.value.hint)


def test_a_soft_contact_leaves_jogging_as_it_was() -> None:
    (z,), limited = axes_of(bench(250.0), JogSettings())
    assert (z.speed, limited) == (1.0, [])
