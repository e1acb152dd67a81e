"""The figures that a sweep is summed up to."""

from __future__ import annotations

import numpy as np
import pytest

from procedures.sweep import Sweep
from procedures.sweep.summary import figures, in_brief
from rig.files.journal.values import Program, Results
from rig.files.runfile.result_fields import result_fields


def reading(frequency_Hz: float) -> dict[str, float]:
    return {
        "frequency_Hz": frequency_Hz,
        "gain_dB": -30.0,
        "gain_standard_error_dB": 0.01,
        "load_amplitude_N": 1.0,
        "load_set_N": 1.0,
        "response_real_V_N": 0.01,
        "response_imag_V_N": 0.0,
        "response_var_real": 1e-10,
        "response_var_imag": 1e-10,
        "response_cov_real_imag": 0.0,
        "degrees": 100.0,
        "largest_load_N": 1.0,
    }


@pytest.mark.parametrize(("frequency_Hz", "near"), [(200.0, True), (170.0, True), (300.0, False)])
def test_a_gain_near_200_hz_is_reported_with_its_frequency(frequency_Hz: float, near: bool) -> None:
    found = figures([reading(2000.0), reading(frequency_Hz)])
    assert ("gain_near_200_Hz_dB" in found) is near
    assert found.get("gain_near_200_Hz_at_Hz", frequency_Hz) == frequency_Hz


def estimate(value: float, unit: str) -> dict[str, object]:
    return {"value": value, "standard_error": 0.01, "low": 0.0, "high": 0.0, "unit": unit}


def test_a_sweep_in_brief_states_bounds_references_and_what_each_number_is() -> None:
    model = {
        "first_order": {"answer": "holds", "reason": "within ±0.05"},
        "bounds": {"slope_dB_decade": 0.05, "gain_dB": 0.1},
        "asymptotic_slope": estimate(20.0, "dB/decade"),
        "level": estimate(-77.19, "dB"),
        "corner": None,
        "drops": [
            {
                "frequency": estimate(408.0, "Hz"),
                "depth": estimate(16.13, "dB"),
                "pole_Q": estimate(5.25, ""),
            }
        ],
        "preload_effect": None,
        "chi_square": 330.0,
        "degrees": 337,
    }
    assert in_brief({"model": model}, {})[:4] == [
        "20 dB/decade (stress rate): holds within ±0.05 dB/decade",
        "slope without the fitted low-pass: 20.000 ± 0.020 dB/decade",
        "level b at 1 Hz: -77.190 ± 0.020 dB re 1 V/N",
        "notch: 408.000 ± 0.020 Hz, 16.13 dB deep, Q 5.25",
    ]
    del model["bounds"]  # as in a file of an older version
    assert in_brief({"model": model}, {})[0] == "20 dB/decade (stress rate): holds"


@pytest.mark.parametrize(
    ("frequencies", "why"),
    [
        ([200.0], "1 frequency, 12 are needed"),
        ([20.0, 40.0, 80.0, 160.0, 400.0, 800.0, 1600.0, 3200.0, 8000.0], "9 frequencies, 12 are"),
        (np.linspace(100.0, 900.0, 12).tolist(), "100 to 900 Hz show no trend: a decade is needed"),
    ],
)
def test_results_without_a_fit_say_why(frequencies: list[float], why: str) -> None:
    readings = [reading(frequency_Hz) for frequency_Hz in frequencies]
    sweep = Sweep(Sweep.Settings())
    found = sweep.summarise(readings)
    assert "model" not in found
    (line,) = (one for one in sweep.in_brief(found, {}) if one.startswith("no fit: "))
    assert why in line


def test_a_sweep_of_one_point_is_shown_in_words() -> None:
    said = Sweep(Sweep.Settings()).in_brief(figures([reading(200.0)]), {})
    assert said[0] == "number of points: 1"
    assert "standard error of the gain, median: 0.01 dB" in said


def test_what_follows_from_the_nominal_circuit_is_not_called_measured_and_sizes_have_a_unit() -> (
    None
):
    model = {
        "circuit": {
            "film_corner_Hz": 6631.0,
            "circuit_corner_Hz": 23157.0,
            "offsets": {"circuit": estimate(-12.1, "dB")},
            "separability": {"fixed": 2, "seen_above": {"R1+R2_ohm": 221115.0}},
            "time_constant": estimate(109.5, "us"),
        }
    }
    results = Results(
        program=Program(name="tactile-rig", version="1"),
        values={"model": model},
        origins=dict(Sweep.summary_origins),
    )
    fields = {"/".join(one.path[2:]): one.attributes for one in result_fields(results)}
    measured = {name for name, found in fields.items() if found.get("origin") == "measured"}
    assert measured == {"time_constant"}
    assert fields["film_corner_Hz"] == {
        "units": "Hz",
        "origin": "computed from the paper's Table 1",
    }
    assert fields["separability/seen_above/R1_R2_ohm"]["units"] == "ohm"
