"""What the stated errors of a slip trial's friction coefficients cover."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.slip_trial.reading import SlipTrialRecord, _friction, zero_errors_N
from procedures.slip_trial.settings import SlipTrialSettings
from rig.files.runfile.reader import RunFile

KINETIC, NOISE_N, SPEED_mm_s = 0.65, 3e-3, 0.5
TARE_FRAMES = 200
"""Frames of the mean that is taken as the zero, at 1000 a second."""


def trial(normal_N: float, zero_shift_N: tuple[float, float, float]) -> SlipTrialRecord:
    """A trial whose motion begins at 0 s and whose zero was found shifted after the lift."""
    record = SlipTrialRecord(1, 100.0, 1000.0, normal_N, zero_shift_N=zero_shift_N)
    times_s = np.arange(0.0, 1.61, 0.01)
    start_mm = SlipTrialSettings().start_mm
    record.position = [(t, 0.0, start_mm + SPEED_mm_s * t, 0.0, 0.0) for t in times_s]
    record.ages_s = [(0.0, 0.0)] * times_s.size
    return record


def bench(said: list[str]) -> Any:
    """A run with the default settings and a force sensor of 3 mN noise."""
    return SimpleNamespace(
        settings=SlipTrialSettings(),
        force=SimpleNamespace(noise_N=np.full(3, NOISE_N)),
        event=lambda kind, topic, text: said.append(f"{kind} {topic}: {text}"),
    )


def coefficients(normal_N: float, off_N: tuple[float, float]) -> dict[str, Any]:
    """What a trial states at a true kinetic coefficient of 0.65 whose zeros of F_n and F_t are off
    by so much in the whole slide, as is seen after the lift."""
    rng = np.random.default_rng(1)
    t = np.arange(1600) / 1000
    travel_mm = SPEED_mm_s * t
    ratio = KINETIC * np.minimum(travel_mm / 0.15, 1) + 0.06 * np.exp(
        -(((travel_mm - 0.16) / 0.02) ** 2)
    )
    force_N = np.zeros((t.size, 3))
    force_N[:, 0] = normal_N + off_N[0] + NOISE_N * rng.standard_normal(t.size)
    force_N[:, 1] = ratio * normal_N + off_N[1] + NOISE_N * rng.standard_normal(t.size)
    said: list[str] = []
    record = trial(normal_N, (off_N[1], 0.0, off_N[0]))
    found = _friction(bench(said), record, t, force_N)
    assert said == []
    return found


@pytest.mark.parametrize(
    ("normal_N", "off_N"),
    [(0.5, (0.0, 0.09)), (0.5, (-0.05, 0.0)), (4.0, (0.0, 0.11)), (4.0, (0.11, -0.11))],
)
def test_the_errors_cover_a_shift_of_the_zero_that_the_trial_has_measured(normal_N, off_N) -> None:
    """They were a hundredth of what the shift had changed the coefficients by."""
    found = coefficients(normal_N, off_N)
    away = abs(found["kinetic_friction"] - KINETIC)
    assert away > 0.02
    assert away < 1.96 * found["kinetic_friction_error"]
    shown = np.hypot(off_N[1], found["static_friction"] * off_N[0]) / normal_N
    assert found["static_friction_error"] > 0.8 * shown


def test_without_a_shift_the_errors_are_those_of_the_noise_and_of_the_tare() -> None:
    found = coefficients(4.0, (0.0, 0.0))
    of_tare = np.hypot(1, KINETIC) * NOISE_N / TARE_FRAMES**0.5 / 4.0
    assert of_tare < found["kinetic_friction_error"] < 1.5 * of_tare


def test_the_shift_along_z_is_that_of_the_normal_force_and_along_x_of_the_tangential() -> None:
    of_tare = NOISE_N / TARE_FRAMES**0.5
    found = zero_errors_N(bench([]), trial(4.0, (-0.03, 0.5, 0.04)))
    assert found == pytest.approx((np.hypot(0.04, of_tare), np.hypot(0.03, of_tare)))


@pytest.mark.thorough
def test_the_error_of_a_trial_covers_the_drift_of_its_zero(rig: Any) -> None:
    """The zero along x moves by 15 mN/s while 1 N is held; the trial is valid."""
    plan = rig.fault(
        '[[fault]]\ndevice = "force_sensor"\nkind = "drift"\naxis = "x"\nrate_N_s = 0.015\n'
        'move = 4\nof = "stage_z"\nafter_s = 2.5\n'
    )
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--fault", plan, "--normal-force", "1N",
        "--force-error-peak", "100", "--force-error-rms", "100", "--overshoot", "100",
        "--world", rig.world("contact.friction = { static_coefficient = 0.8, "
                             f"kinetic_coefficient = {KINETIC} }}\n"),
    )  # fmt: skip
    assert done.code == 0, done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    away, error = abs(reading["kinetic_friction"] - KINETIC), reading["kinetic_friction_error"]
    assert away > 0.005, "the drift shows"
    assert away < 1.96 * error
    assert error < 0.1, "no more than the bound of the shift in a valid trial"
