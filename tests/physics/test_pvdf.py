"""The circuit's three readings against their computed levels; where they cannot saturate."""

import numpy as np
import pytest

from rig.physics import pvdf
from rig.physics.pvdf import SKIN_STRIP, SWEEP_FILM, CircuitSettings

MEGOHM = CircuitSettings(series_resistance_ohm=1e6)
DECADES = np.array([2.0, 20.0, 200.0, 2000.0, 20000.0])

TABLE = [
    (pvdf.printed, SKIN_STRIP, (-155.250, -135.250, -115.253, -95.596, -82.871), 19.956),
    (pvdf.printed, MEGOHM, (-149.633, -129.633, -109.636, -89.862, -73.130), 19.971),
    (pvdf.ohmic, SKIN_STRIP, (-71.994, -51.994, -31.998, -12.372, -2.035), 19.952),
    (pvdf.circuit, SKIN_STRIP, (-83.281, -63.281, -43.281, -23.313, -5.701), 19.996),
    (pvdf.circuit, SWEEP_FILM, (-71.995, -51.996, -32.038, -15.007, -12.041), 19.565),
]
IDS = ["printed", "printed-1-megohm", "ohmic", "circuit-skin", "circuit-sweep"]


def decibels(response):
    return 20 * np.log10(np.abs(response))


@pytest.mark.parametrize(("reading", "settings", "levels", "slope"), TABLE, ids=IDS)
def test_levels_from_2_to_20000_hertz(reading, settings, levels, slope):
    assert decibels(reading(DECADES, settings)) == pytest.approx(levels, abs=0.0006)


@pytest.mark.parametrize(("reading", "settings", "levels", "slope"), TABLE, ids=IDS)
def test_every_reading_rises_20_decibels_a_decade_up_to_2_kilohertz(
    reading, settings, levels, slope
):
    f = np.geomspace(2, 2000, 30001)
    fitted = np.polyfit(np.log10(f), decibels(reading(f, settings)), 1)[0]
    assert fitted == pytest.approx(slope, abs=0.0006)


def test_adding_siemens_to_ohms_costs_83_decibels():
    gap = decibels(pvdf.ohmic(2.0, SKIN_STRIP)) - decibels(pvdf.printed(2.0, SKIN_STRIP))
    assert gap == pytest.approx(83.256, abs=0.001)


def test_the_ohmic_reading_is_the_open_circuit_film_voltage():
    f = np.geomspace(2, 20000, 50)
    jw = 2j * np.pi * f
    film = 8e5 / (1 + jw * 8e5 * 30e-12)
    # (R_OPo + R_OPo)/(A3 A2) is all that is left: 30 ohm against 800 kilohm
    assert pvdf.ohmic(f, SKIN_STRIP) == pytest.approx(2.5e-11 * jw * film, rel=2e-3)


def test_the_circuit_solves_its_node_equations():
    settings = CircuitSettings(series_resistance_ohm=2e5, gain=7.0)
    for f in (3.0, 700.0, 15000.0):
        jw = 2j * np.pi * f
        y_film, y_in, y_series = 1 / 8e5 + jw * 30e-12, 1 / 3e5 + jw * 1.5e-12, 1 / 2e5
        nodes = np.array([[y_film + y_series, -y_series], [-y_series, y_in + y_series]])
        volts = np.linalg.solve(nodes, [jw * 2.5e-11, 0])
        assert pvdf.circuit(f, settings) == pytest.approx(7.0 * volts[1], rel=1e-12)


@pytest.mark.parametrize("settings", [SKIN_STRIP, SWEEP_FILM, MEGOHM], ids=["skin", "sweep", "1M"])
def test_zeros_poles_and_gain_are_the_same_function(settings):
    f = np.geomspace(1, 1e6, 40)
    form = pvdf.zeros_poles_gain(settings)
    assert form.response(f) == pytest.approx(pvdf.circuit(f, settings), rel=1e-9)


def test_no_reading_of_table_1_saturates_at_2_kilohertz():
    f = np.array([2000.0, 4000.0])
    for reading in (pvdf.printed, pvdf.ohmic, pvdf.circuit):
        rise = np.diff(decibels(reading(f, SKIN_STRIP)))[0]
        assert rise > 4.5, "an octave above 2 kHz still rises at nearly 6 dB"
    assert np.diff(decibels(pvdf.circuit(f, SWEEP_FILM)))[0] < 2.1
    film_alone = 1 / (2 * np.pi * 8e5 * 30e-12)
    assert film_alone == pytest.approx(6631, abs=0.5)
    assert pvdf.corner_frequency(SKIN_STRIP) > film_alone
    assert pvdf.corner_frequency(SWEEP_FILM) == pytest.approx(2000, abs=1)


def test_the_corner_is_where_the_gain_is_3_decibels_under_its_asymptote():
    for settings in (SKIN_STRIP, SWEEP_FILM):
        corner = pvdf.corner_frequency(settings)
        asymptote = pvdf.level_at_one_hertz(settings) + 20 * np.log10(corner)
        assert decibels(pvdf.circuit(corner, settings)) == pytest.approx(
            asymptote - 3.0103, abs=1e-4
        )


def test_gain_multiplies_and_unknown_components_are_refused():
    louder = CircuitSettings(gain=1000.0)
    assert decibels(pvdf.circuit(2.0, louder)) == pytest.approx(-23.281, abs=0.001)
    with pytest.raises(ValueError, match="C_PV"):
        CircuitSettings(C_PV=30.0)
    with pytest.raises(ValueError, match="greater than 0"):
        CircuitSettings(film_capacitance_pF=0.0)
