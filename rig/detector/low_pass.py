"""The low-pass that shows the predictive signal, designed from its specification (paper 4.3).

A filter is asked for by its -3 dB frequency, by how far down its stop band lies, and by one of two:
its phase lag at a low frequency (the paper gives 9 degrees at 1 Hz), or where the stop band begins.
The answer is a minimum-phase filter of finite length from a Kaiser prototype: of all causal filters
of its magnitude it lags least. That least lag follows from the magnitude alone (Bode's integral),
so a specification that asks for less is refused with the bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from rig.core.settings import Settings
from rig.detector.fir import frequency_response, kaiser_shape, minimum_phase

Reals = NDArray[np.float64]

HALF_POWER_dB = -3.0
MOST_TAPS = 20_001


class LowPassSettings(Settings):
    """What a low-pass has to do; the defaults are the paper's (4.3, Figure 14)."""

    half_power_Hz: float = Field(28.0, gt=0)
    """Where its gain is -3 dB."""
    stop_dB: float = Field(73.5, ge=21, le=150)
    """Attenuation of the stop band (assumed: the paper's figure is missing)."""
    lag_deg: float | None = Field(9.0, gt=0)
    """Phase lag at `lag_Hz`; none where `stop_Hz` is given."""
    lag_Hz: float = Field(1.0, gt=0)
    """Where the lag is stated."""
    stop_Hz: float | None = Field(None, gt=0)
    """Where the stop band begins; none where the lag is given."""

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
"""The paper's, and two that answer sooner and attenuate less."""


@dataclass(frozen=True)
class LowPass:
    """A designed filter and what it does."""

    settings: LowPassSettings
    rate_Hz: float
    taps: Reals
    """(n,), newest sample first; gain 1 at 0 Hz."""

    def response(self, frequency_Hz: ArrayLike) -> NDArray[np.complex128]:
        """Complex gain at frequencies (k,): (k,)."""
        return frequency_response(self.taps, frequency_Hz, self.rate_Hz)

    def level(self, frequency_Hz: ArrayLike) -> Reals:
        """Gain in dB at frequencies (k,): (k,)."""
        gain: Reals = 20 * np.log10(np.maximum(np.abs(self.response(frequency_Hz)), 1e-12))
        return gain

    def lag_deg(self, frequency_Hz: float) -> float:
        """Phase lag at a frequency that the filter passes."""
        return _lag_deg(self.response(frequency_Hz))

    def group_delay_s(self, frequency_Hz: ArrayLike) -> Reals:
        """Group delay at frequencies (k,): (k,)."""
        place = np.arange(self.taps.size)
        weighted = frequency_response(self.taps * place, frequency_Hz, self.rate_Hz)
        delay: Reals = np.real(weighted / self.response(frequency_Hz)) / self.rate_Hz
        return delay

    def step_response(self) -> Reals:
        """Answer to a unit step, from its first sample on, (n,)."""
        answer: Reals = np.cumsum(self.taps)
        return answer


@lru_cache(maxsize=32)
def design_low_pass(settings: LowPassSettings, rate_Hz: float) -> LowPass:
    """The filter of a specification at a sampling rate.

    Raises ValueError, with the bound, where no filter or none of this family can meet it.
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
    """The least lag at `lag_Hz` of any causal filter of that shape.

    Bode's integral on the unit circle, for the magnitude that lags least among those that never
    amplify: 0 dB to `half_power_Hz`, 3 dB down to `stop_Hz`, `stop_dB` down beyond.
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
    """The shortest linear-phase prototype whose stop band begins there."""
    if stop_Hz >= rate_Hz / 2:
        raise ValueError(
            f"stop_Hz {stop_Hz:g} Hz must be below half the sampling rate of {rate_Hz:g} Hz"
        )
    stop_band = np.linspace(stop_Hz, rate_Hz / 2, 1024)

    def attenuates(half: int) -> bool:
        taps = _prototype(settings, half, settings.stop_dB, rate_Hz)
        largest = np.abs(frequency_response(taps, stop_band, rate_Hz)).max()
        return bool(largest <= 10 ** (-settings.stop_dB / 20))

    half = _shortest(settings, rate_Hz, attenuates, f"stop_Hz {stop_Hz:g} Hz")
    return _prototype(settings, half, settings.stop_dB, rate_Hz)


def _with_lag(settings: LowPassSettings, lag_deg: float, rate_Hz: float) -> Reals:
    """Linear-phase prototype whose minimum-phase form lags by just so much.

    The length is chosen to the nearest tap and the attenuation gives the rest.
    """
    from scipy.optimize import brentq

    def lag_of(half: int, stop_dB: float) -> float:
        taps = minimum_phase(_prototype(settings, half, stop_dB, rate_Hz))
        return _lag_deg(frequency_response(taps, settings.lag_Hz, rate_Hz))

    shortest = _shortest(settings, rate_Hz, lambda half: True, "half_power_Hz")
    least = lag_of(shortest, settings.stop_dB)
    if lag_deg < least:
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
    half = _shortest(
        settings,
        rate_Hz,
        lambda n: lag_of(n, settings.stop_dB) >= lag_deg,
        f"lag_deg {lag_deg:g} deg",
    )

    def error(stop_dB: float) -> float:
        return lag_of(half, stop_dB) - lag_deg

    low, high = settings.stop_dB - 0.1, settings.stop_dB + 0.1
    while error(low) * error(high) > 0:
        low, high = max(21.0, low - 0.5), high + 0.5
    return _prototype(settings, half, float(brentq(error, low, high, xtol=1e-6)), rate_Hz)


def _shortest(
    settings: LowPassSettings, rate_Hz: float, holds: Callable[[int], bool], asked: str
) -> int:
    """The fewest taps on either side of the middle one that can be -3 dB where they have to be, and
    for which `holds`; what holds for some taps holds for more."""

    def able(half: int) -> bool:
        window = np.kaiser(2 * half + 1, kaiser_shape(settings.stop_dB))
        at = frequency_response(window / window.sum(), settings.half_power_Hz, rate_Hz)
        return bool(abs(at[0]) < 10 ** (HALF_POWER_dB / 20)) and holds(half)

    high = 1
    while not able(high):
        high *= 2
        if 2 * high + 1 > MOST_TAPS:
            raise ValueError(
                f"{asked} with half_power_Hz {settings.half_power_Hz:g} Hz and stop_dB "
                f"{settings.stop_dB:g} dB would need more than {MOST_TAPS} taps at {rate_Hz:g} Hz: "
                "the gain would have to fall too steeply. Widen the transition or sample slower"
            )
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if able(middle) else (middle, high)
    return high


def _prototype(settings: LowPassSettings, half: int, stop_dB: float, rate_Hz: float) -> Reals:
    """Linear-phase taps (2 half + 1,) of gain 1 at 0 Hz and -3 dB where the settings want it."""
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


def _lag_deg(response: NDArray[np.complex128]) -> float:
    turned = complex(response[0])
    return -math.degrees(math.atan2(turned.imag, turned.real))
