"""What is checked in every wait of a jogging session: whatever may end a motion."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator

from rig.bench.connected import Bench
from rig.core.errors import RigError
from rig.run.arming import BEAT_EVERY_S, Arming
from rig.run.holds import Holds
from rig.run.interlocks.store import InterlockStore
from rig.run.interlocks.watch import InterlockWatch
from rig.run.making_safe.guard_link import GuardLink
from rig.run.stopping import StopFlag
from rig.run.streams.force_monitor import ForceMonitor

FORCE_RATE_S_S = 500.0
FORCE_OVER_S = 0.02
"""Time over which the displayed force is averaged; the watcher checks every frame."""

log = logging.getLogger("rig")

Vector = tuple[float, float, float]


class JogWatch:
    """Watches stop requests, persons' interlocks, the force, holds and the guard.

    What it finds is raised in the wait. The interlocks and the force are also watched by threads
    that stop the drives by themselves while a call takes its time. `say` gets messages for the
    operator.
    """

    def __init__(
        self,
        bench: Bench,
        arming: Arming,
        stop: StopFlag,
        records: InterlockStore,
        say: Callable[[str], None],
    ):
        self._bench, self._arming, self._stop, self._say = bench, arming, stop, say
        self.holds = Holds()
        self._interlocks = InterlockWatch(
            bench,
            self.holds,
            arming.emergency_stop,
            records,
            lambda level, code, message: log.log(logging.getLevelName(level.upper()), message),
        )
        self._force: ForceMonitor | None = None
        self.force_N: Vector | None = None
        """Force in N when it was last read; None before, and on a bench without a force sensor."""
        self._undisturbed = False
        self._held = False
        """True while a hold lasts that the session knows of."""
        self._guard: GuardLink
        self._guard_missed = False
        self._last_beat_s = 0.0

    @contextlib.contextmanager
    def in_every_wait(self, guard: GuardLink) -> Iterator[None]:
        """Check everything in every wait within the block, and give the guard signs of life."""
        self._guard = guard
        unregister_interlocks = self._bench.clock.each_slice(self._interlocks.poll)
        unregister = self._bench.clock.each_slice(self._check)
        try:
            yield
        finally:
            unregister()
            unregister_interlocks()
            self._interlocks.end()

    def begin(self, deadline_s: float) -> None:
        """Begin to watch the interlocks and to stream the force; the stream's end is registered
        with `deadline_s`. Raises InterlockError if a contact is open or has not been reset."""
        self._interlocks.begin()
        self._interlocks.check()
        if "force_sensor" not in self._bench.instruments:
            self._say("this bench has no force sensor: the force is not watched")
            return
        sensor = self._bench.force_sensor
        stop_drives = self._arming.emergency_stop
        monitor = ForceMonitor(sensor, self._bench.clock, self.holds, stop_drives)
        self._arming.register("force stream", monitor.stop, deadline_s, watches=True)
        monitor.start(min(FORCE_RATE_S_S, sensor.limits()["rate"].high))
        self._force = monitor

    def limit_force(self, limit_N: float) -> None:
        """Stop everything from now on where the force along any axis passes `limit_N`; nothing is
        limited on a bench without a force sensor."""
        if self._force is not None:
            self._force.watch(limit_N)

    def has_tripped(self) -> bool:
        """Return whether the force has passed its limit and no wait has raised that yet."""
        if self._force is None:
            return False
        try:
            self._force.settle()
            self._force.check_trip()
        except RigError:
            return True
        return False

    def read_force(self) -> float | None:
        """Return the largest force along any axis, in N; None without a force sensor."""
        if self._force is None:
            return None
        x, y, z = map(float, self._force.mean_N(FORCE_OVER_S))
        self.force_N = x, y, z
        return max(abs(x), abs(y), abs(z))

    def force_in_words(self) -> str:
        """Return the force when it was last read, for the log."""
        if self.force_N is None:
            return "unknown"
        return ", ".join(f"{n} {f:+.2f}" for n, f in zip("xyz", self.force_N, strict=True)) + " N"

    def hold_is_known(self) -> None:
        """Raise no hold from now on until `hold_is_over` has returned True."""
        self._held = True

    def hold_is_over(self) -> bool:
        """Return, once, that the hold has ended which was known."""
        if not self._held or self.holds.active:
            return False
        self.holds.acknowledge()
        self._held = False
        return True

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Let only a drive end a wait within the block, in which something is being stopped."""
        before, self._undisturbed = self._undisturbed, True
        try:
            yield
        finally:
            self._undisturbed = before

    @contextlib.contextmanager
    def first_cause(self) -> Iterator[None]:
        """Report the first cause: a person's interlock or a trip of the watcher replaces the
        exception of a call that it disturbed."""
        try:
            yield
        except RigError:
            self._interlocks.settle()
            self._interlocks.check()
            if self._force is not None:
                self._force.settle()
                self._force.check_trip()
            raise

    def _check(self) -> None:
        now = time.monotonic()
        if now - self._last_beat_s >= BEAT_EVERY_S:
            self._last_beat_s = now
            self._guard.beat()
        if self._undisturbed:
            return
        self._stop.check()
        self._interlocks.check()
        if self._force is not None:
            self._force.check()
        if not self._held:
            self.holds.check()
        trouble = self._guard.trouble()
        if (trouble is not None) is not self._guard_missed:
            self._guard_missed = trouble is not None
            self._say(
                "the guard reads heartbeats again and watches this program"
                if trouble is None
                else f"the guard {trouble}: if this program dies as well, only the drives stop"
            )
