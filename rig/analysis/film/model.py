"""Model of a film's frequency response and its derivatives. No data, no fitting.

    H(f) = polarity * 10^(b/20) * j f / (1 + j f / corner) * exp(-2 pi j f delay)
           * prod_k N_k(f) [* extensions]

This is a first-order circuit (level and one pole, which is all that a response shows of the paper's
figure 6) times one second-order notch for each mechanical drop (paper 3.2 (iii)):

    N(f) = (1 - x^2 + j g x / Q) / (1 - x^2 + j x / Q),   x = f / f_drop,   g = 10^(-depth/20)

``b`` is the level of equation (2) at 1 Hz: the low-frequency asymptote, without pole and notches.
The delay is the remaining time difference between the two channels after all corrections (converter
skew, lag of the load cell's amplifier). It is fitted so that it cannot be mistaken for a part of
the pole. Two extensions turn a statement into a parameter that can be tested:

- a *slope* s in dB/decade in place of the 20 of eq. (2): the magnitude is multiplied by min(f, 2000
  Hz)^(s/20 - 1). The exponent is free up to 2 kHz and one above; the phase is left to the circuit.
  A first-order film has s = 20 exactly, whatever its pole, notches and grid.
- a *break*: a factor 1 + j f / break, above which the gain rises by 20 dB/decade more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig.analysis.response.complex_response import Complexes, Reals

FIRST_ORDER_SLOPE = 20.0
"""Slope of a stress-rate sensor, in dB/decade (paper eq. 2)."""
SLOPE_BAND_HZ = (2.0, 2000.0)
"""Band in which the paper finds that slope (3.2 (i))."""

_NEPER_PER_DB = math.log(10) / 20
_N_NOTCH = 3


@dataclass(frozen=True)
class Notch:
    """A second-order notch."""

    frequency_Hz: float
    """Frequency at which it is deepest."""
    pole_Q: float
    """Quality factor of its poles."""
    depth_dB: float
    """Depth in dB, positive."""


@dataclass(frozen=True)
class FilmModel:
    """Values of all parameters. An extension that is None is not part of the model."""

    level_dB: float
    """Level b, in dB re 1 V/N at 1 Hz (asymptote)."""
    inverse_corner_s: float
    """1 / corner frequency, in 1/Hz; zero for a film without a corner."""
    notches: tuple[Notch, ...] = ()
    """Notches in the gain, each a factor on the response of the circuit."""
    delay_s: float = 0.0
    """Delay of the film's channel after that of the load, in s."""
    polarity: float = 1.0
    """+1, or -1 for a film with reversed connections."""
    slope_dB_decade: float | None = None
    """Exponent of the rise as a slope, in dB/decade; None for 20."""
    break_Hz: float | None = None
    """Frequency of the break; None without one."""

    @property
    def vector(self) -> Reals:
        """Parameters (m,): b, 1/corner, delay, [slope], [ln break]; then ln f, ln Q and depth of
        each notch."""
        head = [self.level_dB, self.inverse_corner_s, self.delay_s]
        if self.slope_dB_decade is not None:
            head.append(self.slope_dB_decade)
        if self.break_Hz is not None:
            head.append(math.log(self.break_Hz))
        for notch in self.notches:
            head += [math.log(notch.frequency_Hz), math.log(notch.pole_Q), notch.depth_dB]
        return np.array(head)

    @property
    def first_notch(self) -> int:
        """Index in :attr:`vector` of the first parameter of the first notch."""
        return 3 + (self.slope_dB_decade is not None) + (self.break_Hz is not None)

    def moved_to(self, vector: Reals) -> FilmModel:
        """Return the same model with the parameters of ``vector``."""
        rest = [float(value) for value in vector[3 : self.first_notch]]
        triples = vector[self.first_notch :].reshape(-1, _N_NOTCH)
        return replace(
            self,
            level_dB=float(vector[0]),
            inverse_corner_s=float(vector[1]),
            delay_s=float(vector[2]),
            slope_dB_decade=rest.pop(0) if self.slope_dB_decade is not None else None,
            break_Hz=math.exp(rest.pop(0)) if self.break_Hz is not None else None,
            notches=tuple(
                Notch(math.exp(log_f), math.exp(log_q), float(depth))
                for log_f, log_q, depth in triples
            ),
        )

    def response(self, frequencies: Reals) -> Complexes:
        """Return the complex response (n,) in V/N at ``frequencies`` (n,) in Hz."""
        value = self.trend(frequencies)
        for notch in self.notches:
            numerator, denominator = _halves(frequencies, notch)
            value = value * numerator / denominator
        return value

    def trend(self, frequencies: Reals) -> Complexes:
        """Return the complex response without the notches. The shape is that of the frequencies."""
        jf = 1j * frequencies
        level = self.polarity * 10 ** (self.level_dB / 20)
        turned = np.exp(-2 * np.pi * jf * self.delay_s)
        value: Complexes = level * turned * jf / (1 + jf * self.inverse_corner_s)
        if self.slope_dB_decade is not None:
            excess = self.slope_dB_decade / FIRST_ORDER_SLOPE - 1
            value = value * np.minimum(frequencies, SLOPE_BAND_HZ[1]) ** excess
        if self.break_Hz is not None:
            value = value * (1 + jf / self.break_Hz)
        return value

    def loss_dB(self, frequencies: Reals) -> Reals:  # noqa: N802
        """Return the attenuation by the notches in dB, (n,), positive."""
        ratio = np.abs(self.trend(frequencies) / self.response(frequencies))
        loss: Reals = 20 * np.log10(ratio)
        return loss

    def log_jacobian(self, frequencies: Reals) -> Complexes:
        """Return the derivatives of ln :meth:`response` with respect to :attr:`vector`: (m, n),
        gain + j phase."""
        jf = 1j * frequencies
        rows = [
            np.full(frequencies.shape, _NEPER_PER_DB, dtype=complex),
            -jf / (1 + jf * self.inverse_corner_s),
            -2 * np.pi * jf,
        ]
        if self.slope_dB_decade is not None:
            rows.append(np.log(np.minimum(frequencies, SLOPE_BAND_HZ[1])) / FIRST_ORDER_SLOPE + 0j)
        if self.break_Hz is not None:
            rows.append(-jf / self.break_Hz / (1 + jf / self.break_Hz))
        for notch in self.notches:
            rows += _notch_derivatives(frequencies, notch)
        return np.stack(rows)


