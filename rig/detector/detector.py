"""The incipient-slip detector: rows of v_1 and v_2 in, events out. Live trials and files use the
same code."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.cache import place_numba_cache

place_numba_cache(Path(__file__).parent)
from rig.detector import kernel  # noqa: E402 - after numba's cache has its place
from rig.detector.contract import Detector, FASTEST_Hz, SLOWEST_Hz  # noqa: E402
from rig.detector.events import EVENT_KINDS, UNJUDGED, SlipEvent  # noqa: E402
from rig.detector.low_pass import LowPass, design_low_pass  # noqa: E402
from rig.detector.notices import Notice  # noqa: E402
from rig.detector.settings import DetectorSettings, ImpulseSettings, RigSettings  # noqa: E402

Reals = NDArray[np.float64]

DETECTOR_VERSION = "3"
"""Version of the detector. It is raised with every change of the events that the same parameters
find in the same rows."""
NETWORK_RATE_Hz = 1000.0
"""Sampling rate at which the network was trained, in Hz."""
MAINS_Hz = (50.0, 60.0)
"""Mains frequencies at which hum is looked for."""
_SLICE = 4096
_MOST_A_ROW = 8
_LOGICS = {
    "rig": kernel.RIG,
    "paper-literal": kernel.LITERAL,
    "paper-hp": kernel.HIGH_PASSED,
    "impulse": kernel.IMPULSE,
}
BRAKES_BELOW = 0.5
"""x brakes where its commanded speed along its way falls below this share of what it was."""


@dataclass(frozen=True)
class NetworkInputs:
    """Inputs of the network at the rows at which it was evaluated."""

    rows: NDArray[np.int64]
    """Rows at which it was evaluated, (m,)."""
    inputs: Reals
    """Inputs (m, inputs), in the order of `kernel.INPUTS`."""


class IncipientSlipDetector(Detector):
    """The detectors of this project: which one it is, its settings say.

    The events depend on the rows alone, to the last bit, and not on how they were cut into blocks.

    >>> from rig.detector.settings import named_detectors
    >>> detector = IncipientSlipDetector(named_detectors()["paper-hp"], rate_Hz=1000.0)
    >>> detector.add(np.zeros((600, 2)))  # quiet: offset and noise are measured
    []
    >>> detector.rows
    600
    """

    Settings = DetectorSettings
    version: ClassVar[str] = DETECTOR_VERSION
    settings: DetectorSettings

    def __init__(self, settings: DetectorSettings, rate_Hz: float):
        """Raise ValueError for a rate, or a network, with which these settings cannot be used."""
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
        known = (
            kernel.INPUTS, kernel.CHARGED_INPUTS, kernel.ADAPTED_INPUTS, kernel.FIXED_INPUTS
        )  # fmt: skip
        if settings.network is not None and settings.network.inputs not in known:
            raise ValueError(
                f"network {settings.network.name!r} needs other inputs than this program's "
                f"detector {DETECTOR_VERSION} offers: train it again, or take the one it brings"
            )
        super().__init__(settings, rate_Hz)
        self.saturation_V = settings.saturation_V
        self._low_pass = design_low_pass(settings.low_pass, rate_Hz)
        self._kernel = _KernelArrays(settings, rate_Hz, self._low_pass)
        self._braking_rows = self._turning_rows = 0
        if isinstance(settings, ImpulseSettings):
            self._braking_rows = round(settings.braking_s * rate_Hz)
        elif isinstance(settings, RigSettings):
            self._turning_rows = round((settings.turn_s or 0.0) * rate_Hz)
        self._knows_forces = (
            settings.network is not None and settings.network.inputs == kernel.INPUTS
        )
        self._shown: list[NetworkInputs] | None = None
        """Inputs of the network so far, while `network_inputs` collects them."""
        self._state, self._touch_before = np.zeros(1, kernel.STATE), False
        self._x_moved_mm_s = 0.0
        """Speed of the latest commanded move of x; a gap in the rows is none in the commands."""
        self.reset()

    @property
    def low_pass(self) -> LowPass:
        """The low-pass filter that extracts the predictive signal."""
        return self._low_pass

    @property
    def touch_seen(self) -> bool:
        """True once v_d or v_s has passed the threshold of a touch, in any row so far."""
        state = self._state[0]
        touch = state["stage"] != kernel.NO_TOUCH or state["touched"] or np.any(state["touch"])
        return self._touch_before or bool(touch)

    def reset(self) -> None:
        """Forget all rows but that a touch was seen: offset and noise are measured again."""
        self._touch_before = self.touch_seen
        self._first = self.rows
        self._state = np.zeros(1, kernel.STATE)
        self._x_before_force: float | None = None

    def judge(self, volts: Reals) -> list[SlipEvent]:
        """Return the events decided in further rows (n, 2) of v_1 and v_2 in V."""
        events: list[SlipEvent] = []
        for begin in range(0, len(volts), _SLICE):
            first, rows = int(self._state["row"][0]), volts[begin : begin + _SLICE]
            events += [self._event(row) for row in self._kernel.advance(rows, self._state)]
            if self._shown is not None:
                at = np.flatnonzero(self._kernel.looked)
                self._shown.append(NetworkInputs(first + at, self._kernel.seen[at]))
        return events

    def commanded(self, before_mm_s: float, after_mm_s: float) -> None:
        """Note what x is commanded to do, for the logics ``impulse`` and ``rig``."""
        turns = False
        if abs(after_mm_s) >= kernel.LEAST_SPEED_mm_s:  # slower ones keep a weight at rest
            turns = after_mm_s * self._x_moved_mm_s < 0
            self._x_moved_mm_s = after_mm_s
        if self._knows_forces and not self._state["force_known"]:
            # Files from before decision 0123 have the moves of x alone, with which a network of
            # `kernel.INPUTS` was not taught: for it, the commands are known once both are.
            self._x_before_force = after_mm_s
            return
        self._state["x_known"], self._state["x_speed"] = 1, after_mm_s
        if turns:
            self._state["turning_until"] = self._state["row"] + self._turning_rows
        if after_mm_s and before_mm_s * after_mm_s <= 0:
            self._state["x_started"] = 1.0
        if before_mm_s * after_mm_s < BRAKES_BELOW * before_mm_s**2:
            self._state["braking_rows"] = self._braking_rows
            self._state["x_braked"] = 1.0

    def commanded_force(self, before_N: float | None, after_N: float) -> None:
        """Note which normal force z is commanded to hold, for a network of `kernel.INPUTS`."""
        state = self._state
        if not state["force_known"]:
            state["force_known"], state["force_share"] = 1, 1.0
            if self._x_before_force is not None:
                state["x_known"], state["x_speed"] = 1, self._x_before_force
            return
        change = after_N / before_N - 1 if before_N else 0.0
        state["force_share"] *= 1 + change
        state["force_changes"] += change

    def cut_off(self, now: bool) -> None:
        """Note whether the DAQ cuts a strip off: nothing is judged until 50 ms after it has."""
        self._state["is_cut_off"] = now

    def end(self) -> list[SlipEvent]:
        """Return one event if the rows were too few to measure offset and noise, or there never
        was a quiet piece for it and that has not been reported yet."""
        state = self._state[0]
        if state["ready"] or state["unjudged"] or not state["row"]:
            return []
        unjudged = {UNJUDGED: 1e3 * int(state["row"]) / self.rate_Hz}
        reason = kernel.REASONS[kernel.NOT_QUIET]
        constants = self._kernel.constants
        needed = int(constants["warm_up_rows" if constants["adapts"] else "quiet_rows"][0])
        if state["row"] < needed:
            reason = f"too short: offset and noise need {needed / self.rate_Hz:.3g} s"
        return [self.event("cannot judge", -1, 0.0, reason, unjudged)]

    def network_inputs(self, volts: ArrayLike, notices: Iterable[Notice] = ()) -> NetworkInputs:
        """Return the inputs of the network over a whole recording (n, 2) in V with these notices,
        for training."""
        shown: list[NetworkInputs] = []
        self._shown = shown
        with self._kernel.showing_inputs():
            for one in notices:
                self.notice(one)
            self.add(volts)
        self._shown = None
        none = NetworkInputs(np.zeros(0, np.int64), np.zeros((0, self._kernel.inputs)))
        return NetworkInputs(
            np.concatenate([one.rows for one in (none, *shown)]),
            np.concatenate([one.inputs for one in (none, *shown)]),
        )

    def _event(self, row: Reals) -> SlipEvent:
        kind, sample = int(row[0]), self._first + int(row[1])
        features = dict(zip(kernel.EVENT_FEATURES, row[4:-1].tolist(), strict=True))
        if kind in (kernel.CANNOT_JUDGE, kernel.JUDGES_AGAIN):
            features[UNJUDGED] = 1e3 * float(row[-1]) / self.rate_Hz
        return SlipEvent(
            kind=EVENT_KINDS[kind],
            sample=sample,
            time_s=sample / self.rate_Hz,
            confidence=float(row[2]),
            reason=kernel.REASONS[int(row[3])],
            features=features,
        )


class _KernelArrays:
    """The arrays that the compiled kernel is called with, in addition to the rows and the state:
    filters, weights, settings in rows and mV, and room to work in."""

    def __init__(self, settings: DetectorSettings, rate_Hz: float, low_pass: LowPass):
        self.constants = _constants(settings, rate_Hz, low_pass)
        self._taps, self._sections = low_pass.taps, _high_pass(settings.impulse_Hz, rate_Hz)
        self.inputs = len(kernel.INPUTS if settings.network is None else settings.network.inputs)
        """Number of inputs of the network."""
        if settings.network is None:
            self._hidden, self._output = np.zeros((self.inputs + 1, 0)), np.zeros((2, 1))
        else:
            self._hidden, self._output = settings.network.weights()
        self._units = np.zeros(self._hidden.shape[1])
        self._line = np.zeros(low_pass.taps.size)
        self._piece = np.zeros((4, int(self.constants["quiet_rows"][0])))
        self._room = np.zeros(self._piece.shape[1])
        self._events = np.zeros((_MOST_A_ROW * _SLICE, kernel.EVENT_COLUMNS))
        self.seen, self.looked = np.zeros((1, self.inputs)), np.zeros(0, np.bool_)
        """Inputs of the network at each of the latest rows, and whether it was evaluated there; no
        rows but within `showing_inputs`."""

    @contextlib.contextmanager
    def showing_inputs(self) -> Iterator[None]:
        """Have `seen` and `looked` filled within the block."""
        nothing = self.seen, self.looked
        self.seen, self.looked = np.zeros((_SLICE, self.inputs)), np.zeros(_SLICE, np.bool_)
        try:
            yield
        finally:
            self.seen, self.looked = nothing

    def advance(self, rows: Reals, state: NDArray[np.void]) -> Reals:
        """Take in further rows, `_SLICE` at most; return the events that were decided in them, one
        a row, which the next call overwrites."""
        self.looked[:] = False
        count = kernel.advance(
            rows, state, self._line, self._piece, self._room, self.constants, self._taps,
            self._sections, self._hidden, self._output, self._units, self._events, self.seen,
            self.looked,
        )  # fmt: skip
        return self._events[: int(count)]


def _constants(settings: DetectorSettings, rate_Hz: float, low_pass: LowPass) -> NDArray[np.void]:
    """Convert the settings to rows and mV, as the kernel needs them."""
    ms = rate_Hz / 1e3
    c = np.zeros(1, kernel.CONSTANTS)
    c["logic"] = _LOGICS[settings.logic]
    c["adapts"] = settings.logic == "impulse" or (
        settings.network is not None and settings.network.inputs != kernel.FIXED_INPUTS
    )
    c["ms"] = ms
    c["least_unit"], c["touch_exponent"] = kernel.LEAST_UNIT, 1.0
    if isinstance(settings, ImpulseSettings):
        c["least_unit"] = kernel.LEAST_UNIT_OF_IMPULSE
        c["touch_exponent"], c["braking_share"] = settings.touch_exponent, settings.braking_share
    c["quiet_rows"] = round(settings.quiet_s * rate_Hz)
    c["least_noise"] = settings.least_noise_mV
    c["low_noise"] = math.sqrt(float(np.sum(low_pass.taps**2)))
    c["arm"] = settings.arm_mV, settings.arm_sigmas
    c["armed_rows"] = round(settings.armed_s * rate_Hz)
    c["fire"] = settings.fire_mV, settings.fire_sigmas
    c["look"] = settings.look_mV, settings.look_sigmas
    c["look_rows"] = round(kernel.LOOK_ms * ms)
    idle_ms = kernel.ADAPTIVE_IDLE_ms if c["adapts"][0] else kernel.IDLE_ms
    c["idle_rows"] = max(1, round(idle_ms * ms))
    c["fire_probability"] = settings.fire_probability
    again_ms = kernel.LEAST_SILENCE_ms
    if isinstance(settings, RigSettings):
        if settings.fire_probability_with_x is not None:
            c["fire_probability"][0, 1] = settings.fire_probability_with_x
        c["first_probability"] = settings.first_probability or 0.0
        c["turn_probability"] = settings.turn_probability or 0.0
        c["over_probability"] = settings.over_probability or 0.0
        if settings.again_s is not None:
            again_ms = 1e3 * settings.again_s
    c["roll_probability"] = settings.roll_probability
    c["silent_rows"] = round(settings.silence_s * rate_Hz)
    c["least_silent_rows"] = round(again_ms * ms)
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
    c["background_share"] = 1 / (np.array(kernel.BACKGROUND_ms) * ms)
    c["charge_keeps"] = 1 - 1 / (kernel.CHARGE_ms * ms)
    c["long_keeps"] = 1 - 1 / (np.array(kernel.LONG_PEAKS_ms) * ms)
    c["command_keeps"] = 1 - 1 / (np.array(kernel.COMMAND_ms) * ms)
    c["force_keeps"] = 1 - 1 / (np.array(kernel.FORCE_ms) * ms)
    c["drift_share"] = 1 / (np.array(kernel.DRIFT_ms) * ms)
    c["warm_up_rows"] = min(round(kernel.WARM_UP_ms * ms), int(c["quiet_rows"][0]) // 4)
    c["rolling_rows"] = round(kernel.ROLLING_ms * ms)
    c["share"] = -np.expm1(-1 / (np.array(kernel.AVERAGES_ms) * ms))
    return c


@lru_cache(maxsize=32)
def _high_pass(corner_Hz: float, rate_Hz: float) -> Reals:
    """Return the second-order sections of a Butterworth high-pass filter of order 3."""
    # Imported here because scipy.signal takes 0.6 s to import, which every trial would pay.
    from scipy.signal import butter

    sections: Reals = np.ascontiguousarray(
        butter(3, corner_Hz, "highpass", fs=rate_Hz, output="sos")
    )
    return sections
