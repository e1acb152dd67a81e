"""Sensors as scales: one steady reading under a known weight, or the reason why it is none.

A reading is the mean of some seconds after some settling. What is saturated, drifts or is dead does
not count: it is rejected, and the caller may try again. Nothing is driven; a reading that is broken
off leaves nothing behind but a stream that is stopped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rig.analysis.estimate import with_error
from rig.analysis.weighing import Mean, mean_of
from rig.core.clock import Clock
from rig.core.errors import ExitCode, InstrumentError, RigError
from rig.instruments.roles import (
    Acquisition,
    DataAcquisition,
    ForceFrames,
    ForceSensor,
    InputChannel,
)
from rig.run.stream_reader import StreamReader

FORCE_STREAM = "force_sensor"
LATE_FRAMES_S = 1.0
"""How long frames that should have come are waited for."""
LOOK_EVERY_S = 0.02
DRIFT_FRACTION = 1e-3
"""Of the largest weight: what a reading may change by from beginning to end."""
CELL_RATE_S_S = 10e3
"""Of the DAQ's samples in a reading of the load cell."""


class RejectedError(RigError):
    """A reading that must not count: saturated, drifting, dead."""

    code = ExitCode.INSTRUMENT


@dataclass(frozen=True)
class Timing:
    """How long to wait and to measure, s. A multiple of 0.1 s holds whole cycles of 50 and 60 Hz
    mains."""

    settling_s: float
    duration_s: float


class Scale(Protocol):
    """A sensor that can be read under a weight."""

    def read(self, largest_N: float) -> Mean:
        """A steady reading; RejectedError where it is none."""
        ...

    def tell(self, mean: Mean) -> str:
        """A reading in words."""
        ...


class ForceScale:
    """The force sensor: its amplifier's stream in mV/V."""

    def __init__(self, sensor: ForceSensor, clock: Clock, timing: Timing, rate_S_s: float):
        self._sensor, self._clock, self._timing, self._rate = sensor, clock, timing, rate_S_s

    def read(self, largest_N: float) -> Mean:
        """Mean of the frames after settling, mV/V, (3,)."""
        frames = self._frames()
        saturated = sum(int(part.saturated.sum()) for part in frames)
        if saturated:
            raise RejectedError(
                f"{saturated} frames of the force sensor are saturated",
                "take the weight off, or widen the amplifier's input range",
            )
        raw = np.concatenate([part.raw for part in frames])
        force = np.concatenate([part.force_N for part in frames])
        first = round(self._timing.settling_s * self._rate)
        kept = slice(first, first + round(self._timing.duration_s * self._rate))
        dead = [axis for axis, spread in zip("xyz", np.ptp(raw[kept], axis=0), strict=True)
                if not spread]  # fmt: skip
        if dead:
            raise RejectedError(
                f"channel {' and '.join(dead)} of the force sensor gives the same number for "
                f"{self._timing.duration_s:g} s, without any noise",
                "look whether its bridge is connected",
            )
        self._require_steady(mean_of(force[kept]), largest_N)
        return mean_of(raw[kept])

    def tell(self, mean: Mean) -> str:
        """The reading on x, y, z."""
        return "  ".join(
            f"{axis} {with_error(value, error)}"
            for axis, value, error in zip("xyz", mean.value, mean.standard_error, strict=True)
        ) + " mV/V"  # fmt: skip

    def _frames(self) -> list[ForceFrames]:
        """All frames of a stream as long as settling and reading, in batches."""
        reader = StreamReader("force reader", _Frames(self._sensor))
        unfollow = self._clock.follow_stream(FORCE_STREAM, reader)
        try:
            self._rate = self._sensor.start(self._rate)
            reader.start()
            length_s = self._timing.settling_s + self._timing.duration_s
            needed = round(length_s * self._rate)
            self._clock.sleep(length_s)
            give_up = self._clock.now() + LATE_FRAMES_S
            while (got := sum(map(len, reader.latest(needed)))) < needed:
                reader.check()
                if self._clock.now() > give_up:
                    raise InstrumentError(
                        "force_sensor",
                        "stream",
                        f"{got} of {needed} frames arrived",
                        "the amplifier or its link loses frames; check cable and rate",
                    )
                self._clock.sleep(LOOK_EVERY_S)
            reader.check()
            return reader.latest(needed)
        finally:
            reader.stop()
            unfollow()
            self._sensor.stop()

    def _require_steady(self, force: Mean, largest_N: float) -> None:
        drifting = force.drifts(DRIFT_FRACTION * largest_N)
        for axis, drifts, trend in zip("xyz", drifting, force.trend, strict=True):
            if drifts:
                raise RejectedError(
                    _drifted(f"the force along {axis}", trend, self._timing), "let it come to rest"
                )


class CellScale:
    """The load cell: mean volts of its DAQ channel."""

    def __init__(
        self,
        daq: DataAcquisition,
        clock: Clock,
        timing: Timing,
        range_V: float,
        nominal_V_N: float,
    ):
        samples = round(timing.duration_s * CELL_RATE_S_S)
        channel = InputChannel("load_cell", range_V)
        self._acquisition = Acquisition((channel,), CELL_RATE_S_S, samples)
        self._daq, self._clock, self._timing = daq, clock, timing
        self._nominal_V_N = nominal_V_N
        daq.check(self._acquisition)

    def read(self, largest_N: float) -> Mean:
        """Mean volts after settling, (1,), the converter's step in its error."""
        self._clock.sleep(self._timing.settling_s)
        record = self._daq.acquire(self._acquisition)
        if clipped := record.clipped("load_cell"):
            raise RejectedError(
                f"{clipped} of {len(record.counts)} samples of the load cell are at the end of the "
                f"{record.scaling.range_V[0]:g} V range",
                "take the weight off, or start again with a larger --range",
            )
        mean = mean_of(record.volts("load_cell"), record.scaling.volts_per_count[0])
        if mean.drifts(DRIFT_FRACTION * largest_N * self._nominal_V_N)[0]:
            trend_N = float(mean.trend[0]) / self._nominal_V_N
            raise RejectedError(
                _drifted("the load cell's output", trend_N, self._timing), "let it come to rest"
            )
        return mean

    def tell(self, mean: Mean) -> str:
        """The reading in volts."""
        return with_error(float(mean.value[0]), float(mean.standard_error[0])) + " V"


class _Frames:
    """A force sensor as a source of batches of frames."""

    def __init__(self, sensor: ForceSensor):
        self._sensor = sensor

    @property
    def bytes_consumed(self) -> int:
        return self._sensor.bytes_consumed

    def read(self) -> Sequence[ForceFrames]:
        frames = self._sensor.read()
        return () if frames is None else (frames,)


def _drifted(what: str, trend_N: float, timing: Timing) -> str:
    return f"{what} changed by {trend_N:+.3g} N within the reading of {timing.duration_s:g} s"
