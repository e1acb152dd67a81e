"""Read sensors as scales: one steady reading under a known weight, or the reason for its rejection.

A reading is the mean of some seconds after some settling. A reading of a saturated, drifting or
dead sensor is rejected, and the caller may try again. Nothing is driven; an interrupted reading
only has its stream stopped.
"""

from __future__ import annotations

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
from rig.run.streams.frame_faults import unknown_force
from rig.run.streams.stream_reader import StreamReader

FORCE_STREAM = "force_sensor"
LATE_FRAMES_S = 1.0
"""Longest wait in s for overdue frames."""
LOOK_EVERY_S = 0.02
DRIFT_FRACTION = 1e-3
"""Largest change from beginning to end of a reading, as a fraction of the largest weight."""
CELL_RATE_S_S = 10e3
"""Sampling rate of the DAQ in a reading of the load cell."""


class RejectedError(RigError):
    """Raised for a reading that is rejected: saturated, drifting or dead."""

    code = ExitCode.INSTRUMENT


@dataclass(frozen=True)
class Timing:
    """Times to settle and to measure in s. A multiple of 0.1 s contains whole cycles of 50 and 60
    Hz mains."""

    settling_s: float
    duration_s: float


class Scale(Protocol):
    """A sensor that can be read under a weight."""

    def read(self, largest_N: float) -> Mean:
        """Return a steady reading. Raises RejectedError for any other."""
        ...

    def in_words(self, mean: Mean) -> str:
        """Return a reading in words."""
        ...


class ForceScale:
    """The force sensor as a scale, read from its amplifier's stream in mV/V."""

    def __init__(self, sensor: ForceSensor, clock: Clock, timing: Timing, rate_S_s: float):
        self._sensor, self._clock, self._timing, self._rate = sensor, clock, timing, rate_S_s

    def read(self, largest_N: float) -> Mean:
        """Return the mean of the frames after settling, (3,) in mV/V.

        Raises RejectedError if frames are saturated, a channel is dead, or the force has not
        settled.
        """
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
                "check that its bridge is connected",
            )
        self._require_steady(mean_of(force[kept]), largest_N)
        return mean_of(raw[kept])

    def in_words(self, mean: Mean) -> str:
        """Return the reading along x, y, z in words."""
        return "  ".join(
            f"{axis} {with_error(value, error)}"
            for axis, value, error in zip("xyz", mean.value, mean.standard_error, strict=True)
        ) + " mV/V"  # fmt: skip

    def _frames(self) -> list[ForceFrames]:
        """Return, in batches, all frames of a stream that lasts for settling and reading."""
        source = FrameCollector(self._sensor)
        reader = StreamReader("force reader", source)
        unfollow = self._clock.follow_stream(FORCE_STREAM, reader)
        try:
            self._rate = self._sensor.start(self._rate)
            reader.start()
            length_s = self._timing.settling_s + self._timing.duration_s
            needed = round(length_s * self._rate)
            self._clock.sleep(length_s)
            give_up = self._clock.now() + LATE_FRAMES_S
            while (got := sum(map(len, source.batches))) < needed:
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
            return source.batches
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
    """The load cell as a scale, read from its DAQ channel in volts."""

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
        """Return the mean after settling, (1,) in volts; its error includes the converter's
        step.

        Raises RejectedError if samples are clipped or the output has not settled.
        """
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

    def in_words(self, mean: Mean) -> str:
        """Return the reading in words, in volts."""
        return with_error(float(mean.value[0]), float(mean.standard_error[0])) + " V"


class FrameCollector:
    """A force sensor as the source of a reader, with all the frames that it has sent."""

    def __init__(self, sensor: ForceSensor):
        self._sensor = sensor
        self.batches: list[ForceFrames] = []
        """What has come so far, oldest first; the reader's thread appends to it."""

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the sensor's link."""
        return self._sensor.bytes_consumed

    def read(self) -> None:
        """Collect the frames that have arrived. Raises InstrumentError for a force that is not a
        finite number."""
        frames = self._sensor.read()
        if frames is None:
            return
        if (unknown := unknown_force(frames)) is not None:
            raise InstrumentError("force_sensor", "stream", unknown.cause, unknown.hint)
        self.batches.append(frames)


def _drifted(what: str, trend_N: float, timing: Timing) -> str:
    return f"{what} changed by {trend_N:+.3g} N within the reading of {timing.duration_s:g} s"
