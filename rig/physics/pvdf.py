"""The PVDF film and its differential amplifier: three readings of the paper's circuit.

A load on the film releases the charge d33 * load (eq. 3). The film (C_PV parallel to R_PV) and the
input of the amplifier (C_OPi parallel to R_OPi) turn it into a voltage. Each reading is a complex
response in V/N as a function of frequency in Hz:

- ``printed``: equation (4) as it stands, through A1..A4 (eqs 5-8);
- ``ohmic``: the same with 1/A4 in place of A4;
- ``circuit``: nodal analysis of the circuit of figure 6, a rational function, used by simulations.

Equation (4) has a defect. It forms (R_OPo + A4), but A4 (eq. 7) is an admittance: siemens are added
to ohms, A4 is numerically negligible against 15 ohm, and the level falls 83 dB below the reading
with (R_OPo + 1/A4). The latter is dimensionally correct and equals the open-circuit film voltage j
w d33 Z_PV (plus d33 j w times the series resistances). ``ohmic``, in turn, omits the load of the
amplifier's input resistance on the film.

No reading predicts what the paper measured above 2 kHz. With Table 1 every reading rises by 20
dB/decade up to 6631 Hz (the film's own R_PV C_PV) or higher, while the measured gain saturates
above 2 kHz, which requires a time constant of 79.6 us. The defaults of the sweep film therefore
depart from Table 1 (R_OPi 1e12 ohm, C_PV 98 pF: 2.0 kHz) and follow the measurement. |H| shows only
a level and one corner: R_PV acts together with R_OPi, C_PV with C_OPi, and d33 with the gain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rig.core.settings import Settings
from rig.physics.modal import Complexes, ZeroPoleGain


class CircuitSettings(Settings):
    """A film and its amplifier. The defaults are the paper's Table 1 (the strips of the skin)."""

    film_capacitance_pF: float = Field(default=30.0, gt=0)
    """C_PV, Table 1."""
    film_resistance_ohm: float = Field(default=8.0e5, gt=0)
    """R_PV, Table 1."""
    input_capacitance_pF: float = Field(default=1.5, gt=0)
    """C_OPi, Table 1."""
    input_resistance_ohm: float = Field(default=3.0e5, gt=0)
    """R_OPi, Table 1."""
    output_resistance_ohm: float = Field(default=15.0, ge=0)
    """R_OPo, Table 1. Used only by the two readings of equation (4)."""
    series_resistance_ohm: float = Field(default=0.0, ge=0)
    """R1 + R2 between film and input. The paper gives no values (assumed 0)."""
    feedback_resistance_ohm: float = Field(default=0.0, ge=0)
    """R3 + R4. The paper gives no values (assumed 0). Used only by the readings of equation (4)."""
    d33_C_N: float = Field(default=2.5e-11, gt=0)
    """Piezoelectric strain constant (assumed; the literature gives 2.0e-11 to 3.3e-11 C/N)."""
    gain: float = Field(default=1.0, gt=0)
    """Voltage gain of the amplifier, per channel (assumed: 1 in the sweep, 1000 on the skin)."""


SKIN_STRIP = CircuitSettings()
"""A strip in the third ridge: Table 1."""

SWEEP_FILM = CircuitSettings(film_capacitance_pF=98.0, input_resistance_ohm=1e12)
"""The film clamped in the sweep: chosen such that it saturates at 2 kHz, as the paper measured."""


def printed(frequency: ArrayLike, settings: CircuitSettings) -> Complexes:
    """Return equation (4) exactly as printed, ohms plus siemens, in V/N at ``frequency`` in Hz.

    It has the shape of ``frequency``.
    """
    drive, a4 = _equation_4(frequency, settings)
    return (settings.output_resistance_ohm + a4) * drive


