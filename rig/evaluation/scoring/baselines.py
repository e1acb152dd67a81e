"""Plain detectors to compare with: band power, wavelet, CUSUM of the variance, one channel alone.

Each turns a recording that begins with quiet into a score a sample, causally. It alarms where the
score exceeds a threshold while the paper's predictive signal has armed it (4.3). Scores are
multiples of the noise while nothing touches, which is never taken to be less than a floor: relative
thresholds alone fail where there is hardly any noise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.resources import files
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from rig.core.settings import Settings
from rig.detector.low_pass import LowPassSettings, design_low_pass
from rig.evaluation.scoring.outcomes import DetectorReport
from rig.evaluation.scoring.seeds import SeedRange

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

Statistic = Literal["band power", "wavelet", "cusum", "single channel"]
STATISTICS: tuple[Statistic, ...] = get_args(Statistic)

HIGH_PASS_Hz = 100.0
"""-3 dB frequency of the Butterworth high-pass, third order, where a statistic has one."""
BAND_POWER_S = 0.016
"""Length of the window of the band power."""
CUSUM_RATIO = 9.0
"""Variance that the CUSUM waits for, as a multiple of that of the noise (assumed)."""
DB4 = (
    0.230377813308855,
    0.714846570552542,
    0.630880767929590,
    -0.027983769416984,
    -0.187034811718881,
    0.030841381835987,
    0.032883011666983,
    -0.010597401784997,
)
"""Scaling filter of Daubechies' wavelet with four vanishing moments (Daubechies 1992, Ten Lectures
on Wavelets, table 6.1)."""
SETTLING_S = 0.05
"""After the first sample no filter's output is taken for noise."""
FILE = "baselines.json"


class BaselineSettings(Settings):
    """A baseline with its thresholds; written by ``rig score --tune``."""

    statistic: Statistic
    threshold: float = Field(gt=0)
    """A score above this alarms."""
    floor_mV: float = Field(gt=0)
    """Noise of the statistic's signal is never taken to be less."""
    tuned_on: SeedRange | None = None
    """Seeds of the trials that threshold and floor were chosen on."""
    low_pass: LowPassSettings = LowPassSettings()
    """Shows the predictive signal."""
    arm_mV: float = Field(0.4, gt=0)
    """The predictive signal arms beyond this ..."""
    arm_sigmas: float = Field(5.0, gt=0)
    """... and beyond so many standard deviations of its own noise."""
    armed_s: float = Field(0.15, gt=0)
    """How long it stays armed after the predictive signal was last beyond half its threshold."""
    silence_s: float = Field(0.15, gt=0)
    """After an alarm there is none for so long."""
    quiet_s: float = Field(0.25, gt=0)
    """The recording's beginning, in which nothing touches: noise is judged there."""


class Baselines(Settings):
    """All of them."""

    baselines: tuple[BaselineSettings, ...]


def tuned_baselines() -> Baselines:
    """The baselines as they were tuned on the simulated trials whose seeds they name."""
    return Baselines.model_validate_json(files(__package__).joinpath(FILE).read_bytes())


