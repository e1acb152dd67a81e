"""The force sensor's reader and its watchers, which act even while the procedure is blocked.

The reader's thread owns the sensor's link. Every batch of frames goes to the watchers first: for a
force over the limit, that thread runs the registered emergency actions at once. The trip is raised
in the procedure's thread at its next check.
"""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from rig.core.clock import Clock
from rig.core.errors import InstrumentError, RigError
from rig.instruments.roles import ForceFrames, ForceSensor, axes_of
from rig.run.force_axes import AXES, AxisWatch
from rig.run.holds import Holds
from rig.run.stream_reader import StreamReader
from rig.run.trip import TripError

STALE_S = 0.25
"""Time without a frame that starts a hold: the force is not known."""
LOST_S = 5.0
"""Time without a frame, or with missing frames, that ends the run."""
MISSING_FRAMES = 25
"""Frames overdue by bench time, beyond the usual number, from which they are late or the stream has
a gap."""
LATE_S = 0.5
"""Time with missing frames that starts a hold: frames that are merely late arrive within it."""
STILL_FRAMES = 20
"""Number of successive frames, equal to the last bit on all axes, that show a stopped converter:
one of 24 bits always sees noise of many steps (unconfirmed on the amplifier)."""
DRIFT = 1e-3
"""Rate at which the usual number of overdue frames follows: well above the drift between two
clocks."""
BATCHES_KEPT = 20_000