def ohmic(frequency: ArrayLike, settings: CircuitSettings) -> Complexes:
    """Return equation (4) with 1/A4 for A4, dimensionally correct, in V/N at ``frequency`` in
    Hz.

    It has the shape of ``frequency``.
    """
    drive, a4 = _equation_4(frequency, settings)
    return (settings.output_resistance_ohm + 1 / a4) * drive


def circuit(frequency: ArrayLike, settings: CircuitSettings) -> Complexes:
    """Return the response of the circuit by nodal analysis, in V/N at ``frequency`` in Hz.

    See :func:`polynomials` for its formula.
    """
    numerator, denominator = polynomials(settings)
    s = 2j * np.pi * np.asarray(frequency, dtype=float)
    response: Complexes = np.polyval(numerator, s) / np.polyval(denominator, s)
    return response


def polynomials(settings: CircuitSettings) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return numerator and denominator of ``circuit`` in s (rad/s), highest power first.

        H(s) = G d33 R_PV R_i s / [R_PV (1 + s R_i C_i) + R_i (1 + s R_PV C_PV)
                                   + R_s (1 + s R_PV C_PV) (1 + s R_i C_i)],   R_s = R1 + R2

    Without series resistance the denominator is of first order.
    """
    r_film, r_in = settings.film_resistance_ohm, settings.input_resistance_ohm
    r_series = settings.series_resistance_ohm
    t_film = r_film * settings.film_capacitance_pF * 1e-12
    t_in = r_in * settings.input_capacitance_pF * 1e-12
    numerator = (settings.gain * settings.d33_C_N * r_film * r_in, 0.0)
    first = r_film * t_in + r_in * t_film + r_series * (t_film + t_in)
    denominator: tuple[float, ...] = (first, r_film + r_in + r_series)
    if r_series > 0:
        denominator = (r_series * t_film * t_in, *denominator)
    return numerator, denominator


def zeros_poles_gain(settings: CircuitSettings) -> ZeroPoleGain:
    """Return ``circuit`` as a zero at the origin, one or two real poles (rad/s) and a gain."""
    numerator, denominator = polynomials(settings)
    poles = sorted((complex(root.real) for root in np.roots(denominator)), key=abs)
    return ZeroPoleGain((0j,), tuple(poles), numerator[0] / denominator[0])


def corner_frequency(settings: CircuitSettings) -> float:
    """Return the frequency in Hz of the lowest pole of ``circuit``, where the rise of 20 dB/decade
    ends.

    >>> round(corner_frequency(SWEEP_FILM), -1)
    2000.0
    """
    return abs(zeros_poles_gain(settings).poles[0]) / (2 * np.pi)


def level_at_one_hertz(settings: CircuitSettings) -> float:
    """Return ``b`` of equation (2) in dB re 1 V/N: the low-frequency asymptote of ``circuit`` at 1
    Hz."""
    numerator, denominator = polynomials(settings)
    return float(20 * np.log10(2 * np.pi * numerator[0] / denominator[-1]))


def _equation_4(frequency: ArrayLike, settings: CircuitSettings) -> tuple[Complexes, Complexes]:
    """Return G d33 j w / (A3 A2) and A4 of equations (5) to (8)."""
    r_film, r_in = settings.film_resistance_ohm, settings.input_resistance_ohm
    c_film, c_in = settings.film_capacitance_pF * 1e-12, settings.input_capacitance_pF * 1e-12
    r_out = settings.feedback_resistance_ohm + settings.output_resistance_ohm
    jw = 2j * np.pi * np.asarray(frequency, dtype=float)
    a1 = jw * c_film * r_film / (1 + jw * c_film * r_film)
    a2 = r_in / (r_in + settings.series_resistance_ohm + r_film * (1 - a1))
    a3 = 1 / (jw * c_in * r_in * (1 - a2) + 1)
    a4 = jw * c_in / (1 - a3 + jw * c_in * r_out)
    return settings.gain * settings.d33_C_N * jw / (a3 * a2), a4
