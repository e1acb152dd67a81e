"""Circuit values of the paper's figure 6 that a measured response determines, and those it cannot.

The response determines a level and a pole (`rig.analysis.film.fit`). Which circuit values remain
open is computed, not assumed: from the derivatives of ln|H| of the nodal circuit with respect to
the logarithm of each value, at a circuit with the measured level and pole, weighted with the
measured errors. A value whose column is zero has no effect. Values whose columns are parallel act
as one. Directions in the null space are changes of several values together that leave |H|
unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.analysis.estimate import COVERAGE_95, Estimate
from rig.analysis.response.complex_response import DB_PER_RELATIVE, Complexes, Reals
from rig.analysis.response.curve import ResponseCurve
from rig.physics import pvdf
from rig.physics.pvdf import CircuitSettings

Reading = Callable[[ArrayLike, CircuitSettings], Complexes]
"""A reading of equation (4): the response (n,) at frequencies (n,) for given circuit values."""
READINGS: Mapping[str, Reading] = {
    "printed": pvdf.printed,
    "ohmic": pvdf.ohmic,
    "circuit": pvdf.circuit,
}
"""The three readings of the paper's equation (4), by name."""
READING_NAMES: Mapping[str, str] = {
    "printed": "eq. (4) as printed",
    "ohmic": "eq. (4) with units corrected",
    "circuit": "circuit analysis",
}
"""Names of the readings in a sentence."""
PAPER_OFFSET_DB = 24.0
"""Offset that the paper subtracted from its computed gain to match the measured one (figure 7)."""
SYMBOLS: Mapping[str, str] = {
    "film_capacitance_pF": "C_PV",
    "film_resistance_ohm": "R_PV",
    "input_capacitance_pF": "C_OPi",
    "input_resistance_ohm": "R_OPi",
    "output_resistance_ohm": "R_OPo",
    "series_resistance_ohm": "R1+R2",
    "feedback_resistance_ohm": "R3+R4",
    "d33_C_N": "d33",
    "gain": "gain",
}
"""Symbols of the paper for the settings of the circuit."""

_STEP = 1e-3
_PARALLEL = 1e-6
_NULL = 1e-7
_ASYMPTOTE_HZ = 1e-2
_SAME_SIZE = 1.001
"""Ratio to which a threshold is determined."""


@dataclass(frozen=True)
class Separability:
    """The circuit values that |H| determines, and those that it does not. All names are symbols of
    the paper."""

    fixed: int
    """Number of combinations of values that the response determines."""
    without_effect: tuple[str, ...]
    """Values that do not affect |H|, however large they are."""
    act_as_one: tuple[tuple[str, ...], ...]
    """Groups of values that enter |H| only through one common quantity."""
    trade: tuple[Mapping[str, float], ...]
    """Exponents of common changes of the remaining values that leave |H| unchanged."""
    seen_above: Mapping[str, float]
    """Size in ohm at which |H| would show a value that is zero in the circuit (2 standard errors),
    by name."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values; a size in ohm has its unit in its name."""
        sizes = {f"{name}_ohm": size for name, size in self.seen_above.items()}
        return {**asdict(self), "seen_above": sizes}

    def sentences(self) -> list[str]:
        """Return the list in words."""
        lines = [
            f"Only {self.fixed} combinations of circuit values can be determined from |H|. "
            "Not identifiable:"
        ]
        lines += [
            f"  {' and '.join(names)} separately (they act as one)" for names in self.act_as_one
        ]
        for direction in self.trade:
            largest_first = sorted(direction.items(), key=lambda change: -abs(change[1]))
            changes = ", ".join(f"{name} {power:+.2f} %" for name, power in largest_first)
            lines.append(f"  a simultaneous change of {changes} leaves |H| unchanged")
        if self.without_effect:
            lines.append(f"  {', '.join(self.without_effect)} at all (no effect on |H|)")
        for name, size in self.seen_above.items():
            finite = math.isfinite(size)
            below = f"any value below {float(f'{size / 1e3:.2g}'):g} kΩ" if finite else "any value"
            lines.append(f"  {name}: {below} fits")
        return lines


