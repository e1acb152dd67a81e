"""The figures that a sweep is summed up to."""

from __future__ import annotations

import pytest

from procedures.sweep.summary import figures


def reading(frequency_Hz: float) -> dict[str, float]:
    return {
        "frequency_Hz": frequency_Hz,
        "gain_dB": -30.0,
        "gain_standard_error_dB": 0.01,
        "load_amplitude_N": 1.0,
        "load_set_N": 1.0,
        "largest_load_N": 1.0,
    }


@pytest.mark.parametrize(("frequency_Hz", "near"), [(200.0, True), (170.0, True), (300.0, False)])
def test_a_gain_near_200_hz_is_reported_with_its_frequency(frequency_Hz: float, near: bool) -> None:
    found = figures([reading(2000.0), reading(frequency_Hz)])
    assert ("gain_near_200_Hz_dB" in found) is near
    assert found.get("gain_near_200_Hz_at_Hz", frequency_Hz) == frequency_Hz
