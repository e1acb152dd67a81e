"""Volts of a strip as N/s: a load that is known comes back through b, with b's error."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from rig.analysis.trial.load_rate import load_scale, load_scale_of_record
from rig.core.errors import ConfigurationError
from rig.instruments.calibration import FilmCalibration
from rig.physics.pvdf import corner_frequency, level_at_one_hertz
from rig.physics.transducer import TransducerChain, TransducerSettings

DATE = datetime(2026, 11, 21, tzinfo=UTC)
STEP_s = 1e-4


def volts_of(force_N: np.ndarray) -> np.ndarray:
    """What the model's strip says of a load on it; its stress is the load by its area."""
    settings = TransducerSettings()
    chain = TransducerChain(settings, STEP_s, channels=1)
    return chain.advance(force_N[:, None] / settings.area_mm2)[:, 0]


def record(**changes: Any) -> FilmCalibration:
    interval = {"low": None, "high": None}
    return FilmCalibration.model_validate(
        {
            "sensor": "S1",
            "date": DATE,
            "valid_until": DATE + timedelta(days=90),
            "simulated": True,
            "source": {"run_uuid": "", "file": "", "simulated": True},
            "b_dB": {"value": -30.0, "standard_error": 0.03, "unit": "dB re 1 V/N", **interval},
            "corner_Hz": {"value": 2000.0, "standard_error": 10.0, "unit": "Hz", **interval},
            "delay_us": {"value": 0.0, "standard_error": 1.0, "unit": "us", **interval},
            "inverse_corner_s": 1 / 2000.0,
            "polarity": 1,
            "covariance": np.diag([0.03**2, 1e-12, 1e-12]).tolist(),
            "gain_model_error_dB": 0.04,
            "points": 100,
            "lowest_frequency_Hz": 2.0,
            "highest_frequency_Hz": 20e3,
            "amplifier_gain": 1.0,
            **changes,
        }
    )


def test_a_known_rate_comes_back() -> None:
    """A load that rises by 3 N/s and then along a sine of 30 Hz; the model's own level."""
    time = STEP_s * np.arange(5000)
    force = 3.0 * time + 0.02 * np.sin(2 * np.pi * 30 * time)
    truth = 3.0 + 0.02 * 2 * np.pi * 30 * np.cos(2 * np.pi * 30 * time)
    circuit = TransducerSettings().circuit
    scale = load_scale(level_at_one_hertz(circuit), 0.05, corner_Hz=corner_frequency(circuit))
    found = scale.rate_N_s(volts_of(force))
    # what is left is the circuit's and the step's delay of 75 µs on a slope of 710 N/s²
    np.testing.assert_allclose(found[50:], truth[50:], atol=0.07)
    assert found[50:].mean() == pytest.approx(truth[50:].mean(), rel=1e-3)
    assert scale.flat_to_Hz > 400.0


def test_the_error_of_b_is_that_of_every_rate() -> None:
    """0.0868 dB are 1 %."""
    scale = load_scale(-30.0, 0.0868)
    found = scale.rate_N_s([0.01, -0.02])
    assert found == pytest.approx(np.array([0.01, -0.02]) * 2 * math.pi * 10**1.5)
    assert scale.error_N_s(-5.0) == pytest.approx(0.05, rel=1e-3)
    assert scale.N_s_per_V.standard_error / scale.N_s_per_V.value == pytest.approx(0.01, rel=1e-3)
    assert scale.N_s_per_V.covers(2 * math.pi * 10 ** (30.15 / 20))
    assert not scale.N_s_per_V.covers(2 * math.pi * 10 ** (30.2 / 20))


def test_the_zero_is_taken_off_and_the_polarity_turns_the_sign() -> None:
    plus, minus = load_scale(-30.0, 0.1), load_scale(-30.0, 0.1, polarity=-1)
    rates = plus.rate_N_s([0.3, 0.4], zero_V=0.3)
    assert rates[0] == 0.0
    assert minus.rate_N_s([0.3, 0.4], zero_V=0.3) == pytest.approx(-rates)
    factor = minus.N_s_per_V
    assert factor.low < factor.value < factor.high < 0
    assert minus.error_N_s(2.0) == plus.error_N_s(2.0)


def test_the_stated_band_is_where_the_pole_takes_one_percent() -> None:
    scale = load_scale(-30.0, 0.1, corner_Hz=2000.0)
    assert 1 / math.hypot(1, scale.flat_to_Hz / 2000.0) == pytest.approx(0.99)


def test_a_record_is_scaled_to_the_amplifier_of_the_volts() -> None:
    scale = load_scale_of_record(record(), amplifier_gain=1000.0)
    assert scale.N_s_per_V.value == pytest.approx(2 * math.pi * 10 ** (30 / 20) / 1000)
    # 0.03 dB of b and 0.04 dB of the model are 0.05 dB
    assert scale.error_N_s(1.0) == pytest.approx(0.05 * math.log(10) / 20, rel=1e-6)
    assert scale.flat_to_Hz == pytest.approx(2000 * math.sqrt(0.99**-2 - 1))
    same = load_scale_of_record(record())
    assert same.N_s_per_V.value == pytest.approx(1000 * scale.N_s_per_V.value)
    turned = load_scale_of_record(record(polarity=-1, inverse_corner_s=0.0))
    assert turned.N_s_per_V.value == -same.N_s_per_V.value
    assert turned.flat_to_Hz == math.inf


def test_a_record_without_its_gain_is_not_scaled() -> None:
    with pytest.raises(ConfigurationError, match="does not say its amplifier's gain"):
        load_scale_of_record(record(amplifier_gain=None), amplifier_gain=1000.0)


@pytest.mark.parametrize(("b_dB", "error"), [(math.nan, 0.1), (-30.0, -0.1)])
def test_a_level_that_is_no_number_is_refused(b_dB: float, error: float) -> None:
    with pytest.raises(ValueError, match="must be numbers"):
        load_scale(b_dB, error)