@dataclass(frozen=True)
class CircuitComparison:
    """The measured level and pole, compared with the circuit that the paper gives."""

    level: Estimate
    """Measured level b, in dB re 1 V/N at 1 Hz."""
    corner: Estimate
    """Measured frequency of the pole, in Hz."""
    rate_sensitivity: Estimate
    """The level as a value of the circuit: volts per N/s of load rate, in uV s/N."""
    time_constant: Estimate
    """The pole as a value of the circuit, in us."""
    offsets: Mapping[str, Estimate]
    """Predicted minus measured level at 1 Hz for each reading, in dB."""
    film_corner_Hz: float
    """Corner 1 / (2 pi R_PV C_PV) of the given circuit: 6631 Hz with Table 1."""
    circuit_corner_Hz: float
    """Pole of the given circuit by nodal analysis (R_OPi parallel to R_PV), in Hz."""
    highest_Hz: float
    """Highest measured frequency."""
    separability: Separability
    """The circuit values that the response determines, and those that it does not."""

    def sentences(self) -> list[str]:
        """Return the comparison in words."""
        offsets = "; ".join(
            f"{READING_NAMES[name]} {offset.value:+.2f} dB" for name, offset in self.offsets.items()
        )
        return [
            self._corner_sentence(),
            f"As values of the circuit: level {self.rate_sensitivity}, pole {self.time_constant}.",
            "Level predicted minus measured "
            f"(± {self.level.high - self.level.value:.2g} dB): {offsets}. "
            f"(The paper applied {-PAPER_OFFSET_DB:g} dB to its own prediction.) The predictions "
            "use d33, amplifier gain and R1 to R4 that are ASSUMED: the paper gives none.",
            *self.separability.sentences(),
        ]

    def _corner_sentence(self) -> str:
        predicted = (
            f"the nominal circuit predicts a corner at {self.film_corner_Hz:.0f} Hz for the film "
            f"alone (R_PV C_PV) and at {self.circuit_corner_Hz:.0f} Hz with the amplifier's input"
        )
        if not math.isfinite(self.corner.high):
            return f"No corner was found up to {self.highest_Hz:g} Hz; {predicted}."
        beyond = ", beyond the measured range and visible by its bend" * (
            self.corner.low > self.highest_Hz
        )
        found = f"The gain saturates at {self.corner}{beyond}"
        if self.corner.covers(self.film_corner_Hz) or self.corner.covers(self.circuit_corner_Hz):
            return f"{found}, as expected: {predicted}."
        ratio = self.film_corner_Hz / self.corner.value
        return (
            f"{found}; {predicted}. The predicted corner of the film alone is {ratio:.2f} times "
            "the measured one."
        )


def compare_circuit(
    curve: ResponseCurve, level: Estimate, corner: Estimate, given: CircuitSettings
) -> CircuitComparison:
    """Compare a fitted ``level`` (dB re 1 V/N at 1 Hz) and ``corner`` (Hz) with a given
    circuit."""
    offsets = {
        name: Estimate.normal(
            asymptote_dB(reading, given) - level.value, level.standard_error, "dB"
        )
        for name, reading in READINGS.items()
    }
    film_time = given.film_resistance_ohm * given.film_capacitance_pF * 1e-12
    return CircuitComparison(
        level=level,
        corner=corner,
        rate_sensitivity=Estimate.of_logarithm(
            math.log(1e6 / (2 * math.pi)) + level.value / DB_PER_RELATIVE,
            level.standard_error / DB_PER_RELATIVE,
            "uV s/N",
        ),
        time_constant=_time_constant(corner),
        offsets=offsets,
        film_corner_Hz=1 / (2 * math.pi * film_time),
        circuit_corner_Hz=pvdf.corner_frequency(given),
        highest_Hz=float(curve.frequencies[-1]),
        separability=separability(curve, matched(given, level.value, corner.value)),
    )


def _time_constant(corner: Estimate) -> Estimate:
    """Return 1 / (2 pi corner) in us. The ends of the interval are those of the corner,
    inverted."""
    low, value, high = (
        1e6 / (2 * math.pi * frequency) for frequency in (corner.high, corner.value, corner.low)
    )
    return Estimate(value, (high - low) / (2 * COVERAGE_95), low, high, "us")


def asymptote_dB(reading: Reading, circuit: CircuitSettings) -> float:  # noqa: N802
    """Return the level of a reading at 1 Hz as equation (2) defines it: its low-frequency
    asymptote, in dB."""
    response = reading(np.array([_ASYMPTOTE_HZ]), circuit)
    return float(20 * np.log10(np.abs(response[0]) / _ASYMPTOTE_HZ))


def matched(given: CircuitSettings, level_dB: float, corner_Hz: float) -> CircuitSettings:
    """Return the given circuit with C_PV and d33 changed to a level and, if it is finite, a
    corner."""
    values = given.model_dump()
    if math.isfinite(corner_Hz):
        scale = pvdf.corner_frequency(given) / corner_Hz
        total = (given.film_capacitance_pF + given.input_capacitance_pF) * scale
        values["film_capacitance_pF"] = max(
            total - given.input_capacitance_pF, 1e-3 * given.film_capacitance_pF
        )
    values["d33_C_N"] *= 10 ** ((level_dB - pvdf.level_at_one_hertz(given)) / 20)
    return CircuitSettings.model_validate(values)


