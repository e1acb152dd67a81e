"""The force sensor's reader and its watchers, which act even while the procedure is blocked.

The reader's thread judges every batch of frames as it comes: for a force over the limit, it has the
registered emergency actions run at once. The trip is raised in the procedure's thread at its next
check.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from rig.core.clock import Clock
from rig.core.errors import InstrumentError, RigError, WrongFramesError
from rig.instruments.roles import ForceFrames, ForceSensor, axes_of
from rig.run.holds import Holds
from rig.run.streams.frame_buffer import FrameBuffer
from rig.run.streams.frame_delay import FrameDelay
from rig.run.streams.frame_faults import FrameFault, FrameFaults, unknown_force
from rig.run.streams.stream_reader import StreamReader
from rig.run.trip import TripError

STALE_S = 0.25
"""Time without a frame that starts a hold: the force is not known."""
LOST_S = 5.0
"""Time without a frame, or with missing frames, that ends the run."""
LATE_S = 0.5
"""Time with missing frames that starts a hold: frames that are merely late arrive within it."""


class ForceMonitor:
    """Streams a force sensor, buffers the latest frames, and watches every one of them."""

    def __init__(
        self, sensor: ForceSensor, clock: Clock, holds: Holds, act: Callable[[], list[str]]
    ):
        self._sensor, self._clock, self._holds, self._act = sensor, clock, holds, act
        self.limit_N = float("inf")
        """Limit that `watch` was last called with."""
        self.zero: tuple[float, float, float] | None = None
        """Raw reading without force; None if the sensor has not been zeroed since this stream was
        begun."""
        self.noise_N = np.zeros(3)
        """Standard deviation of a frame's force along x, y, z, in N, at the latest `tare`."""
        self.axes = axes_of(sensor)
        """Axes that the sensor measures. The others are 0 in its frames."""
        self._frames = FrameBuffer()
        self._faults = FrameFaults(getattr(sensor, "axes", ""))
        self._delay = FrameDelay()
        self._trip: RigError | None = None
        """Reason why the reader's thread made the bench safe."""
        self._rate = 0.0
        self._last_frame_s: float | None = None
        """Time of the latest frame; None until the stream has begun."""
        self._newest_s = 0.0
        """Time at which the newest buffered frame would have come without its delay."""
        self._reader = StreamReader("force reader", self, around=clock.in_background)
        self._unfollow: Callable[[], None] = lambda: None

    # --- used by the procedure ----------------------------------------------------------------

    def start(self, rate_S_s: float) -> float:
        """Begin to stream and to watch, without a limit yet. Returns the actual rate in frames/s
        (see the property `rate_S_s`), which may differ from the one asked for."""
        self._unfollow = self._clock.follow_stream("force_sensor", self)
        self._delay.begin(self._clock.now())
        # Noted first: frames may come although the answer to the start command is lost.
        self._reader.start()
        self._rate = self._sensor.start(rate_S_s)
        self._last_frame_s = self._clock.now()
        return self._rate

    @property
    def tared(self) -> bool:
        """True if the sensor has been zeroed since this stream was begun."""
        return self.zero is not None

    @property
    def rate_S_s(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Frames per second, as the sensor reported when the stream was started."""
        return self._rate

    def stop(self) -> None:
        """End the stream and its reader."""
        self._reader.stop()
        self._unfollow()
        self._sensor.stop()

    def watch(self, limit_N: float) -> None:
        """Trip from now on over a force above `limit_N` along any axis."""
        self._faults.limit_N = self.limit_N = limit_N
        self._faults.largest_N = 0.0

    @property
    def largest_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Largest force along any axis since `watch` was called, in N."""
        return self._faults.largest_N

    def mean_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> npt.NDArray[np.float64]:
        """Return the mean force in N along x, y, z, (3,), over the latest `seconds`. Raises
        InstrumentError if no frame has come."""
        latest = self.latest_N(seconds)
        mean: npt.NDArray[np.float64] = np.add.reduce(latest) / len(latest)
        return mean

    def latest_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> npt.NDArray[np.float64]:
        """Return the forces in N along x, y, z, (n, 3), of the latest `seconds`. Raises
        InstrumentError if no frame has come."""
        return np.concatenate([f.force_N[-n:] for f, n in self._latest(seconds)])

    def frames_since(self, index: int) -> ForceFrames | None:
        """Return every frame from number `index` on as one batch, or None if none has come yet.

        Raises InstrumentError if some of them have left the buffer: a record must not have a gap.
        """
        return self._frames.since(index)

    @property
    def older_s(self) -> float:
        """Return by how many s the newest frame is older than usual; 0 in virtual time."""
        if self._clock.is_virtual or not self._rate:
            return 0.0
        return max(0.0, self._clock.now() - self._newest_s)

    @property
    def frames_seen(self) -> int:
        """Number of frames received so far, which is the number of the next one."""
        return self._frames.seen

    def tare(self, seconds: float) -> tuple[float, float, float]:
        """Define the mean of the latest `seconds` as zero force. Returns the force along x, y, z in
        N that this mean is relative to the amplifier's own zero."""
        latest = self._latest(seconds)
        zero = np.concatenate([f.raw[-n:] for f, n in latest]).mean(axis=0)
        self.noise_N = np.concatenate([f.force_N[-n:] for f, n in latest]).std(axis=0)
        self._faults.at_rest = np.concatenate([f.raw[-n:] for f, n in latest])
        raw = (float(zero[0]), float(zero[1]), float(zero[2]))
        zero_N = self._sensor.tare(raw)
        self._frames.forget()
        self.zero = raw
        return zero_N

    def largest_from_now_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> float | None:
        """Wait for `seconds` and return the largest mean force along any axis, in N, of the frames
        that come within them. Returns None if none comes, or if all are so late that they were
        measured before."""
        begin = self.frames_seen
        self._clock.sleep(seconds)
        frames = self.frames_since(begin)
        if frames is None or self.older_s > seconds / 2:
            return None
        return float(np.abs(frames.force_N.mean(axis=0)).max())

    def largest_latest_N(  # noqa: N802
        self, seconds: float
    ) -> float | None:
        """Return the largest mean force along any axis of the latest `seconds`, in N, without
        waiting; None if no frame has come, or none lately."""
        kept = self._frames.latest(max(1, round(seconds * self._rate)))
        if not kept or self.older_s > STALE_S:
            return None
        latest_N = np.concatenate([frames.force_N[-n:] for frames, n in kept])
        return float(np.abs(latest_N.mean(axis=0)).max())

    def check(self) -> None:
        """Raise the failure of the reader's thread; a trip is raised once."""
        self.check_trip()
        self.check_stream()

    def check_stream(self) -> None:
        """Raise the failure that ended the reader's thread, and check that frames still come. The
        thread checks that too, but how soon depends on the computer's load."""
        self._reader.check()
        self._watch_silence()

    def check_trip(self) -> None:
        """Raise the reason why the bench was made safe from the reader's thread, if not raised
        before."""
        if self._trip is not None:
            trip, self._trip = self._trip, None
            raise trip

    def settle(self) -> None:
        """Wait until the reader's thread has handled its present batch and `check_trip` knows the
        result. Must not be called from a callback of the clock, which may hold a lock that the
        thread needs."""
        self._reader.settle()

    # --- used by the clock --------------------------------------------------------------------
    # The clock no longer waits for a thread that has ended: `check` reports why it ended, and a
    # shutdown action, which reads no force, must not be disturbed by it.

    def bytes_handled(self) -> int:
        """See `rig.core.clock.StreamConsumer`."""
        return self.await_bytes(0, 0.0)

    def await_bytes(self, count: int, patience_s: float) -> int:
        """See `rig.core.clock.StreamConsumer`."""
        try:
            return self._reader.await_bytes(count, patience_s)
        except Exception:  # noqa: BLE001 - check() raises it
            return sys.maxsize

    # --- the reader's thread ------------------------------------------------------------------

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the sensor's link."""
        return self._sensor.bytes_consumed

    def read(self) -> None:
        """Buffer the new frames and judge each of them; called by the reader's thread."""
        try:
            frames = self._sensor.read()
        except WrongFramesError as error:
            self._make_safe(FrameFault(error.cause, error.hint or ""))
            raise
        if frames is None:
            self._watch_silence()
            return
        if (unknown := unknown_force(frames)) is not None:
            self._make_safe(unknown)
        now = self._clock.now()
        self._last_frame_s = now
        if _STALE in self._holds.active:
            # The silence has been a hold already, so it is not reported as a gap as well.
            self._delay.take_as_usual(self._sensor.frames_behind)
            self._holds.end(_STALE)
        self._watch_gap(now)
        late = max(0.0, self._delay.beyond_usual(self._sensor.frames_behind))
        self._newest_s = now - (late / self._rate if self._rate else 0.0)
        self._frames.add(frames)
        for fault in self._faults.in_frames(frames):
            self._make_safe(fault)

    def _make_safe(self, fault: FrameFault) -> None:
        """Run the emergency actions and keep the reason. Raises InstrumentError, which ends the
        stream, where the sensor is not to be believed any more."""
        failures = self._act()
        cause = fault.cause
        if failures:
            cause += f"; not stopped at once: {'; '.join(failures)}"
        if fault.is_over_limit:
            self._trip = TripError(cause, fault.hint)
            return
        self._trip = InstrumentError("force_sensor", "stream", cause, fault.hint)
        raise self._trip

    def _watch_silence(self) -> None:
        if self._last_frame_s is None:
            return
        silent_s = self._clock.now() - self._last_frame_s
        if silent_s > LOST_S:
            raise InstrumentError(
                "force_sensor",
                "stream",
                f"no frame for {silent_s:.2g} s",
                "check the amplifier and its cable",
            )
        if silent_s > STALE_S:
            self._holds.begin(_STALE)

    def _watch_gap(self, now: float) -> None:
        behind = self._sensor.frames_behind
        missing_s = self._delay.missing_for_s(now, behind, self._rate)
        if missing_s is None:
            self._holds.end(_LATE)
            return
        if missing_s > LATE_S:
            self._holds.begin(_LATE)
        if missing_s > LOST_S:
            self._make_safe(
                FrameFault(
                    f"{self._delay.beyond_usual(behind):.0f} frames are missing: the stream has a "
                    "gap",
                    "check the cable and the load of the computer, or choose a lower rate if the "
                    "force sensor has one",
                )
            )

    def _latest(self, seconds: float) -> list[tuple[ForceFrames, int]]:
        """Return the latest batches, oldest first, and how many frames of each lie within
        `seconds`.

        Right after a start or a tare there are none yet: it then waits for them, until the silence
        ends the run.
        """
        while not (batches := self._frames.latest(max(1, round(seconds * self._rate)))):
            self.check_stream()
            self._clock.sleep(1 / self._rate)
        return batches


_STALE = "the force sensor is silent"
_LATE = "the force sensor's frames are late"
