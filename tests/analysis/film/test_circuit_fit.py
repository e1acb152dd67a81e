"""What a response says about the circuit's values, and the list of what it cannot say."""

import numpy as np
import pytest

from rig.analysis.estimate import Estimate
from rig.analysis.film.circuit import asymptote_dB, compare_circuit, matched, separability
from rig.analysis.response.curve import ResponseCurve
from rig.physics import pvdf
from rig.physics.pvdf import SKIN_STRIP, SWEEP_FILM, CircuitSettings

F = np.geomspace(2, 20000, 150)


def curve_of(circuit, error_dB=0.03):
    response = pvdf.circuit(F, circuit)
    variance = np.square(error_dB / 8.686 * np.abs(response))
    return ResponseCurve.of(F, response, variance[:, None, None] * np.eye(2))


def compared(circuit, given=SKIN_STRIP):
    corner = pvdf.corner_frequency(circuit)
    return compare_circuit(
        curve_of(circuit),
        Estimate.normal(pvdf.level_at_one_hertz(circuit), 0.002, "dB"),
        Estimate.of_inverse(1 / corner, 1e-3 / corner, "Hz"),
        given,
    )


@pytest.mark.parametrize(
    ("reading", "level"),
    [(pvdf.printed, -161.271), (pvdf.ohmic, -78.015), (pvdf.circuit, -89.302)],
)
def test_level_of_each_reading(reading, level):
    assert asymptote_dB(reading, SKIN_STRIP) == pytest.approx(level, abs=0.002)


def test_offsets_are_readings_less_measurement():
    found = compared(SWEEP_FILM)
    level = pvdf.level_at_one_hertz(SWEEP_FILM)
    assert {name: e.value for name, e in found.offsets.items()} == pytest.approx(
        {"printed": -161.271 - level, "ohmic": -78.015 - level, "circuit": -89.302 - level},
        abs=0.01,
    )


def test_level_and_pole_are_given_as_values_of_the_circuit():
    found = compared(SWEEP_FILM)
    parallel = 1 / (1 / 8e5 + 1e-12)
    assert found.rate_sensitivity.value == pytest.approx(2.5e-11 * parallel * 1e6, rel=1e-6)
    assert found.time_constant.value == pytest.approx(parallel * 99.5e-12 * 1e6, rel=1e-6)
    assert found.time_constant.low < found.time_constant.value < found.time_constant.high


def test_a_circuit_that_does_saturate_there_is_not_contradicted():
    assert "as expected" in compared(SWEEP_FILM, given=SWEEP_FILM).sentences()[0]
    strip = compared(SKIN_STRIP).sentences()[0]
    assert "beyond the measured range" in strip
    assert "as expected" in strip
    assert "times the measured one" in compared(SWEEP_FILM).sentences()[0]


def test_two_combinations_are_fixed_and_the_rest_is_listed():
    table = separability(curve_of(SWEEP_FILM), matched(SKIN_STRIP, -72.0, 2000.0))
    assert table.fixed == 2
    assert {frozenset(group) for group in table.act_as_one} == {
        frozenset({"d33", "gain"}),
        frozenset({"C_PV", "C_OPi"}),
        frozenset({"R_PV", "R_OPi"}),
    }
    assert set(table.without_effect) == {"R_OPo", "R3+R4"}
    assert "R1+R2" in table.seen_above
    assert len(table.trade) == 1


@pytest.mark.parametrize("size", [0.001, 0.1])
def test_a_listed_exchange_leaves_the_gain_as_it_is(size):
    circuit = matched(SKIN_STRIP, -72.0, 2000.0)
    names = {
        "d33": "d33_C_N",
        "R_OPi": "input_resistance_ohm",
        "R_PV": "film_resistance_ohm",
        "C_PV": "film_capacitance_pF",
        "C_OPi": "input_capacitance_pF",
        "gain": "gain",
    }
    values = circuit.model_dump()
    for symbol, power in separability(curve_of(circuit), circuit).trade[0].items():
        values[names[symbol]] *= np.exp(power * size)
    before = 20 * np.log10(np.abs(pvdf.circuit(F, circuit)))
    after = 20 * np.log10(np.abs(pvdf.circuit(F, CircuitSettings.model_validate(values))))
    assert np.abs(after - before).max() < 5 * size**2 + 1e-4
    assert size < 0.01 or np.abs(values["d33_C_N"] / circuit.d33_C_N - 1) > 0.02


def test_series_resistance_shows_from_where_its_second_pole_comes_near():
    circuit = CircuitSettings(
        input_capacitance_pF=100.0, input_resistance_ohm=1e12, film_capacitance_pF=98.0
    )
    smallest = separability(curve_of(circuit), circuit).seen_above["R1+R2"]
    assert np.isfinite(smallest)
    text = "\n".join(separability(curve_of(circuit), circuit).sentences())
    assert "R1+R2: any value below" in text
    plain = separability(curve_of(circuit), circuit).as_dict()
    assert plain["seen_above"] == {"R1+R2_ohm": smallest}