def separability(curve: ResponseCurve, circuit: CircuitSettings) -> Separability:
    """Return which values of ``circuit`` the gains of ``curve``, with their errors, can
    distinguish."""
    columns = _sensitivities(curve, circuit)
    zero = {name for name, value in circuit.model_dump().items() if value == 0}
    strength = {name: float(np.linalg.norm(column)) for name, column in columns.items()}
    strongest = max(strength.values())
    silent = {name for name, size in strength.items() if size <= _NULL * strongest}
    groups = _parallel([name for name in columns if name not in zero | silent], columns)
    leaders = np.stack([columns[group[0]] / strength[group[0]] for group in groups])
    turned, sizes, _ = np.linalg.svd(leaders, full_matrices=True)
    rank = int((sizes > _NULL * sizes[0]).sum())
    basis = np.linalg.qr(np.stack([columns[group[0]] for group in groups]).T)[0][:, :rank]
    null = turned[:, rank:].T / np.array([strength[group[0]] for group in groups])
    return Separability(
        fixed=rank,
        without_effect=tuple(SYMBOLS[name] for name in columns if name in silent),
        act_as_one=tuple(tuple(SYMBOLS[n] for n in group) for group in groups if len(group) > 1),
        trade=tuple(_exponents(direction, groups) for direction in _reduced(null)),
        seen_above={
            SYMBOLS[name]: _smallest_seen(curve, circuit, name, basis)
            for name in columns
            if name in zero - silent
        },
    )


def _sensitivities(curve: ResponseCurve, circuit: CircuitSettings) -> dict[str, Reals]:
    """Return the sensitivity of ln|H| to the logarithm of each value, in standard errors, (n,)
    each.

    A value that is zero has no logarithm: it is varied in units of the film's resistance.
    """
    weight = DB_PER_RELATIVE / curve.gain_errors_dB
    values = circuit.model_dump()

    def logarithm(name: str, value: float) -> Reals:
        changed = CircuitSettings.model_validate(values | {name: value})
        result: Reals = np.log(np.abs(pvdf.circuit(curve.frequencies, changed)))
        return result

    columns = {}
    for name, value in values.items():
        if value == 0:
            step = 1e-6 * circuit.film_resistance_ohm
            change = (logarithm(name, step) - logarithm(name, 0.0)) / 1e-6
        else:
            up, down = value * math.exp(_STEP), value * math.exp(-_STEP)
            change = (logarithm(name, up) - logarithm(name, down)) / (2 * _STEP)
        columns[name] = weight * change
    return columns


def _parallel(names: list[str], columns: dict[str, Reals]) -> list[list[str]]:
    """Return the names in groups of parallel columns, the strongest of each group first."""
    ordered = sorted(names, key=lambda name: -float(np.linalg.norm(columns[name])))
    groups: list[list[str]] = []
    for name in ordered:
        for group in groups:
            if _sine(columns[name], columns[group[0]]) < _PARALLEL**0.5:
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _sine(first: Reals, second: Reals) -> float:
    """Return the sine of the angle between two columns."""
    unit = second / np.linalg.norm(second)
    return float(np.linalg.norm(first - unit * (unit @ first)) / np.linalg.norm(first))


def _reduced(null: Reals) -> Reals:
    """Return the null directions (k, m) in reduced echelon form: as few values in each as
    possible."""
    rows = null.copy()
    for k in range(len(rows)):
        pivot = int(np.argmax(np.abs(rows[k])))
        rows[k] /= rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, pivot] * rows[k]
    rows[np.abs(rows) < 1e-4] = 0.0
    return rows


def _exponents(direction: Reals, groups: list[list[str]]) -> dict[str, float]:
    return {
        SYMBOLS[group[0]]: float(power)
        for group, power in zip(groups, direction, strict=True)
        if power
    }


def _smallest_seen(
    curve: ResponseCurve, circuit: CircuitSettings, name: str, basis: Reals
) -> float:
    """Return the size in ohm of a zero value at which |H| would differ by two standard errors.

    It is found from whole changes, not from derivatives: to first order a small series resistance
    changes |H| as the pole does. Level and corner follow the change, because C_PV and d33 are
    fitted anyway. Infinite if even 1e12 times the film's resistance has no such effect.
    """
    weight = DB_PER_RELATIVE / curve.gain_errors_dB
    level, corner = pvdf.level_at_one_hertz(circuit), pvdf.corner_frequency(circuit)
    at_zero = np.log(np.abs(pvdf.circuit(curve.frequencies, circuit)))

    def stands_out(size: float) -> bool:
        changed = CircuitSettings.model_validate(circuit.model_dump() | {name: size})
        response = pvdf.circuit(curve.frequencies, matched(changed, level, corner))
        change = weight * (np.log(np.abs(response)) - at_zero)
        return bool(np.linalg.norm(change - basis @ (basis.T @ change)) > 2)

    low, high = 1e-6 * circuit.film_resistance_ohm, 1e12 * circuit.film_resistance_ohm
    if not stands_out(high):
        return math.inf
    while high > _SAME_SIZE * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if stands_out(middle) else (middle, high)
    return high