class ForceMonitor:
    """Streams a force sensor, buffers the latest frames, and watches every one of them."""

    def __init__(
        self, sensor: ForceSensor, clock: Clock, holds: Holds, act: Callable[[], list[str]]
    ):
        self._sensor, self._clock, self._holds, self._act = sensor, clock, holds, act
        self._limit_N = self.limit_N = float("inf")
        """Limit that trips now, and limit that `watch` was last called with."""
        self.zero: tuple[float, float, float] | None = None
        """Raw reading without force; None if the sensor has not been zeroed since this stream was
        begun."""
        self.noise_N = np.zeros(3)
        """Standard deviation of a frame's force along x, y, z, in N, at the latest `tare`."""
        self._trip: RigError | None = None
        """Reason why the reader's thread made the bench safe."""
        self._rate = 0.0
        self._recent: deque[ForceFrames] = deque(maxlen=BATCHES_KEPT)
        self._lock = threading.Lock()
        self._frames_before = 0
        """Number of the first frame after those that were dropped on purpose."""
        self._last_frame_s: float | None = None
        """Time of the latest frame; None until the stream has begun."""
        self._usual = 0.0
        self._newest_s = 0.0
        """Time at which the newest buffered frame would have come without its delay."""
        self._missing_since_s: float | None = None
        self._looked_s = 0.0
        self.axes = axes_of(sensor)
        """Axes that the sensor measures. The others are 0 in its frames."""
        self._axes = AxisWatch(getattr(sensor, "axes", ""))
        self._at_rest: npt.NDArray[np.float32] | None = None
        """Raw frames of the latest `tare` that the reader's thread has not learned from."""
        self._last_raw: list[float] = []
        self._still = 0
        """Number of successive frames up to the latest that repeat the one before them."""
        self.largest_N = 0.0
        """Largest force along any axis since `watch` was called, in N."""
        self._reader: StreamReader[ForceFrames] = StreamReader(
            "force reader", self, around=clock.in_background
        )
        self._unfollow: Callable[[], None] = lambda: None

    # --- used by the procedure ----------------------------------------------------------------

    def start(self, rate_S_s: float) -> float:
        """Begin to stream and to watch, without a limit yet. Returns the actual rate (see the
        property `rate_S_s`), which may differ from the one asked for."""
        self._unfollow = self._clock.follow_stream("force_sensor", self)
        self._looked_s = self._clock.now()
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
        self._limit_N = self.limit_N = limit_N
        self.largest_N = 0.0

    def mean_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> npt.NDArray[np.float64]:
        """Return the mean force (3,) over the latest `seconds`. Raises InstrumentError if no frame
        has come."""
        latest = self.latest_N(seconds)
        mean: npt.NDArray[np.float64] = np.add.reduce(latest) / len(latest)
        return mean

    def latest_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> npt.NDArray[np.float64]:
        """Return the forces (n, 3) of the latest `seconds`. Raises InstrumentError if no frame has
        come."""
        return np.concatenate([f.force_N[-n:] for f, n in self._latest(seconds)])

    def frames_since(self, index: int) -> ForceFrames | None:
        """Return every frame from number `index` on as one batch, or None if none has come yet.

        Raises InstrumentError if some of them have left the buffer: a record must not have a gap.
        """
        found: list[ForceFrames] = []
        with self._lock:
            for frames in reversed(self._recent):
                if frames.first_index + len(frames) <= index:
                    break
                found.append(frames)
        if not found:
            return None
        oldest = found[-1]
        skip = index - oldest.first_index
        if skip < 0:
            raise InstrumentError(
                "force_sensor",
                "stream",
                f"{-skip} frames from number {index} on are no longer in the buffer",
                "read them more often",
            )
        parts = found[::-1]
        return ForceFrames(
            index,
            np.concatenate([batch.raw for batch in parts])[skip:],
            np.concatenate([batch.force_N for batch in parts])[skip:],
            np.concatenate([batch.saturated for batch in parts])[skip:],
            oldest.raw_unit,
        )

    @property
    def older_s(self) -> float:
        """Return by how many s the newest frame is older than usual; 0 in virtual time."""
        if self._clock.is_virtual or not self._rate:
            return 0.0
        return max(0.0, self._clock.now() - self._newest_s)

    @property
    def frames_seen(self) -> int:
        """Number of frames received so far, which is the number of the next one."""
        with self._lock:
            latest = self._recent[-1] if self._recent else None
        return latest.first_index + len(latest) if latest is not None else self._frames_before

    def tare(self, seconds: float) -> tuple[float, float, float]:
        """Define the mean of the latest `seconds` as zero force. Returns the force along x, y, z in
        N that this mean is relative to the amplifier's own zero."""
        latest = self._latest(seconds)
        zero = np.concatenate([f.raw[-n:] for f, n in latest]).mean(axis=0)
        self.noise_N = np.concatenate([f.force_N[-n:] for f, n in latest]).std(axis=0)
        self._at_rest = np.concatenate([f.raw[-n:] for f, n in latest])
        raw = (float(zero[0]), float(zero[1]), float(zero[2]))
        zero_N = self._sensor.tare(raw)
        with self._lock:
            if self._recent:
                self._frames_before = self._recent[-1].first_index + len(self._recent[-1])
            self._recent.clear()
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
        kept = self._kept(max(1, round(seconds * self._rate)))
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

    def read(self) -> Sequence[ForceFrames]:
        """Return the new frames after the watchers have checked them; called by the reader's
        thread."""
        frames = self._sensor.read()
        if frames is None:
            self._watch_silence()
            return []
        now = self._clock.now()
        self._last_frame_s = now
        if _STALE in self._holds.active:
            # The silence has been a hold already, so it is not reported as a gap as well.
            self._usual = self._sensor.frames_behind
            self._holds.end(_STALE)
        self._watch_gap(now)
        late = max(0.0, self._sensor.frames_behind - self._usual)
        with self._lock:
            self._recent.append(frames)
            self._newest_s = now - (late / self._rate if self._rate else 0.0)
        self._watch_force(frames)
        self._watch_standstill(frames)
        self._watch_axes(frames)
        return [frames]

    def _watch_force(self, frames: ForceFrames) -> None:
        if np.count_nonzero(frames.saturated):
            failed = self._make_safe()
            self._trip = InstrumentError(
                "force_sensor",
                "stream",
                f"{int(frames.saturated.sum())} of {len(frames)} frames are saturated: the force "
                f"is beyond what the amplifier can measure{failed}",
                "unload the sensor; check its zero, its cable and the input range",
            )
            raise self._trip
        sizes = np.abs(frames.force_N)
        largest = float(sizes.max())
        self.largest_N = max(self.largest_N, largest)
        if largest <= self._limit_N:
            return
        axis = AXES[int(sizes.max(axis=0).argmax())]
        what = f"force along {axis} of {largest:.3g} N is over the limit of {self._limit_N:g} N"
        # A trip is reported once; the next call of `watch` sets a limit again.
        self._limit_N = float("inf")
        self._trip = TripError(what + self._make_safe(), "find out what pressed first")

    def _watch_standstill(self, frames: ForceFrames) -> None:
        """Make the bench safe if the sensor keeps sending the same frame: it no longer measures."""
        for raw in frames.raw.tolist():
            self._still = self._still + 1 if raw == self._last_raw else 0
            self._last_raw = raw
            if self._still >= STILL_FRAMES:
                failed = self._make_safe()
                self._trip = InstrumentError(
                    "force_sensor",
                    "stream",
                    f"{self._still} frames in a row are the same to the last bit: the force is not "
                    f"measured any more{failed}",
                    "switch the amplifier off and on; check that its converter runs",
                )
                raise self._trip

    def _watch_axes(self, frames: ForceFrames) -> None:
        """Make the bench safe if one axis of the sensor does not measure any more."""
        if (rest := self._at_rest) is not None:
            self._at_rest = None
            self._axes.learn(rest)
        if (fault := self._axes.fault(frames.raw)) is not None:
            failed = self._make_safe()
            self._trip = InstrumentError(
                "force_sensor",
                "stream",
                f"{fault}{failed}",
                "check the cable and the bridge of this axis; switch the amplifier off and on",
            )
            raise self._trip

    def _make_safe(self) -> str:
        """Run the emergency actions; return their failures as an addition to the reason."""
        failures = self._act()
        return f"; not stopped at once: {'; '.join(failures)}" if failures else ""

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
        missing = self._sensor.frames_behind - self._usual
        drift = DRIFT * self._rate * (now - self._looked_s)
        self._looked_s = now
        if missing < MISSING_FRAMES:
            # It falls no faster than it rises, because one batch may be ahead of a slaved clock.
            self._usual += max(-drift, min(missing, drift))
            self._missing_since_s = None
            self._holds.end(_LATE)
            return
        since = self._missing_since_s = self._missing_since_s or now
        if now - since > LATE_S:
            self._holds.begin(_LATE)
        if now - since > LOST_S:
            failed = self._make_safe()
            self._trip = InstrumentError(
                "force_sensor",
                "stream",
                f"{missing:.0f} frames are missing: the stream has a gap{failed}",
                "check the cable and the load of the computer; choose a lower rate",
            )
            raise self._trip

    def _latest(self, seconds: float) -> list[tuple[ForceFrames, int]]:
        """Return the latest batches, oldest first, and how many frames of each lie within
        `seconds`.

        Right after a start or a tare there are none yet: it then waits for them, until the silence
        ends the run.
        """
        while not (batches := self._kept(max(1, round(seconds * self._rate)))):
            self.check_stream()
            self._clock.sleep(1 / self._rate)
        return batches

    def _kept(self, wanted: int) -> list[tuple[ForceFrames, int]]:
        batches: list[tuple[ForceFrames, int]] = []
        with self._lock:
            for frames in reversed(self._recent):
                batches.append((frames, min(wanted, len(frames))))
                wanted -= len(frames)
                if wanted <= 0:
                    break
        return batches[::-1]


_STALE = "the force sensor is silent"
_LATE = "the force sensor's frames are late"
