"""A strip's gain from a touch-down whose share of the force is known."""

from __future__ import annotations

import numpy as np
import pytest

from rig.analysis.trial.touch_down import TouchDownError, TouchRecord
from rig.analysis.trial.touch_gain import touch_gain

STEP_s = 1e-3
FORCE_NOISE_N, VOLT_NOISE_V, MAINS_V = 3e-3, 2e-4, 5e-4
TIME = STEP_s * np.arange(1500)


def pressed() -> tuple[np.ndarray, np.ndarray]:
    """Force and its rate: up to 4 N with a time constant of 60 ms, and a tap of 0.6 N."""
    since = (TIME - 0.4).clip(min=0)
    force = 4.0 * (1 - np.exp(-since / 0.06) * (1 + since / 0.06))
    force -= 0.6 * np.exp(-(((TIME - 0.95) / 0.015) ** 2))
    return force, np.gradient(force, STEP_s)


def seen(
    at_no_force: float, at_full_force: float, offset_s: float, seed: int
) -> tuple[TouchRecord, TouchRecord]:
    """Force and volts as measured, of a share that goes from one value to another."""
    rng = np.random.default_rng([55, seed])
    force, rate = pressed()
    share = at_no_force + (at_full_force - at_no_force) * force / 4.0
    volts = 0.3 + share * rate + MAINS_V * np.sin(2 * np.pi * 50 * TIME + seed)
    return (
        TouchRecord(force + FORCE_NOISE_N * rng.normal(size=force.size), 1000.0, offset_s),
        TouchRecord(volts + VOLT_NOISE_V * rng.normal(size=volts.size), 1000.0),
    )


@pytest.mark.parametrize("offset_s", [0.0, -0.012])
def test_the_gain_is_the_mean_of_the_share_over_the_force(offset_s: float) -> None:
    """Ten cases: the stated 95 % hold in at least eight, and none is off by more than 2 %."""
    covered = 0
    for seed in range(10):
        gain = touch_gain(*seen(2e-4, 4e-4, offset_s, seed), offset_s)
        assert gain.unit == "V s/N"
        assert gain.value == pytest.approx(3e-4, rel=0.02)
        assert gain.standard_error < 3e-6
        covered += gain.covers(3e-4)
    assert covered >= 8


def test_a_strip_that_gives_half_has_a_gain_of_half_and_one_turned_round_another_sign() -> None:
    whole = touch_gain(*seen(3e-4, 3e-4, 0.0, 1), 0.0)
    half = touch_gain(*seen(1.5e-4, 1.5e-4, 0.0, 1), 0.0)
    turned = touch_gain(*seen(-3e-4, -3e-4, 0.0, 1), 0.0)
    assert half.value / whole.value == pytest.approx(0.5, rel=0.01)
    assert turned.value / whole.value == pytest.approx(-1, rel=0.01)


def test_a_strip_that_is_off_its_amplifier_has_a_gain_of_nothing() -> None:
    gain = touch_gain(*seen(0.0, 0.0, 0.0, 2), 0.0)
    assert abs(gain.value) < 3 * gain.standard_error < 1e-5


def test_records_that_do_not_overlap_are_refused() -> None:
    force, volts = seen(3e-4, 3e-4, 0.0, 3)
    with pytest.raises(TouchDownError, match="0 ms in common"):
        touch_gain(force, volts, 10.0)


FINE_s = 1e-4


def as_frames(rate_S_s: float, seed: int) -> tuple[TouchRecord, TouchRecord]:
    """The same touch-down as frames of a slower force sensor, each the mean over its interval, and
    volts at 1 kHz."""
    rng = np.random.default_rng([61, seed])
    time = FINE_s * np.arange(15_000)
    since = (time - 0.4).clip(min=0)
    force = 4.0 * (1 - np.exp(-since / 0.06) * (1 + since / 0.06))
    force -= 0.6 * np.exp(-(((time - 0.95) / 0.015) ** 2))
    share = 2e-4 + 2e-4 * force / 4.0
    volts = (0.3 + share * np.gradient(force, FINE_s) + MAINS_V * np.sin(100 * np.pi * time))[::10]
    total = np.concatenate([[0], np.cumsum((force[1:] + force[:-1]) / 2) * FINE_s])
    ends = np.arange(1 / rate_S_s + 1e-3 * rng.uniform(), time[-1], 1 / rate_S_s)
    frames = (np.interp(ends, time, total) - np.interp(ends - 1 / rate_S_s, time, total)) * rate_S_s
    frames += FORCE_NOISE_N * np.sqrt(rate_S_s / 1000) * rng.normal(size=frames.size)
    return (
        TouchRecord(frames, rate_S_s, float(ends[0]), 0.5 / rate_S_s),
        TouchRecord(volts + VOLT_NOISE_V * rng.normal(size=volts.size), 1000.0),
    )


@pytest.mark.parametrize("rate_S_s", [100.0, 500.0, 1000.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_gain_does_not_depend_on_the_force_sensors_rate(rate_S_s: float, seed: int) -> None:
    gain = touch_gain(*as_frames(rate_S_s, seed), 0.0)
    assert gain.value == pytest.approx(3e-4, rel=0.01)
    assert gain.standard_error < 6e-6
