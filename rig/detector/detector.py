"""The incipient-slip detector: rows of v_1 and v_2 in, events out. Live trials and files use the
same code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.cache import place_numba_cache

place_numba_cache(Path(__file__).parent)
from rig.detector import kernel  # noqa: E402 - after numba's cache has its place
from rig.detector.events import EVENT_KINDS, SlipEvent  # noqa: E402
from rig.detector.low_pass import LowPass, design_low_pass  # noqa: E402
from rig.detector.settings import DetectorSettings  # noqa: E402

Reals = NDArray[np.float64]

DETECTOR_VERSION = "1"
"""Version of the detector. It is raised with every change of the events that the same parameters
find in the same rows."""
NETWORK_RATE_Hz = 1000.0
"""Sampling rate at which the network was trained, in Hz."""
SLOWEST_Hz, FASTEST_Hz = 500.0, 4000.0
"""Sampling rates that are accepted, in Hz."""
MAINS_Hz = (50.0, 60.0)
"""Mains frequencies at which hum is looked for."""
_SLICE = 4096
_MOST_A_ROW = 6
_LOGICS = {"rig": kernel.RIG, "paper-literal": kernel.LITERAL, "paper-hp": kernel.HIGH_PASSED}


@dataclass(frozen=True)
class NetworkInputs:
    """Inputs of the network at the rows at which it was evaluated."""

    rows: NDArray[np.int64]
    """Rows at which it was evaluated, (m,)."""
    inputs: Reals
    """Inputs (m, inputs), in the order of `kernel.INPUTS`."""


class IncipientSlipDetector:
    """A causal, streaming detector of incipient slip.

    The events depend on the rows alone, to the last bit, and not on how they were cut into blocks.

    >>> from rig.detector.settings import named_detectors
    >>> detector = IncipientSlipDetector(named_detectors()["paper-hp"], rate_Hz=1000.0)
    >>> detector.add(np.zeros((600, 2)))  # quiet: offset and noise are measured
    []
    >>> detector.rows
    600
    """

    def __init__(self, settings: DetectorSettings, rate_Hz: float):
        """Raises ValueError for a rate, or a network, with which these settings cannot be used."""
        if not SLOWEST_Hz <= rate_Hz <= FASTEST_Hz:
            raise ValueError(
                f"rate {rate_Hz:g} Hz must be between {SLOWEST_Hz:g} and {FASTEST_Hz:g} Hz: the "
                "impulse lies between 100 and 400 Hz; decimate a faster recording"
            )
        if settings.logic == "rig" and not math.isclose(rate_Hz, NETWORK_RATE_Hz, rel_tol=1e-3):
            raise ValueError(
                f"rate {rate_Hz:g} Hz must be {NETWORK_RATE_Hz:g} Hz for the detector 'rig', whose "
                "network was trained at it: resample, or take paper-hp or paper-literal"
            )
        if settings.network is not None and settings.network.inputs != kernel.INPUTS:
            raise ValueError(
                f"network {settings.network.name!r} needs other inputs than this program's "
                f"detector {DETECTOR_VERSION} offers: train it again, or take the one it brings"
            )
        self.settings, self.rate_Hz = settings, rate_Hz
        self.low_pass: LowPass = design_low_pass(settings.low_pass, rate_Hz)
        self._constants = _constants(settings, rate_Hz, self.low_pass)
        self._sections = _high_pass(settings.impulse_Hz, rate_Hz)
        if settings.network is None:
            self._hidden, self._output = np.zeros((len(kernel.INPUTS) + 1, 0)), np.zeros((2, 1))
        else:
            self._hidden, self._output = settings.network.weights()
        self._units = np.zeros(self._hidden.shape[1])
        self._line = np.zeros(self.low_pass.taps.size)
        self._piece = np.zeros((4, int(self._constants["quiet_rows"][0])))
        self._room = np.zeros(self._piece.shape[1])
        self._events = np.zeros((_MOST_A_ROW * _SLICE, kernel.EVENT_COLUMNS))
        self._seen = np.zeros((1, len(kernel.INPUTS)))
        self._unseen = np.zeros(0, np.bool_)
        self._first = 0
        self._begin()

    @property
    def rows(self) -> int:
        """Number of rows so far, including those missing in gaps."""
        return self._first + int(self._state["row"][0])

    def add(self, volts: ArrayLike, first_sample: int | None = None) -> list[SlipEvent]:
        """Takes further rows (n, 2) of v_1 and v_2 in V and returns the events found in them.

        `first_sample` is the index of the first of these rows, if it is known. Missing rows are
        reported as a rejected event, and offset and noise are measured anew after them.

        Raises ValueError for rows of another shape, rows that were given before, and values that
        are not finite.
        """
        rows = np.ascontiguousarray(volts, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise ValueError(f"volts of shape {rows.shape} must be (n, 2): v_1 and v_2")
        events = [] if first_sample is None else self._step_over_gap(first_sample)
        for begin in range(0, len(rows), _SLICE):
            part = rows[begin : begin + _SLICE]
            count = self._advance(part, self._seen, self._unseen)
            if count:
                events += [self._event(row) for row in self._events[:count]]
        return events

    def finish(self) -> list[SlipEvent]:
        """Returns the events due at the end of a recording: one if there never was a quiet piece to
        measure offset and noise on."""
        if self._state["ready"][0] or not self._state["row"][0]:
            return []
        reason = kernel.REASONS[kernel.NOT_QUIET]
        return [SlipEvent("rejected", self.rows - 1, (self.rows - 1) / self.rate_Hz, 0.0, reason)]

    def network_inputs(self, volts: ArrayLike) -> NetworkInputs:
        """Returns the inputs of the network over a whole recording (n, 2) in V, for training."""
        rows = np.ascontiguousarray(volts, dtype=np.float64)
        seen, looked = np.zeros((len(rows), len(kernel.INPUTS))), np.zeros(len(rows), np.bool_)
        for begin in range(0, len(rows), _SLICE):
            part = slice(begin, begin + _SLICE)
            self._advance(rows[part], seen[part], looked[part])
        return NetworkInputs(np.flatnonzero(looked), seen[looked])

    def _begin(self) -> None:
        self._state = np.zeros(1, kernel.STATE)

    def _advance(self, rows: Reals, seen: Reals, looked: NDArray[np.bool_]) -> int:
        count = int(
            kernel.advance(
                rows,
                self._state,
                self._line,
                self._piece,
                self._room,
                self._constants,
                self.low_pass.taps,
                self._sections,
                self._hidden,
                self._output,
                self._units,
                self._events,
                seen,
                looked,
            )
        )
        if count < 0:
            self._refuse_not_finite(rows)
        return count

    def _event(self, row: Reals) -> SlipEvent:
        sample = self._first + int(row[1])
        return SlipEvent(
            kind=EVENT_KINDS[int(row[0])],
            sample=sample,
            time_s=sample / self.rate_Hz,
            confidence=float(row[2]),
            reason=kernel.REASONS[int(row[3])],
            features=dict(zip(kernel.EVENT_FEATURES, row[4:].tolist(), strict=True)),
        )

    def _step_over_gap(self, first_sample: int) -> list[SlipEvent]:
        expected = self.rows
        if first_sample == expected:
            return []
        if first_sample < expected:
            raise ValueError(
                f"first_sample {first_sample} must be at least {expected}: rows came twice"
            )
        self._begin()
        self._first = first_sample
        if not expected:
            return []
        reason = f"gap of {first_sample - expected} samples: offset and noise are judged anew"
        return [SlipEvent("rejected", first_sample, first_sample / self.rate_Hz, 0.0, reason)]

    def _refuse_not_finite(self, rows: Reals) -> NoReturn:
        row, channel = np.argwhere(~np.isfinite(rows))[0]
        raise ValueError(
            f"v_{channel + 1} is {rows[row, channel]} V at sample {self.rows + row}: every sample "
            "must be finite; cut the recording there, or repair it"
        )


def _constants(settings: DetectorSettings, rate_Hz: float, low_pass: LowPass) -> NDArray[np.void]:
    """Converts the settings to rows and mV, as the kernel needs them."""
    ms = rate_Hz / 1e3
    c = np.zeros(1, kernel.CONSTANTS)
    c["logic"] = _LOGICS[settings.logic]
    c["ms"] = ms
    c["quiet_rows"] = round(settings.quiet_s * rate_Hz)
    c["least_noise"] = settings.least_noise_mV
    c["low_noise"] = math.sqrt(float(np.sum(low_pass.taps**2)))
    c["arm"] = settings.arm_mV, settings.arm_sigmas
    c["armed_rows"] = round(settings.armed_s * rate_Hz)
    c["fire"] = settings.fire_mV, settings.fire_sigmas
    c["look"] = settings.look_mV, settings.look_sigmas
    c["look_rows"] = round(kernel.LOOK_ms * ms)
    c["idle_rows"] = max(1, round(kernel.IDLE_ms * ms))
    c["fire_probability"] = settings.fire_probability
    c["roll_probability"] = settings.roll_probability
    c["silent_rows"] = round(settings.silence_s * rate_Hz)
    c["saturation"] = 1e3 * settings.saturation_V
    c["dead_rows"] = round(settings.dead_s * rate_Hz)
    c["dead_span"] = settings.dead_mV
    c["hum"] = settings.hum_mV
    c["turn"] = 2 * math.pi * np.array(MAINS_Hz) / rate_Hz
    c["row_ms"] = 1 / ms
    c["peak_keeps"] = 1 - 1 / (np.array(kernel.PEAKS_ms) * ms)
    c["power_share"] = 1 / (np.array(kernel.POWERS_ms) * ms)
    c["sum_keeps"] = 1 - 1 / (np.array(kernel.SUMS_ms) * ms)
    c["slow_keeps"] = 1 - 1 / (kernel.SLOW_PEAK_ms * ms)
    c["share"] = -np.expm1(-1 / (np.array(kernel.AVERAGES_ms) * ms))
    return c


@lru_cache(maxsize=32)
def _high_pass(corner_Hz: float, rate_Hz: float) -> Reals:
    """Returns the second-order sections of a Butterworth high-pass filter of order 3."""
    # Imported here because scipy.signal takes 0.6 s to import, which every trial would pay.
    from scipy.signal import butter

    sections: Reals = np.ascontiguousarray(
        butter(3, corner_Hz, "highpass", fs=rate_Hz, output="sos")
    )
    return sections