def without(model: FilmModel, index: int) -> FilmModel:
    """Return the model without its notch number ``index``."""
    kept = tuple(notch for k, notch in enumerate(model.notches) if k != index)
    return replace(model, notches=kept)


def in_order(notches: Sequence[Notch]) -> tuple[Notch, ...]:
    """Return the notches by ascending frequency."""
    return tuple(sorted(notches, key=lambda notch: notch.frequency_Hz))


def _halves(frequencies: Reals, notch: Notch) -> tuple[Complexes, Complexes]:
    x = frequencies / notch.frequency_Hz
    width = 1j * x / notch.pole_Q
    return 1 - x**2 + 10 ** (-notch.depth_dB / 20) * width, 1 - x**2 + width


def _notch_derivatives(frequencies: Reals, notch: Notch) -> list[Complexes]:
    """Return the derivatives of ln N with respect to ln f_drop, ln Q and depth in dB."""
    x = frequencies / notch.frequency_Hz
    width = 1j * x / notch.pole_Q
    g = 10 ** (-notch.depth_dB / 20)
    numerator, denominator = _halves(frequencies, notch)
    by_frequency = -((g * width - 2 * x**2) / numerator - (width - 2 * x**2) / denominator)
    by_quality = -g * width / numerator + width / denominator
    by_depth = -_NEPER_PER_DB * g * width / numerator
    return [by_frequency, by_quality, by_depth]
