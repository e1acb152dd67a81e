"""A jogging session: carries out, watches and logs the actions of the keys; stops everything at
every exit.

Arming, force watcher, holds and guard are those of a run; there is no journal, because nothing is
recorded. The generator is never touched.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rig.bench.connected import Bench
from rig.bench.limits import require
from rig.bench.plan import longest_call_s
from rig.core.errors import ConfigurationError, ExitCode, LimitError, RigError
from rig.jog.axes import JogSettings, axes_of
from rig.jog.drives import JogDrives
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
from rig.jog.watch import JogWatch, Vector
from rig.run.arming import SHUTDOWN_DEADLINE_S, Arming, ShutdownFailure
from rig.run.holds import PAUSE, HoldError, PauseSwitch
from rig.run.interlocks.store import InterlockStore
from rig.run.locks.bench_mark import BenchMarks
from rig.run.making_safe.guard_link import GuardLink
from rig.run.points import remedy
from rig.run.stopping import StopFlag
from rig.run.trip import TripError

TICK_S = 0.02

log = logging.getLogger("rig")


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
    """How a session of hand control ended: its exit code, and what failed."""

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
            limits = bench.force_sensor.limits()["force"]
            try:
                require("--largest-force", settings.largest_force_N, limits)
            except LimitError as error:
                raise LimitError(error.message, remedy(error, bench)) from error
        axes, self._limited = axes_of(bench, settings)
        names = [axis.name for axis in axes]
        if chosen is not None and chosen not in names:
            raise ConfigurationError(
                f"--axis {chosen}: {bench.plan.source} does not have this axis",
                f"it has {', '.join(names)}; on a simulated bench --fixture plate adds stage_x, "
                "and --fixture semi-spherical-object stage_x and rotary",
            )
        self._bench, self._clock = bench, bench.clock
        self._person, self._settings = person, settings
        self._axes = tuple(axes)
        self._drives = JogDrives(bench, names)
        self._jog = Jog(axes, settings.largest_force_N, chosen or names[0])
        self._arming = Arming(overlapping=not bench.clock.is_virtual)
        records = records or InterlockStore(bench.plan, lasting=False)
        self._watch = JogWatch(bench, self._arming, stop, records, self._say)
        self._began_at = 0.0
        """Position at which the motion under way began."""
        self._left = False
        self._trips = False
        """True while a trip is handled, from the moment at which it is seen."""

    def go(self, guard: GuardLink, marks: BenchMarks) -> JogOutcome:
        """Jog until the operator leaves, a signal comes or something fails; then stop everything,
        and mark the bench as it was left. Never raises a RigError."""
        ended = JogOutcome()
        # Until everything is at rest: with its own action Ctrl-Z would suspend the process.
        with self._watch.in_every_wait(guard), PauseSwitch(self._watch.holds):
            try:
                self._begin()
                while not self._left:
                    self._survive_pass()
            except RigError as error:
                ended.code = error.code
                ended.failures.extend(error.parts())
            finally:
                with self._watch.undisturbed():
                    self._make_safe(ended, guard, marks)
        return ended

    # --- beginning and end --------------------------------------------------------------------

    def _begin(self) -> None:
        waits_s = max(longest_call_s(part.settings) for part in self._bench.plan.instruments)
        deadline_s = SHUTDOWN_DEADLINE_S + waits_s
        self._watch.begin(deadline_s)
        self._drives.register(self._arming, deadline_s)
        self._stop_all()
        for text in self._limited:
            self._person.say(text)
        self._watch.limit_force(self._settings.largest_force_N)

    def _make_safe(self, ended: JogOutcome, guard: GuardLink, marks: BenchMarks) -> None:
        pressed = self._jog.pressed or self._trips or self._watch.has_tripped()
        with self._bench.links.making_safe():
            failures = self._arming.make_safe(guard.beat)
        if (moved := self._jog.moving) is not None:
            with contextlib.suppress(RigError):
                self._drives.poll_one(moved.name)
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
                marks.unsafe({off.name: off.reason for off in ended.off_failures})
            elif pressed:
                marks.stopped(
                    f"`rig jog` ended with a force that was over {self._settings.largest_force_N:g}"
                    " N and had not fallen: something may be pressed; free it"
                )
            else:
                marks.clear()
        except RigError as error:
            ended.failures.append(error)
            ended.code = ended.code or error.code
        if not ended.off_failures:
            guard.safe()

    # --- one pass after the other -------------------------------------------------------------

    def _survive_pass(self) -> None:
        """Make one pass; a trip or a hold stops the motion and does not end the session."""
        try:
            with self._watch.first_cause():
                self._pass()
        except TripError as trip:
            self._after_trip(trip)
        except HoldError as hold:
            self._watch.hold_is_known()
            why = f"{PAUSE} (Ctrl-Z continues)" if hold.message == PAUSE else hold.message
            self._perform(self._jog.block(why))

    def _pass(self) -> None:
        self._clock.sleep(TICK_S)
        if self._watch.hold_is_over():
            self._perform(self._jog.unblock())
        chosen = self._jog.chosen.name
        self._drives.poll(chosen)
        for key in _urgent_alone(self._person.keys()):
            actions = self._jog.press(key, self._clock.now(), self._drives.positions[chosen])
            self._perform(actions)
            if any(isinstance(action, StopAxes | HomeAxis) for action in actions):
                break  # Later keys were pressed before the operator saw the bench stop.
        if (moving := self._jog.moving) is not None:
            self._drives.check_motion(moving.name)
        largest_N = self._watch.read_force()
        self._perform(self._jog.poll(self._clock.now(), largest_N))
        self._person.show(
            JogStatus(
                self._axes,
                self._drives.positions,
                self._jog.chosen,
                self._jog.moving,
                self._watch.force_N,
                self._jog.pressed,
            )
        )

    def _after_trip(self, trip: TripError) -> None:
        """Complete the stop that the watcher began; from then on only the retreat is allowed. A
        trip during the retreat ends the session."""
        self._trips = True
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
        force_N = self._watch.read_force()
        assert force_N is not None, "only a force sensor trips"
        self._perform(self._jog.trip(force_N))
        self._trips = False

    # --- actions ------------------------------------------------------------------------------

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
                    self._watch.limit_force(limit_N)
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
                self._watch.force_in_words(),
            )
        self._drives.start(axis.name, move.target, axis.speed)

    def _halt(self, axis: JogAxis | None, why: str) -> None:
        if axis is None:
            self._stop_all()
        else:
            with self._watch.undisturbed():
                self._drives.stop_one(axis.name)
        self._log_end(why)
        self._jog.stopped(self._clock.now(), released=axis is not None)
        self._person.forget()

    def _stop_all(self) -> None:
        """Stop every axis, the moving one first; then read their positions."""
        moving = self._jog.moving
        with self._watch.undisturbed():
            self._drives.stop(None if moving is None else moving.name)

    def _home(self, axis: JogAxis) -> None:
        self._person.say(f"homing {axis.name}; any key stops it")
        log.info(
            "jog: %s homes from %.4f %s; force %s",
            axis.name,
            self._drives.positions[axis.name].position,
            axis.unit,
            self._watch.force_in_words(),
        )
        self._person.forget()
        unregister = self._clock.each_slice(self._stop_homing_at_a_key)
        try:
            self._drives.home(axis.name)
        except _HomingStoppedError as stopped:
            self._say(stopped.message)
        finally:
            unregister()
        self._halt(None, "homing")
        if self._drives.positions[axis.name].homed:
            self._say(f"{axis.name} is homed")

    def _stop_homing_at_a_key(self) -> None:
        if self._person.keys():
            raise _HomingStoppedError("homing was stopped by a key")

    # --- messages -----------------------------------------------------------------------------

    def _log_end(self, why: str) -> None:
        """Log where a motion has ended, if one was under way."""
        if (axis := self._jog.moving) is None:
            return
        log.info(
            "jog: %s came from %.4f to %.4f %s (%s); force %s",
            axis.name,
            self._began_at,
            self._drives.positions[axis.name].position,
            axis.unit,
            why,
            self._watch.force_in_words(),
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
