"""The part of a run that its procedure may use."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rig.bench.connected import Bench
from rig.bench.plan import longest_call_s
from rig.core.clock import Clock
from rig.core.errors import InstrumentTimeoutError, RigError
from rig.files.journal.recorder import Recorder
from rig.run.arming import SHUTDOWN_DEADLINE_S, Arming
from rig.run.ending import Ending
from rig.run.holds import Disturbances, Holds
from rig.run.interlocks.store import InterlockStore
from rig.run.interlocks.watch import InterlockWatch
from rig.run.points import Reading
from rig.run.press_references import PressReferences
from rig.run.streams.force_monitor import ForceMonitor
from rig.run.streams.recorded import RecordedStreams


class Run:
    """The part of a run that the hooks `arm` and `take` may use."""

    def __init__(
        self,
        settings: Any,
        bench: Bench,
        recorder: Recorder,
        streams: Mapping[str, int],
        start_s: float,
        readings: Mapping[str, Reading] | None = None,
        interlock_records: InterlockStore | None = None,
    ):
        self.settings = settings
        self.bench = bench
        self.clock: Clock = bench.clock
        self.readings: Mapping[str, Reading] = {} if readings is None else readings
        """Readings recorded so far, by point id; a resumed run begins with those of earlier
        attempts."""
        self.holds = Holds()
        self.disturbances = Disturbances(bench.settings.holds)
        self._force: ForceMonitor | None = None
        self.warnings: list[str] = []
        self.inform: Callable[[str], None] = lambda message: None
        """Shows a message to the operator, for the observers of the run. It may have to wait for a
        terminal: never call it while a force is held."""
        self.on_press: Callable[[int], None] = lambda presses: None
        """Takes note of a press, with the number of presses so far; it waits for nothing."""
        self.ending = Ending(self.event)
        """How the bench is made safe and left, for the shutdown actions."""
        self.streams = RecordedStreams(recorder, streams, self.elapsed_s)
        """The procedure's streams, which record its samples."""
        self._arming = Arming(overlapping=not self.clock.is_virtual)
        records = interlock_records or InterlockStore(bench.plan, lasting=False)
        self.interlocks = InterlockWatch(
            bench, self.holds, self._arming.emergency_stop, records, self.event
        )
        """The watch over the bench's interlock contacts."""
        self.references = PressReferences(None, bench.plan, "")
        """What earlier runs on this bench have shown of a press."""
        self._waits_s = max(
            (longest_call_s(part.settings) for part in bench.plan.instruments), default=0.0
        )
        """Longest time that one call on an instrument may wait for its link."""
        self._recorder = recorder
        self._start_s = start_s

    def elapsed_s(self) -> float:
        """Return the bench time since the run's start in seconds; a resumed run continues from its
        earlier attempts."""
        return self.clock.now() - self._start_s

    @property
    def arming(self) -> Arming:
        """Register of what is switched on."""
        return self._arming

    @property
    def force(self) -> ForceMonitor:
        """The force sensor's monitor, once `stream_force` has started it."""
        assert self._force is not None, "stream_force() comes first"
        return self._force

    def arm(
        self,
        name: str,
        off: Callable[[], None],
        deadline_s: float = SHUTDOWN_DEADLINE_S,
        emergency: Callable[[], None] | None = None,
        done: str = "",
        drives: bool = True,
    ) -> None:
        """Register how `name` is switched off; call it before you switch it on. Registering a name
        again replaces its shutdown action.

        `off`, the shutdown action, has `deadline_s` of wall time, not counting what a broken link
        makes it wait. `emergency` is the emergency action, which a watcher has run first, from
        another thread; it may talk to the instrument once and may not wait on the bench clock.
        `done` is shown when `off` has worked: "generator off"; without it, "`name` off". `drives`
        is False for what moves nothing and puts nothing out, such as an acquisition: the bench is
        safe although its `off` has failed.
        """
        shutdown = self.ending.noting(off, done or f"{name} off")
        self._arming.register(name, shutdown, deadline_s + self._waits_s, emergency, drives=drives)

    def stream_force(self, rate_S_s: float) -> ForceMonitor:
        """Begin to read and watch the force sensor; restarts the stream if it runs already. Its
        shutdown action is registered."""
        if self._force is not None:
            self._force.stop()
        monitor = ForceMonitor(
            self.bench.force_sensor, self.clock, self.holds, self._arming.emergency_stop
        )

        def off() -> None:
            if self._force is monitor:
                self._force = None
            monitor.stop()

        deadline_s = SHUTDOWN_DEADLINE_S + self._waits_s
        shutdown = self.ending.noting(off, "force stream stopped")
        self._arming.register("force stream", shutdown, deadline_s, watches=True)
        monitor.start(rate_S_s)
        self._force = monitor
        return monitor

    @property
    def force_zero(self) -> tuple[float, float, float] | None:
        """The force sensor's raw reading without force; None if it is not read or was not
        zeroed."""
        return None if self._force is None else self._force.zero

    @property
    def force_limit_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Force in N along any axis that is watched for; infinite where none is."""
        return math.inf if self._force is None else self._force.limit_N

    def force_from_now_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> float | None:
        """Wait for `seconds` and return the largest mean force along any axis within them, in N.
        Returns None if the force sensor is not read or sends nothing. Made for shutdown actions,
        which it does not interrupt."""
        return None if self._force is None else self._force.largest_from_now_N(seconds)

    def latest_force_N(self, seconds: float) -> float | None:  # noqa: N802
        """Return the largest mean force along any axis within the latest `seconds`, in N, without
        waiting. Returns None if the force sensor is not read or has sent nothing lately."""
        return None if self._force is None else self._force.largest_latest_N(seconds)

    @contextlib.contextmanager
    def first_cause(self) -> Iterator[None]:
        """Report the first cause of a failure. If, within the block, an interlock of a person is
        open or latched, a watcher has made the bench safe, or an instrument did not answer in time
        during a hold, that reason replaces the exception of the call that it disturbed.

        For the outermost level only, since it waits for the watcher to finish.
        """
        try:
            yield
        except RigError as error:
            self.interlocks.settle()
            self.interlocks.check()
            if self._force is not None:
                self._force.settle()
                self._force.check_trip()
            if isinstance(error, InstrumentTimeoutError):
                self.holds.check()
            raise

    def tripped(self) -> RigError | None:
        """Return, once, why a watcher has made the bench safe if that has not been reported yet.
        Made for shutdown actions, whose waits do not raise it."""
        self.interlocks.settle()
        if (opened := self.interlocks.news()) is not None:
            return opened
        if self._force is None:
            return None
        self._force.settle()
        try:
            self._force.check_trip()
        except RigError as trip:
            return trip
        return None

    def check_watchers(self) -> None:
        """Raise an interlock of a person, a failure or trip of the force monitor, or a hold."""
        self.interlocks.poll()
        self.interlocks.check()
        if self._force is not None:
            self._force.check()
        self.holds.check()

    def check_force_stream(self) -> None:
        """Raise the reason why the force stream ended or has been silent for too long."""
        if self._force is not None:
            self._force.check_stream()

    def count_press(self) -> None:
        """Note that z goes down to press the object now. A run reports how often, since each time
        wears film and skin."""
        self.disturbances.presses += 1
        self.on_press(self.disturbances.presses)

    def event(self, level: str, code: str, message: str, at_s: float | None = None) -> None:
        """Record that something happened; warnings are repeated at the end of the run. `at_s` is
        the time on the run's clock at which it did, by default now.

        Raises what the recorder raises, except while the bench is made safe: a disk that has failed
        must not end a shutdown action."""
        if level == "warning" and message not in self.warnings:
            self.warnings.append(message)
        time_s = self.elapsed_s() if at_s is None else at_s - self._start_s
        fields = {"time": time_s, "level": level, "code": code, "message": message}
        if self.ending.under_way:
            self.ending.try_to_record(lambda: self._recorder.put_event(fields))
        else:
            self._recorder.put_event(fields)

    def check_stop(self) -> None:
        """Raise here if the run has to stop: a stop request, or a failure of another thread. Waits
        do it too."""
        self.clock.sleep(0)