def baseline_score(volts: ArrayLike, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """The score of each row of `volts` (n, 2): (n,), 0 in the quiet and where nothing armed.

    Raises ValueError for a recording that is not longer than its quiet.
    """
    signal = _signal(volts, rate_Hz, settings)
    values = _STATISTICS[settings.statistic](signal, rate_Hz, settings)
    return _score(values, _armed(signal, rate_Hz, settings), settings)


def baseline_reports(
    volts: ArrayLike, rate_Hz: float, settings: BaselineSettings, factors: ArrayLike = (1.0,)
) -> list[DetectorReport]:
    """Alarms and armings in `volts` (n, 2), once for each factor on the threshold."""
    signal = _signal(volts, rate_Hz, settings)
    armed = _armed(signal, rate_Hz, settings)
    values = _STATISTICS[settings.statistic](signal, rate_Hz, settings)
    score = _score(values, armed, settings)
    arms = np.flatnonzero(armed & ~np.concatenate([[False], armed[:-1]]))
    silent = max(1, round(settings.silence_s * rate_Hz))
    row = np.arange(signal.size)
    said = []
    for factor in np.atleast_1d(np.asarray(factors, dtype=np.float64)):
        alarms: list[int] = []
        left, begin = score, 0
        while (over := left[begin:] > factor * settings.threshold).any():
            alarms.append(begin + int(over.argmax()))
            begin = alarms[-1] + silent
            if settings.statistic == "cusum":
                left = _score(values, armed & (row >= begin), settings)
        said.append(DetectorReport(np.array(alarms, dtype=np.float64) / rate_Hz, arms / rate_Hz))
    return said


def _signal(volts: ArrayLike, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """v_d, or v_1 where no second channel is used, in mV without its offset, (n,)."""
    given = np.asarray(volts, dtype=np.float64)
    quiet = round(settings.quiet_s * rate_Hz)
    if given.ndim != 2 or given.shape[1] != 2 or len(given) <= quiet:
        raise ValueError(
            f"volts of shape {given.shape} must be (n, 2) with n above {quiet}: noise is judged in "
            f"the first {settings.quiet_s:g} s"
        )
    single = settings.statistic == "single channel"
    signal = given[:, 0] if single else given[:, 0] - given[:, 1]
    without: Floats = 1e3 * (signal - signal[:quiet].mean())
    return without


def _armed(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Flags:
    """Where the predictive signal has armed, (n,)."""
    taps = design_low_pass(settings.low_pass, rate_Hz).taps
    predictive = np.abs(np.convolve(signal, taps)[: signal.size])
    quiet = round(settings.quiet_s * rate_Hz)
    noise = float(signal[:quiet].std() * np.sqrt(np.sum(taps**2)))
    threshold = max(settings.arm_mV, settings.arm_sigmas * noise)
    row = np.arange(signal.size)
    begins = np.where((predictive > threshold) & (row >= quiet), row, -1)
    latest = np.maximum.accumulate(np.where(predictive > threshold / 2, row, -signal.size))
    alive = row - latest <= round(settings.armed_s * rate_Hz)
    died = np.maximum.accumulate(np.where(alive, -1, row))
    armed: Flags = alive & (np.maximum.accumulate(begins) > died)
    return armed


def _score(values: Floats, armed: Flags, settings: BaselineSettings) -> Floats:
    """A statistic's values where they are armed; those of the CUSUM summed up since the arming."""
    if settings.statistic != "cusum":
        return np.where(armed, values, 0.0)
    level = np.zeros(values.size)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], armed, [False]]).astype(np.int8)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        summed = np.cumsum(values[begin:end])
        level[begin:end] = summed - np.minimum(np.minimum.accumulate(summed), 0.0)
    return level


def _high_passed(signal: Floats, rate_Hz: float) -> Floats:
    from scipy.signal import sosfilt

    passed: Floats = sosfilt(_sections(rate_Hz), signal)
    return passed


@lru_cache(maxsize=8)
def _sections(rate_Hz: float) -> Floats:
    from scipy.signal import butter

    sections: Floats = butter(3, HIGH_PASS_Hz, "highpass", fs=rate_Hz, output="sos")
    return sections


def _noise(filtered: Floats, rate_Hz: float, settings: BaselineSettings) -> float:
    """The rms of a filtered signal while nothing touches, the floor at least, in mV."""
    quiet = slice(round(SETTLING_S * rate_Hz), round(settings.quiet_s * rate_Hz))
    return max(settings.floor_mV, float(np.sqrt(np.mean(filtered[quiet] ** 2))))


def _band_power(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """The rms of 16 ms of the high-passed signal."""
    passed = _high_passed(signal, rate_Hz)
    window = max(1, round(BAND_POWER_S * rate_Hz))
    power = np.convolve(passed**2, np.ones(window) / window)[: signal.size]
    level: Floats = np.sqrt(np.maximum(power, 0)) / _noise(passed, rate_Hz, settings)
    return level


def _wavelet(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """The larger of the two finest details of the undecimated transform, each to its noise."""
    details = wavelet_details(signal)
    levels: Floats = np.max(
        [np.abs(detail) / _noise(detail, rate_Hz, settings) for detail in details], axis=0
    )
    return levels


def wavelet_details(signal: ArrayLike) -> tuple[Floats, Floats]:
    """Causal undecimated db4 details of a signal (n,): its upper half band, and the half below."""
    given = np.asarray(signal, dtype=np.float64)
    low = np.array(DB4[::-1])
    high = np.array(DB4) * np.resize([-1.0, 1.0], len(DB4))
    spread = np.zeros(2 * high.size - 1)
    spread[::2] = high
    first = np.convolve(given, high)[: given.size]
    second = np.convolve(np.convolve(given, low)[: given.size], spread)[: given.size]
    return first, second


def _cusum(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Log-likelihood ratios of a risen variance of the high-passed signal, for Page's cumulative
    sum (Page 1954, Biometrika 41, 100), which begins anew with an arming and after an alarm."""
    passed = _high_passed(signal, rate_Hz)
    power = (passed / _noise(passed, rate_Hz, settings)) ** 2
    ratio: Floats = ((1 - 1 / CUSUM_RATIO) * power - np.log(CUSUM_RATIO)) / 2
    return ratio


def _single_channel(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """The high-passed signal itself; it is v_1's."""
    passed = _high_passed(signal, rate_Hz)
    level: Floats = np.abs(passed) / _noise(passed, rate_Hz, settings)
    return level


_STATISTICS: dict[Statistic, Callable[[Floats, float, BaselineSettings], Floats]] = {
    "band power": _band_power,
    "wavelet": _wavelet,
    "cusum": _cusum,
    "single channel": _single_channel,
}
