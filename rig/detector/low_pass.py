"""Designs the low-pass filter of the predictive signal from a specification (paper 4.3).

A specification states the -3 dB frequency, the attenuation of the stop band, and one of two: the
phase lag at a low frequency (the paper gives 9 degrees at 1 Hz) or the beginning of the stop band.
The result is a minimum-phase filter of finite length made from a Kaiser prototype: no causal filter
with the same magnitude has less lag. This least lag follows from the magnitude alone (Bode's
integral), so a specification that asks for less is refused, and the error states the bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from rig.core.settings import Settings
from rig.detector.fir import frequency_response, kaiser_shape, minimum_phase

Reals = NDArray[np.float64]

HALF_POWER_dB = -3.0
"""Gain at `LowPassSettings.half_power_Hz`."""
LEAST_STOP_dB = 21.0
"""Least attenuation: that of a window with equal weights."""
MOST_TAPS = 20_001
"""Largest length of a filter."""


class LowPassSettings(Settings):
    """Specification of a low-pass filter; the defaults are those of the paper (4.3, Figure 14)."""

    half_power_Hz: float = Field(28.0, gt=0)
    """Frequency at which the gain is -3 dB."""
    stop_dB: float = Field(73.5, ge=LEAST_STOP_dB, le=150)
    """Attenuation of the stop band (assumed: the paper's figure is missing)."""
    lag_deg: float | None = Field(9.0, gt=0)
    """Phase lag at `lag_Hz`; none if `stop_Hz` is given."""
    lag_Hz: float = Field(1.0, gt=0)
    """Frequency at which the lag is specified."""
    stop_Hz: float | None = Field(None, gt=0)
    """Beginning of the stop band; none if the lag is given."""

    @model_validator(mode="after")
    def _is_determined(self) -> Self:
        if (self.lag_deg is None) == (self.stop_Hz is None):
            raise ValueError(
                f"lag_deg {self.lag_deg} and stop_Hz {self.stop_Hz}: give exactly one; with the "
                "attenuation, each of them decides the other"
            )
        if self.lag_Hz >= self.half_power_Hz:
            raise ValueError(
                f"lag_Hz {self.lag_Hz:g} Hz must be below half_power_Hz {self.half_power_Hz:g} Hz: "
                "the lag is stated for what the filter passes"
            )
        if self.stop_Hz is not None and self.stop_Hz <= self.half_power_Hz:
            raise ValueError(
                f"stop_Hz {self.stop_Hz:g} Hz must be above half_power_Hz "
                f"{self.half_power_Hz:g} Hz: the gain falls on the way from one to the other"
            )
        return self


NAMED_LOW_PASSES: dict[str, LowPassSettings] = {
    "paper": LowPassSettings(),
    "fast": LowPassSettings(stop_dB=50.0, lag_deg=6.0),
    "faster": LowPassSettings(stop_dB=30.0, lag_deg=4.0),
}
"""The filter of the paper, and two that respond sooner and attenuate less."""


@dataclass(frozen=True)
class LowPass:
    """A low-pass filter as it was designed, for rows at `rate_Hz`."""

    settings: LowPassSettings
    """Specification that it was designed from."""
    rate_Hz: float
    """Sampling rate, in Hz."""
    taps: Reals
    """Taps (n,), for the newest sample first; the gain at 0 Hz is 1."""

    def response(self, frequency_Hz: ArrayLike) -> NDArray[np.complex128]:
        """Return the complex gain (k,) at frequencies (k,) in Hz."""
        return frequency_response(self.taps, frequency_Hz, self.rate_Hz)

    def level(self, frequency_Hz: ArrayLike) -> Reals:
        """Return the gain in dB (k,) at frequencies (k,) in Hz."""
        gain: Reals = 20 * np.log10(np.maximum(np.abs(self.response(frequency_Hz)), 1e-12))
        return gain

    def lag_deg(self, frequency_Hz: float) -> float:
        """Return the phase lag in degrees at a frequency of the pass band."""
        return _lag_deg(self.taps, frequency_Hz, self.rate_Hz)

    def group_delay_s(self, frequency_Hz: ArrayLike) -> Reals:
        """Return the group delay in s (k,) at frequencies (k,) in Hz."""
        place = np.arange(self.taps.size)
        weighted = frequency_response(self.taps * place, frequency_Hz, self.rate_Hz)
        delay: Reals = np.real(weighted / self.response(frequency_Hz)) / self.rate_Hz
        return delay

    def step_response(self) -> Reals:
        """Return the response to a unit step (n,), beginning with the first sample of the step."""
        answer: Reals = np.cumsum(self.taps)
        return answer


@lru_cache(maxsize=32)
def design_low_pass(settings: LowPassSettings, rate_Hz: float) -> LowPass:
    """Return the filter for a specification at a sampling rate.

    Raises ValueError, with the bound, if no causal filter or none of this family meets it.

    >>> paper = design_low_pass(NAMED_LOW_PASSES["paper"], rate_Hz=1000.0)
    >>> paper.taps.size, round(paper.lag_deg(1.0), 3)
    (123, 9.0)
    """
    if settings.half_power_Hz >= rate_Hz / 2:
        raise ValueError(
            f"half_power_Hz {settings.half_power_Hz:g} Hz must be below half the sampling rate of "
            f"{rate_Hz:g} Hz: sample faster"
        )
    if settings.stop_Hz is not None:
        taps = _with_stop_band_from(settings, settings.stop_Hz, rate_Hz)
    else:
        assert settings.lag_deg is not None
        taps = _with_lag(settings, settings.lag_deg, rate_Hz)
    return LowPass(settings, rate_Hz, minimum_phase(taps))


def least_lag_deg(
    half_power_Hz: float, stop_Hz: float, stop_dB: float, rate_Hz: float, lag_Hz: float
) -> float:
    """Return the least lag in degrees at `lag_Hz` of any causal filter of the specified shape.

    This is Bode's integral on the unit circle for the magnitude with the least lag among those that
    never amplify: 0 dB up to `half_power_Hz`, 3 dB down to `stop_Hz`, and `stop_dB` down beyond it.
    """
    to_neper = math.log(10) / 20
    here = math.pi * lag_Hz / rate_Hz

    def step(at_Hz: float, drop_dB: float) -> float:
        edge = math.pi * at_Hz / rate_Hz
        return (
            drop_dB * to_neper / math.pi * math.log(math.sin(edge + here) / math.sin(edge - here))
        )

    lag = step(half_power_Hz, -HALF_POWER_dB)
    if stop_Hz < rate_Hz / 2 - lag_Hz:
        lag += step(stop_Hz, stop_dB + HALF_POWER_dB)
    return math.degrees(lag)


def _with_stop_band_from(settings: LowPassSettings, stop_Hz: float, rate_Hz: float) -> Reals:
    """Return the shortest linear-phase prototype whose stop band begins at `stop_Hz`."""
    if stop_Hz >= rate_Hz / 2:
        raise ValueError(
            f"stop_Hz {stop_Hz:g} Hz must be below half the sampling rate of {rate_Hz:g} Hz"
        )
    stop_band = np.linspace(stop_Hz, rate_Hz / 2, 1024)

    def attenuates(half: int) -> bool:
        taps = _prototype(settings, half, settings.stop_dB, rate_Hz)
        largest = np.abs(frequency_response(taps, stop_band, rate_Hz)).max()
        return bool(largest <= 10 ** (-settings.stop_dB / 20))

    half = _shortest(settings, rate_Hz, attenuates, f"stop_Hz {stop_Hz:g} Hz with ")
    return _prototype(settings, half, settings.stop_dB, rate_Hz)


def _with_lag(settings: LowPassSettings, lag_deg: float, rate_Hz: float) -> Reals:
    """Return the linear-phase prototype whose minimum-phase form has exactly this lag.

    The length is chosen to the nearest tap, and the attenuation is adjusted for the remainder.
    """

    def lag_of(half: int, stop_dB: float) -> float:
        taps = minimum_phase(_prototype(settings, half, stop_dB, rate_Hz))
        return _lag_deg(taps, settings.lag_Hz, rate_Hz)

    def error_of(half: int, wanted_deg: float, stop_dB: float) -> float:
        return lag_of(half, stop_dB) - wanted_deg

    shortest = _shortest(settings, rate_Hz, lambda half: True, "")

    def with_exactly(lag_deg: float) -> Reals | None:
        half = _shortest(
            settings,
            rate_Hz,
            lambda n: lag_of(n, settings.stop_dB) >= lag_deg,
            f"lag_deg {lag_deg:g} deg with ",
        )
        for length in range(half, max(half - 2, shortest - 1), -1):
            most_dB = _most_attenuation(settings, length, rate_Hz)
            error = partial(error_of, length, lag_deg)
            adjusted = _zero_near(error, settings.stop_dB, most_dB)
            if adjusted is not None:
                return _prototype(settings, length, adjusted, rate_Hz)
        return None

    least = lag_of(shortest, settings.stop_dB)
    taps = with_exactly(lag_deg) if lag_deg >= least else None
    if taps is not None:
        return taps
    half = shortest
    while (least := _rounded_up(lag_of(half, settings.stop_dB))) < lag_deg or (
        with_exactly(least) is None
    ):
        half += 1
    nyquist = rate_Hz / 2
    bound = least_lag_deg(
        settings.half_power_Hz, nyquist / 2, settings.stop_dB, rate_Hz, settings.lag_Hz
    )
    raise ValueError(
        f"lag_deg {lag_deg:g} deg at {settings.lag_Hz:g} Hz must be at least {least:.2f} deg "
        f"where {settings.half_power_Hz:g} Hz is -3 dB, {settings.stop_dB:g} dB are asked for "
        f"and the rate is {rate_Hz:g} Hz: by Bode's integral any causal filter that is so far "
        f"down from {nyquist / 2:g} Hz on lags {bound:.2f} deg. Attenuate less, or allow more "
        "lag"
    )


def _rounded_up(lag_deg: float) -> float:
    """Return a lag rounded up to what a message shows of it."""
    return math.ceil(lag_deg * 100) / 100


def _zero_near(error: Callable[[float], float], stop_dB: float, most_dB: float) -> float | None:
    """Return the attenuation near `stop_dB`, at most `most_dB`, at which `error` is 0; None if
    there is none."""
    from scipy.optimize import brentq

    middle = error(stop_dB)
    low, high = stop_dB - 0.1, min(stop_dB + 0.1, most_dB)
    while error(low) * middle > 0 and error(high) * middle > 0:
        if low == LEAST_STOP_dB and high == most_dB:
            return None
        low, high = max(LEAST_STOP_dB, low - 0.5), min(high + 0.5, most_dB)
    other = high if error(low) * error(high) <= 0 else stop_dB
    return float(brentq(error, low, other, xtol=1e-6))


def _most_attenuation(settings: LowPassSettings, half: int, rate_Hz: float) -> float:
    """Return the largest attenuation, within 20 dB, with which this length can be -3 dB at the
    required frequency."""
    steps = settings.stop_dB + np.arange(0.0, 20.0, 0.1)
    return float(max(dB for dB in steps if _can_fall(settings, half, float(dB), rate_Hz)))


def _shortest(
    settings: LowPassSettings, rate_Hz: float, holds: Callable[[int], bool], asked: str
) -> int:
    """Return the fewest taps on either side of the middle one for which the filter can be -3 dB at
    the required frequency and `holds` is true.

    `holds` must be monotonic: what is true for some number of taps is true for more. `asked` states
    in an error what it asks for, followed by " with "; it is empty if `holds` asks for nothing.
    """

    def able(half: int) -> bool:
        return _can_fall(settings, half, settings.stop_dB, rate_Hz) and holds(half)

    high = 1
    while not able(high):
        high *= 2
        if 2 * high + 1 > MOST_TAPS:
            raise ValueError(
                f"{asked}half_power_Hz {settings.half_power_Hz:g} Hz and stop_dB "
                f"{settings.stop_dB:g} dB would need more than {MOST_TAPS} taps at {rate_Hz:g} Hz: "
                "the gain would have to fall too steeply. Widen the transition or sample slower"
            )
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if able(middle) else (middle, high)
    return high


def _can_fall(settings: LowPassSettings, half: int, stop_dB: float, rate_Hz: float) -> bool:
    """Return whether a filter of this length can be -3 dB at the required frequency."""
    window = np.kaiser(2 * half + 1, kaiser_shape(stop_dB))
    at = frequency_response(window / window.sum(), settings.half_power_Hz, rate_Hz)
    return bool(abs(at[0]) < 10 ** (HALF_POWER_dB / 20))


def _prototype(settings: LowPassSettings, half: int, stop_dB: float, rate_Hz: float) -> Reals:
    """Return linear-phase taps (2 half + 1,) with gain 1 at 0 Hz and -3 dB where the settings ask
    for it."""
    from scipy.optimize import brentq

    place = np.arange(-half, half + 1)
    window = np.kaiser(place.size, kaiser_shape(stop_dB))
    phase = np.cos(2 * np.pi * settings.half_power_Hz / rate_Hz * place)
    wanted = 10 ** (HALF_POWER_dB / 20)

    def taps_of(cut_off_Hz: float) -> Reals:
        taps = np.sinc(2 * cut_off_Hz / rate_Hz * place) * window
        unit_gain: Reals = taps / taps.sum()
        return unit_gain

    def error(cut_off_Hz: float) -> float:
        return float(taps_of(cut_off_Hz) @ phase) - wanted

    return taps_of(float(brentq(error, 0.0, rate_Hz / 2, xtol=1e-9 * rate_Hz)))


def _lag_deg(taps: Reals, frequency_Hz: float, rate_Hz: float) -> float:
    """Return the phase lag in degrees, which may exceed 180: the phase is followed from 0 Hz on."""
    points = 8 * taps.size  # minimum phase turns by at most a sixteenth from point to point
    below = np.fft.rfft(taps, points)[: int(points * frequency_Hz / rate_Hz) + 1]
    here = frequency_response(taps, frequency_Hz, rate_Hz)
    followed = np.unwrap(np.angle(np.concatenate([below, here])))
    return -math.degrees(followed[-1])
