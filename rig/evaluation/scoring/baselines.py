"""Plain detectors for comparison: band power, wavelet, CUSUM of the variance, one channel alone.

Each turns a recording that begins with quiet into a causal score per sample. It alarms where the
score exceeds a threshold while the predictive signal of the paper has armed it (4.3). Scores are
multiples of the noise measured while nothing touches. This noise is never taken as less than a
floor, because relative thresholds alone fail where there is hardly any noise.
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
"""Names of the baselines."""
STATISTICS: tuple[Statistic, ...] = get_args(Statistic)

HIGH_PASS_Hz = 100.0
"""-3 dB frequency of the Butterworth high-pass filter, third order, for statistics that have
one."""
BAND_POWER_S = 0.016
"""Window length of the band power."""
CUSUM_RATIO = 9.0
"""Variance that the CUSUM tests for, as a multiple of the variance of the noise (assumed)."""
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
"""Time after the first sample in which the filters settle, so that their output is not used as
noise."""
FILE = "baselines.json"
"""File of the tuned baselines in this package."""


class BaselineSettings(Settings):
    """A baseline with its thresholds, as ``rig score --tune`` writes it."""

    statistic: Statistic
    """Name of the baseline."""
    threshold: float = Field(gt=0)
    """Score above which it alarms."""
    floor_mV: float = Field(gt=0)
    """Lowest noise that is assumed for the signal of the statistic."""
    tuned_on: SeedRange | None = None
    """Seeds of the trials on which threshold and floor were chosen."""
    low_pass: LowPassSettings = LowPassSettings()
    """Low-pass filter that extracts the predictive signal."""
    arm_mV: float = Field(0.4, gt=0)
    """Lowest threshold on the predictive signal for arming; see also `arm_sigmas`."""
    arm_sigmas: float = Field(5.0, gt=0)
    """Threshold for arming in standard deviations of the predictive signal's noise. The signal has
    to exceed `arm_mV` as well."""
    armed_s: float = Field(0.15, gt=0)
    """Time for which it stays armed after the predictive signal was last above half its
    threshold."""
    silence_s: float = Field(0.15, gt=0)
    """Time after an alarm in which there is no other alarm."""
    quiet_s: float = Field(0.25, gt=0)
    """Beginning of the recording, in which nothing touches. The noise is measured there."""


class Baselines(Settings):
    """All baselines, as they are stored in one file."""

    baselines: tuple[BaselineSettings, ...]
    """One entry for each statistic, with the thresholds tuned for it."""


def tuned_baselines() -> Baselines:
    """Return the baselines tuned on the simulated trials whose seeds they state."""
    return Baselines.model_validate_json(files(__package__).joinpath(FILE).read_bytes())


def baseline_score(volts: ArrayLike, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return the score (n,) of each row of `volts` (n, 2): 0 in the quiet beginning and while not
    armed.

    Raises ValueError for a recording that is not longer than its quiet beginning.
    """
    signal = _signal(volts, rate_Hz, settings)
    values = _STATISTICS[settings.statistic](signal, rate_Hz, settings)
    return _score(values, _armed(signal, rate_Hz, settings), settings)


def baseline_reports(
    volts: ArrayLike, rate_Hz: float, settings: BaselineSettings, factors: ArrayLike = (1.0,)
) -> list[DetectorReport]:
    """Return alarms and armings in `volts` (n, 2), one report for each factor on the
    threshold."""
    signal = _signal(volts, rate_Hz, settings)
    armed = _armed(signal, rate_Hz, settings)
    values = _STATISTICS[settings.statistic](signal, rate_Hz, settings)
    score = _score(values, armed, settings)
    arms = np.flatnonzero(armed & ~np.concatenate([[False], armed[:-1]]))
    silent = max(1, round(settings.silence_s * rate_Hz))
    row = np.arange(signal.size)
    reports = []
    for factor in np.atleast_1d(np.asarray(factors, dtype=np.float64)):
        alarms: list[int] = []
        left, begin = score, 0
        while (over := left[begin:] > factor * settings.threshold).any():
            alarms.append(begin + int(over.argmax()))
            begin = alarms[-1] + silent
            if settings.statistic == "cusum":
                # Page's sum restarts after every alarm.
                left = _score(values, armed & (row >= begin), settings)
        reports.append(DetectorReport(np.array(alarms, dtype=np.float64) / rate_Hz, arms / rate_Hz))
    return reports


def _signal(volts: ArrayLike, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return v_d in mV without its offset, (n,), or v_1 if the statistic uses one channel only."""
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
    """Return where the predictive signal has armed, (n,)."""
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
    """Return the values of a statistic while armed; those of the CUSUM summed since it was
    armed."""
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
    """Return the rms of a filtered signal while nothing touches, in mV, at least the floor."""
    quiet = slice(round(SETTLING_S * rate_Hz), round(settings.quiet_s * rate_Hz))
    return max(settings.floor_mV, float(np.sqrt(np.mean(filtered[quiet] ** 2))))


def _band_power(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return the rms of the high-passed signal over 16 ms."""
    passed = _high_passed(signal, rate_Hz)
    window = max(1, round(BAND_POWER_S * rate_Hz))
    power = np.convolve(passed**2, np.ones(window) / window)[: signal.size]
    level: Floats = np.sqrt(np.maximum(power, 0)) / _noise(passed, rate_Hz, settings)
    return level


def _wavelet(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return the larger of the two finest details of the undecimated transform, each relative to
    its noise."""
    details = wavelet_details(signal)
    levels: Floats = np.max(
        [np.abs(detail) / _noise(detail, rate_Hz, settings) for detail in details], axis=0
    )
    return levels


def wavelet_details(signal: ArrayLike) -> tuple[Floats, Floats]:
    """Return two causal, undecimated db4 details of a signal (n,): its upper half band and the
    half below."""
    given = np.asarray(signal, dtype=np.float64)
    low = np.array(DB4[::-1])
    high = np.array(DB4) * np.resize([-1.0, 1.0], len(DB4))
    spread = np.zeros(2 * high.size - 1)
    spread[::2] = high
    first = np.convolve(given, high)[: given.size]
    second = np.convolve(np.convolve(given, low)[: given.size], spread)[: given.size]
    return first, second


def _cusum(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return log-likelihood ratios of an increased variance of the high-passed signal.

    They are summed by Page's cumulative sum (Page 1954, Biometrika 41, 100), which restarts at
    every arming and after every alarm.
    """
    passed = _high_passed(signal, rate_Hz)
    power = (passed / _noise(passed, rate_Hz, settings)) ** 2
    ratio: Floats = ((1 - 1 / CUSUM_RATIO) * power - np.log(CUSUM_RATIO)) / 2
    return ratio


def _single_channel(signal: Floats, rate_Hz: float, settings: BaselineSettings) -> Floats:
    """Return the high-passed signal of v_1 alone."""
    passed = _high_passed(signal, rate_Hz)
    level: Floats = np.abs(passed) / _noise(passed, rate_Hz, settings)
    return level


_STATISTICS: dict[Statistic, Callable[[Floats, float, BaselineSettings], Floats]] = {
    "band power": _band_power,
    "wavelet": _wavelet,
    "cusum": _cusum,
    "single channel": _single_channel,
}
