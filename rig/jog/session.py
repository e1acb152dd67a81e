"""A jogging session: carries out, watches and logs the actions of the keys; stops everything at
every exit.

Arming, force watcher, holds and guard are those of a run; there is no journal, because nothing is
recorded. The generator is never touched.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rig.bench.connected import Bench
from rig.bench.limits import require
from rig.bench.plan import longest_call_s
from rig.core.errors import ConfigurationError, ExitCode, LimitError, RigError
from rig.jog.axes import JogSettings, LinearMover, RotaryMover, axes_of
from rig.jog.keys import (
    Action,
    AxisPosition,
    EndSession,
    HomeAxis,
    Jog,
    JogAxis,
    Key,
    MoveAxis,
    ShowMessage,
    StopAxes,
    WatchForce,
)
from rig.run.arming import BEAT_EVERY_S, SHUTDOWN_DEADLINE_S, Arming, ShutdownFailure
from rig.run.holds import HoldError, Holds, PauseSwitch
from rig.run.interlocks.store import InterlockStore
from rig.run.interlocks.watch import InterlockWatch
from rig.run.locks.bench_mark import BenchMarks
from rig.run.making_safe.guard import GuardLink
from rig.run.stopping import StopFlag
from rig.run.streams.force_monitor import ForceMonitor
from rig.run.trip import TripError

FORCE_RATE_S_S = 500.0
TICK_S = 0.02
FORCE_OVER_S = 0.02
"""Time over which the displayed force is averaged; the watcher checks every frame."""
OTHERS_EVERY_S = 0.5
"""Interval between polls of the axes that are not chosen."""

log = logging.getLogger("rig")

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class JogStatus:
    """The state that is shown to the operator."""

    axes: tuple[JogAxis, ...]
    places: Mapping[str, AxisPosition]
    chosen: JogAxis
    moving: JogAxis | None
    force_N: Vector | None
    """Force in N; None on a bench without a force sensor."""
    pressed: bool


class JogOperator(Protocol):
    """The interface to the operator at the keys."""

    def keys(self) -> list[Key]:
        """Return the keys pressed since the last call, oldest first; never waits. Raises RigError
        if the terminal has closed."""
        ...

    def forget(self) -> None:
        """Discard the keys pressed so far."""
        ...

    def say(self, text: str) -> None:
        """Show a message."""
        ...

    def show(self, status: JogStatus) -> None:
        """Show the present state."""
        ...


@dataclass
class JogOutcome:
    """The outcome of a session."""

    code: ExitCode = ExitCode.DONE
    failures: list[RigError] = field(default_factory=list)
    off_failures: list[ShutdownFailure] = field(default_factory=list)


class _HomingStoppedError(RigError):
    """Raised when a key is pressed while an axis homes."""


class JogSession:
    """One session on a connected bench, from arming to rest."""

    def __init__(
        self,
        bench: Bench,
        settings: JogSettings,
        chosen: str | None,
        stop: StopFlag,
        person: JogOperator,
        records: InterlockStore | None = None,
    ):
        """Prepare the session.

        Raises ConfigurationError if the bench has no such axis, LimitError for a largest force
        beyond the sensor's range or too near to its end for z to brake before it.
        """
        if "force_sensor" in bench.instruments:
            reach = bench.force_sensor.reach()["force"]
            require("largest force", settings.largest_force_N, reach)
        axes, limited = axes_of(bench, settings)
        names = [axis.name for axis in axes]
        if chosen is not None and chosen not in names:
            raise ConfigurationError(
                f"{bench.plan.source}: the bench has no axis {chosen}", f"it has {', '.join(names)}"
            )
        self._bench, self._clock, self._stop = bench, bench.clock, stop
        self._person, self._settings = person, settings
        self._guard: GuardLink
        self._marks: BenchMarks
        self._axes = {axis.name: axis for axis in axes}
        self._drives: dict[str, LinearMover | RotaryMover] = {
            name: RotaryMover(bench.rotary)
            if name == "rotary"
            else LinearMover(getattr(bench, name))
            for name in names
        }
        self._jog = Jog(axes, settings.largest_force_N, chosen or names[0])
        self._limited = limited
        self._arming = Arming(overlapping=not bench.clock.is_virtual)
        self._holds = Holds()
        self._interlocks = InterlockWatch(
            bench,
            self._holds,
            self._arming.emergency_stop,
            records or InterlockStore(bench.plan, lasting=False),
            lambda level, code, message: log.log(logging.getLevelName(level.upper()), message),
        )
        self._force: ForceMonitor | None = None
        self._force_N: Vector | None = None
        self._places: dict[str, AxisPosition] = {}
        self._others_at_s = 0.0
        self._began_at = 0.0
        self._undisturbed = self._homing = self._blocked = self._left = False
        self._last_beat_s = 0.0
        self._guard_missed = False

    def go(self, guard: GuardLink, marks: BenchMarks) -> JogOutcome:
        """Jog until the operator leaves, a signal comes or something fails; then stop everything,
        and mark the bench as it was left. Never raises a RigError."""
        ended = JogOutcome()
        self._guard, self._marks = guard, marks
        unregister_interlocks = self._clock.each_slice(self._interlocks.poll)
        unregister = self._clock.each_slice(self._each_slice)
        try:
            with PauseSwitch(self._holds):
                self._begin()
                while not self._left:
                    self._survive_pass()
        except RigError as error:
            ended.code = error.code
            ended.failures.extend(error.parts())
        finally:
            self._make_safe(ended)
            unregister()
            unregister_interlocks()
            self._interlocks.end()
        return ended

    # --- beginning and end --------------------------------------------------------------------

    def _begin(self) -> None:
        self._interlocks.begin()
        self._interlocks.check()
        waits_s = max(longest_call_s(part.settings) for part in self._bench.plan.instruments)
        deadline_s = SHUTDOWN_DEADLINE_S + waits_s
        if "force_sensor" in self._bench.instruments:
            sensor = self._bench.force_sensor
            monitor = ForceMonitor(sensor, self._clock, self._holds, self._arming.emergency_stop)
            self._arming.register("force stream", monitor.stop, deadline_s, watches=True)
            monitor.start(min(FORCE_RATE_S_S, sensor.reach()["rate"].high))
            self._force = monitor
        else:
            self._person.say("this bench has no force sensor: the force is not watched")
        for name, drive in self._drives.items():
            self._arming.register(name, drive.stage.stop, deadline_s, drive.stage.make_safe)
        self._stop_all()
        for text in self._limited:
            self._person.say(text)
        if self._force is not None:
            self._force.watch(self._settings.largest_force_N)

    def _make_safe(self, ended: JogOutcome) -> None:
        self._undisturbed = True
        with self._bench.links.making_safe():
            failures = self._arming.make_safe(self._guard.beat)
        if (moved := self._jog.moving) is not None:
            with contextlib.suppress(RigError):
                self._poll_position(moved.name)
            self._log_end("the session ended")
        for failure in failures:
            if not failure.drives:
                text = f"{failure.name}: {failure.reason}"
                ended.failures.append(RigError(text, None, ExitCode.INSTRUMENT))
                ended.code = ended.code or ExitCode.INSTRUMENT
            else:
                ended.off_failures.append(failure)
                ended.code = ExitCode.UNSAFE
        try:
            if ended.off_failures:
                self._marks.unsafe({off.name: off.reason for off in ended.off_failures})
            else:
                self._marks.clear()
        except RigError as error:
            ended.failures.append(error)
            ended.code = ended.code or error.code
        if not ended.off_failures:
            self._guard.safe()

    # --- checked in every wait ----------------------------------------------------------------

    def _each_slice(self) -> None:
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
        if not self._blocked:
            self._holds.check()
        if self._homing and self._person.keys():
            raise _HomingStoppedError("homing was stopped by a key")
        if not self._guard_missed and (trouble := self._guard.trouble()) is not None:
            self._guard_missed = True
            self._say(f"the guard {trouble}: if this program dies as well, only the drives stop")

    @contextlib.contextmanager
    def _first_cause(self) -> Iterator[None]:
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

    @contextlib.contextmanager
    def _no_disturbance(self) -> Iterator[None]:
        """Let only a drive end a wait within the block, in which something is being stopped."""
        before, self._undisturbed = self._undisturbed, True
        try:
            yield
        finally:
            self._undisturbed = before

    # --- one pass after the other -------------------------------------------------------------

    def _survive_pass(self) -> None:
        """Make one pass; a trip or a hold stops the motion and does not end the session."""
        try:
            with self._first_cause():
                self._pass()
        except TripError as trip:
            self._after_trip(trip)
        except HoldError as hold:
            self._blocked = True
            self._perform(self._jog.block(hold.message))

    def _pass(self) -> None:
        self._clock.sleep(TICK_S)
        if self._blocked and not self._holds.active:
            self._holds.acknowledge()
            self._blocked = False
            self._perform(self._jog.unblock())
        self._poll_positions()
        chosen = self._jog.chosen.name
        for key in _urgent_alone(self._person.keys()):
            actions = self._jog.press(key, self._clock.now(), self._places[chosen])
            self._perform(actions)
            if any(isinstance(action, StopAxes | HomeAxis) for action in actions):
                break  # Later keys were pressed before the operator saw the bench stop.
        if (moving := self._jog.moving) is not None:
            self._drives[moving.name].stage.moving()  # Raises the reason why a motion ended.
        largest_N = self._read_force()
        self._perform(self._jog.poll(self._clock.now(), largest_N))
        self._person.show(
            JogStatus(
                tuple(self._axes.values()),
                self._places,
                self._jog.chosen,
                self._jog.moving,
                self._force_N,
                self._jog.pressed,
            )
        )

    def _after_trip(self, trip: TripError) -> None:
        """Complete the stop that the watcher began; from then on only the retreat is allowed. A
        trip during the retreat ends the session."""
        self._stop_all()
        self._log_end("tripped")
        self._say(f"stopped: {trip.message}")
        again = self._jog.pressed
        self._jog.stopped(self._clock.now())
        if again:
            raise LimitError(
                f"{trip.message} during the retreat: the force does not fall",
                "switch the drives off and free the object by hand",
            ) from trip
        force_N = self._read_force()
        assert force_N is not None, "only a force sensor trips"
        self._perform(self._jog.trip(force_N))

    # --- actions------------------------------------------------------------------------------

    def _perform(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case MoveAxis():
                    self._move(action)
                case StopAxes(axis, why):
                    self._halt(axis, why)
                case HomeAxis(axis):
                    self._home(axis)
                case WatchForce(limit_N):
                    assert self._force is not None, "only a force sensor trips"
                    self._force.watch(limit_N)
                case ShowMessage(text):
                    self._say(text)
                case EndSession():
                    self._left = True

    def _move(self, move: MoveAxis) -> None:
        axis = move.axis
        if move.begins:
            self._began_at = move.start
            log.info(
                "jog: %s from %.4f %s towards %s, %g %s at a time, %g %s/s; force %s",
                axis.name,
                move.start,
                axis.unit,
                "more" if move.target > move.start else "less",
                axis.step,
                axis.unit,
                axis.speed,
                axis.unit,
                self._force_in_words(),
            )
        self._drives[axis.name].start(move.target, axis.speed)

    def _halt(self, axis: JogAxis | None, why: str) -> None:
        if axis is None:
            self._stop_all()
        else:
            with self._no_disturbance():
                self._drives[axis.name].stage.stop()
            self._poll_position(axis.name)
        self._log_end(why)
        self._jog.stopped(self._clock.now(), released=axis is not None)
        self._person.forget()

    def _stop_all(self) -> None:
        """Stop every axis, the moving one first; then read their positions."""
        moving = self._jog.moving
        names = sorted(self._drives, key=lambda name: moving is None or name != moving.name)
        with self._no_disturbance():
            for name in names:
                self._drives[name].stage.stop()
            for name in names:
                homed = self._drives[name].stage.homed()
                self._places[name] = AxisPosition(self._drives[name].position(), homed)

    def _home(self, axis: JogAxis) -> None:
        self._person.say(f"homing {axis.name}; any key stops it")
        log.info(
            "jog: %s homes from %.4f %s; force %s",
            axis.name,
            self._places[axis.name].position,
            axis.unit,
            self._force_in_words(),
        )
        self._person.forget()
        self._homing = True
        try:
            self._drives[axis.name].stage.home()
        except _HomingStoppedError as stopped:
            self._say(stopped.message)
        finally:
            self._homing = False
        self._halt(None, "homing")
        if self._places[axis.name].homed:
            self._say(f"{axis.name} is homed")

    # --- polling and messages -----------------------------------------------------------------

    def _poll_positions(self) -> None:
        now = self._clock.now()
        others = now - self._others_at_s >= OTHERS_EVERY_S
        if others:
            self._others_at_s = now
        for name in self._drives:
            if others or name == self._jog.chosen.name:
                self._poll_position(name)

    def _poll_position(self, name: str) -> None:
        self._places[name] = AxisPosition(self._drives[name].position(), self._places[name].homed)

    def _read_force(self) -> float | None:
        """Return the largest force along any axis, in N; None without a force sensor."""
        if self._force is None:
            return None
        x, y, z = map(float, self._force.mean_N(FORCE_OVER_S))
        self._force_N = x, y, z
        return max(abs(x), abs(y), abs(z))

    def _force_in_words(self) -> str:
        if self._force_N is None:
            return "unknown"
        return ", ".join(f"{n} {f:+.2f}" for n, f in zip("xyz", self._force_N, strict=True)) + " N"

    def _log_end(self, why: str) -> None:
        """Log where a motion has ended, if one was under way."""
        if (axis := self._jog.moving) is None:
            return
        log.info(
            "jog: %s came from %.4f to %.4f %s (%s); force %s",
            axis.name,
            self._began_at,
            self._places[axis.name].position,
            axis.unit,
            why,
            self._force_in_words(),
        )

    def _say(self, text: str) -> None:
        log.info("jog: %s", text)
        self._person.say(text)


def _urgent_alone(keys: list[Key]) -> list[Key]:
    """Return only a key that stops, if there is one among several; else each key that differs from
    the one before."""
    for urgent in (Key.LEAVE, Key.STOP):
        if urgent in keys:
            return [urgent]
    return [key for n, key in enumerate(keys) if n == 0 or key is not keys[n - 1]]
