"""A person jogs a bench: what the keys ask for is done, watched and logged; everything is stopped
at every exit.

Arming, force watcher, holds and guard are those of a run; there is no journal, as nothing is
measured. The generator is never touched.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pydantic import Field

from rig.bench.connected import Bench
from rig.bench.limits import require
from rig.bench.plan import longest_call_s
from rig.core.errors import ConfigurationError, ExitCode, LimitError, RigError
from rig.core.settings import Settings
from rig.instruments.roles import LinearStage, Reach, RotaryStage
from rig.jog.keys import (
    LONGEST_STEP_S,
    Action,
    Axis,
    Home,
    Jog,
    Key,
    Leave,
    Move,
    Place,
    Say,
    Stop,
    Watch,
)
from rig.run.arming import BEAT_EVERY_S, OFF_DEADLINE_S, Arming, OffFailure
from rig.run.force_monitor import ForceMonitor
from rig.run.guard import GuardLink
from rig.run.holds import HoldError, Holds, PauseSwitch
from rig.run.stopping import StopFlag
from rig.run.trip import TripError

AXES = ("stage_z", "stage_x", "rotary")
"""Roles that can be jogged."""
OFF = {"stage_z": Key.LESS}
"""What leads off what is pressed: the z stage counts downwards, towards contact."""
FASTEST = {"mm": 1.0, "deg": 2.0}
"""A second, by unit: a person sees what happens in time."""
TURN_ACCELERATION_deg_s2 = 100.0
FORCE_RATE_S_S = 500.0
TICK_S = 0.02
FORCE_OVER_S = 0.02
"""What the force shown and judged is the mean of; the watcher sees every frame."""
OTHERS_EVERY_S = 0.5
"""How often the axes that nobody moves are looked at."""

log = logging.getLogger("rig")

Vector = tuple[float, float, float]


class JogSettings(Settings):
    """How far and how fast a key moves an axis."""

    step_mm: float = Field(default=0.1, gt=0)
    """What one press moves a linear axis by."""
    speed_mm_s: float = Field(default=FASTEST["mm"], gt=0)
    """Of linear axes; the largest is the default."""
    angle_step_deg: float = Field(default=0.2, gt=0)
    """What one press turns the rotary stage by."""
    turn_speed_deg_s: float = Field(default=FASTEST["deg"], gt=0)
    """Of the rotary stage; the largest is the default."""
    largest_force_N: float = Field(default=5.0, gt=0)
    """Along any axis of the force sensor, which is not tared; over it everything stops."""


@dataclass(frozen=True)
class Status:
    """What a person at the keys is shown."""

    axes: tuple[Axis, ...]
    places: Mapping[str, Place]
    chosen: Axis
    moving: Axis | None
    force_N: Vector | None
    """None on a bench without a force sensor."""
    pressed: bool


class Person(Protocol):
    """Who is at the keys."""

    def keys(self) -> list[Key]:
        """What was pressed since the last look, oldest first; never waits. A RigError where nobody
        is there any more."""
        ...

    def forget(self) -> None:
        """What was pressed up to now does not count."""
        ...

    def say(self, text: str) -> None:
        """Tell them once."""
        ...

    def show(self, status: Status) -> None:
        """How things are."""
        ...


@dataclass
class Ended:
    """How a session ended."""

    code: ExitCode = ExitCode.DONE
    failures: list[RigError] = field(default_factory=list)
    off_failures: list[OffFailure] = field(default_factory=list)


class _Linear:
    """A linear stage, as this module moves axes."""

    def __init__(self, stage: LinearStage):
        self.stage: LinearStage | RotaryStage = stage
        self.position = stage.position_mm
        self.start = stage.start_move


class _Rotary:
    """A rotary stage, likewise."""

    def __init__(self, stage: RotaryStage):
        self.stage: LinearStage | RotaryStage = stage
        self.position = stage.angle_deg
        largest = stage.reach()["acceleration"].high
        self._acceleration_deg_s2 = min(TURN_ACCELERATION_deg_s2, largest)

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """Begin to turn there, or change the turn under way."""
        self.stage.start_turn(angle_deg, speed_deg_s, self._acceleration_deg_s2)  # type: ignore[union-attr]


def axes_of(bench: Bench, settings: JogSettings) -> tuple[list[Axis], list[str]]:
    """The bench's axes as they are jogged, and what was limited, in words.

    ConfigurationError for a bench that has none.
    """
    axes, limited = [], []
    for name in AXES:
        if name not in bench.instruments:
            continue
        reach = bench.instruments[name].reach()
        turns = name == "rotary"
        places = reach["angle" if turns else "position"]
        step = settings.angle_step_deg if turns else settings.step_mm
        asked = settings.turn_speed_deg_s if turns else settings.speed_mm_s
        speed = _speed(asked, places.unit, reach["speed"])
        if speed != asked:
            limited.append(f"{name}: speed {asked:g} is limited to {speed:g} {places.unit}/s")
        if step > (longest := speed * LONGEST_STEP_S):
            limited.append(
                f"{name}: step {step:g} is limited to {longest:.3g} {places.unit}, which takes "
                f"{LONGEST_STEP_S:g} s at {speed:g} {places.unit}/s"
            )
            step = longest
        axes.append(Axis(name, places.unit, places.low, places.high, step, speed, OFF.get(name)))
    if not axes:
        raise ConfigurationError(
            f"{bench.plan.source}: the bench has no axis", f"add a table of {', '.join(AXES)}"
        )
    return axes, limited


def _speed(asked: float, unit: str, reach: Reach) -> float:
    return min(max(min(asked, FASTEST[unit]), reach.low), reach.high)


class _HomingStoppedError(RigError):
    """A key was pressed while an axis homed."""


class JogSession:
    """One session on a connected bench, from arming to rest."""

    def __init__(
        self,
        bench: Bench,
        settings: JogSettings,
        chosen: str | None,
        stop: StopFlag,
        person: Person,
    ):
        """ConfigurationError where the bench has no such axis, LimitError for a largest force that
        the sensor does not reach."""
        axes, limited = axes_of(bench, settings)
        names = [axis.name for axis in axes]
        if chosen is not None and chosen not in names:
            raise ConfigurationError(
                f"{bench.plan.source}: the bench has no axis {chosen}", f"it has {', '.join(names)}"
            )
        if "force_sensor" in bench.instruments:
            reach = bench.force_sensor.reach()["force"]
            require("largest force", settings.largest_force_N, reach)
        self._bench, self._clock, self._stop = bench, bench.clock, stop
        self._person, self._settings = person, settings
        self._guard: GuardLink
        self._axes = {axis.name: axis for axis in axes}
        self._drives: dict[str, _Linear | _Rotary] = {
            name: _Rotary(bench.rotary) if name == "rotary" else _Linear(getattr(bench, name))
            for name in names
        }
        self._jog = Jog(axes, settings.largest_force_N, chosen or names[0])
        self._limited = limited
        self._arming = Arming(overlapping=not bench.clock.is_virtual)
        self._holds = Holds()
        self._force: ForceMonitor | None = None
        self._force_N: Vector | None = None
        self._places: dict[str, Place] = {}
        self._others_at_s = 0.0
        self._began_at = 0.0
        self._undisturbed = self._homing = self._blocked = self._left = False
        self._last_beat_s = 0.0
        self._guard_missed = False

    def go(self, guard: GuardLink) -> Ended:
        """Jog until the person leaves, a signal comes or something fails; then stop everything.
        Never raises a RigError."""
        ended = Ended()
        self._guard = guard
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
        return ended

    # --- beginning and end --------------------------------------------------------------------

    def _begin(self) -> None:
        waits_s = max(longest_call_s(part.settings) for part in self._bench.plan.instruments)
        deadline_s = OFF_DEADLINE_S + waits_s
        if "force_sensor" in self._bench.instruments:
            sensor = self._bench.force_sensor
            monitor = ForceMonitor(sensor, self._clock, self._holds, self._arming.act_at_once)
            self._arming.register("force stream", monitor.stop, deadline_s, watches=True)
            monitor.start(min(FORCE_RATE_S_S, sensor.reach()["rate"].high))
            self._force = monitor
        else:
            self._person.say("this bench has no force sensor: nobody watches how hard it presses")
        for name, drive in self._drives.items():
            self._arming.register(name, drive.stage.stop, deadline_s, drive.stage.make_safe)
        self._stop_all()
        for text in self._limited:
            self._person.say(text)
        if self._force is not None:
            self._force.watch(self._settings.largest_force_N)

    def _make_safe(self, ended: Ended) -> None:
        self._undisturbed = True
        with self._bench.links.making_safe():
            failures = self._arming.make_safe(self._guard.beat)
        if (moved := self._jog.moving) is not None:
            with contextlib.suppress(RigError):
                self._look_at(moved.name)
            self._log_end("the session ended")
        for failure in failures:
            if failure.watches:
                text = f"{failure.name}: {failure.reason}"
                ended.failures.append(RigError(text, None, ExitCode.INSTRUMENT))
                ended.code = ended.code or ExitCode.INSTRUMENT
            else:
                ended.off_failures.append(failure)
                ended.code = ExitCode.UNSAFE
        if not ended.off_failures:
            self._guard.safe()

    # --- what every wait looks at -------------------------------------------------------------

    def _each_slice(self) -> None:
        now = time.monotonic()
        if now - self._last_beat_s >= BEAT_EVERY_S:
            self._last_beat_s = now
            self._guard.beat()
        if self._undisturbed:
            return
        self._stop.check()
        if self._force is not None:
            self._force.check()
        if not self._blocked:
            self._holds.check()
        if self._homing and self._person.keys():
            raise _HomingStoppedError("homing was stopped by a key")
        if self._guard.lost and not self._guard_missed:
            self._guard_missed = True
            self._tell("the guard has died: if this program dies as well, only the drives stop")

    @contextlib.contextmanager
    def _first_cause(self) -> Iterator[None]:
        """What the watcher stopped the bench over comes before what a call then met."""
        try:
            yield
        except RigError:
            if self._force is not None:
                self._force.settle()
                self._force.check_trip()
            raise

    @contextlib.contextmanager
    def _no_disturbance(self) -> Iterator[None]:
        """Within it nothing but a drive ends a wait: something is being stopped."""
        before, self._undisturbed = self._undisturbed, True
        try:
            yield
        finally:
            self._undisturbed = before

    # --- one look after the other -------------------------------------------------------------

    def _survive_pass(self) -> None:
        """One pass; a trip or a hold stops what moves and does not end the session."""
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
        self._look_at_places()
        chosen = self._jog.chosen.name
        for key in _urgent_alone(self._person.keys()):
            actions = self._jog.press(key, self._clock.now(), self._places[chosen])
            self._perform(actions)
            if any(isinstance(action, Stop | Home) for action in actions):
                break  # what was typed after it was typed at a bench that moved
        if (moving := self._jog.moving) is not None:
            self._drives[moving.name].stage.moving()  # raises what ended it
        largest_N = self._feel()
        self._perform(self._jog.look(self._clock.now(), largest_N))
        self._person.show(
            Status(
                tuple(self._axes.values()),
                self._places,
                self._jog.chosen,
                self._jog.moving,
                self._force_N,
                self._jog.pressed,
            )
        )

    def _after_trip(self, trip: TripError) -> None:
        """All axes have been told to stop by the watcher; see to it, then only the way off is left.
        A trip on that way ends the session."""
        self._stop_all()
        self._log_end("tripped")
        self._tell(f"stopped: {trip.message}")
        again = self._jog.pressed
        self._jog.stopped(self._clock.now())
        if again:
            raise LimitError(
                f"{trip.message} on the way off: the force does not fall",
                "free what is pressed by hand, with the drives without power",
            ) from trip
        force_N = self._feel()
        assert force_N is not None, "only a force sensor trips"
        self._perform(self._jog.trip(force_N))

    # --- doing --------------------------------------------------------------------------------

    def _perform(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case Move():
                    self._move(action)
                case Stop(axis, why):
                    self._halt(axis, why)
                case Home(axis):
                    self._home(axis)
                case Watch(limit_N):
                    assert self._force is not None, "only a force sensor trips"
                    self._force.watch(limit_N)
                case Say(text):
                    self._tell(text)
                case Leave():
                    self._left = True

    def _move(self, move: Move) -> None:
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

    def _halt(self, axis: Axis | None, why: str) -> None:
        if axis is None:
            self._stop_all()
        else:
            with self._no_disturbance():
                self._drives[axis.name].stage.stop()
            self._look_at(axis.name)
        self._log_end(why)
        self._jog.stopped(self._clock.now(), released=axis is not None)
        self._person.forget()

    def _stop_all(self) -> None:
        """Every axis, the moving one first; then where they are."""
        moving = self._jog.moving
        names = sorted(self._drives, key=lambda name: moving is None or name != moving.name)
        with self._no_disturbance():
            for name in names:
                self._drives[name].stage.stop()
            for name in names:
                homed = self._drives[name].stage.homed()
                self._places[name] = Place(self._drives[name].position(), homed)

    def _home(self, axis: Axis) -> None:
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
            self._tell(stopped.message)
        finally:
            self._homing = False
        self._halt(None, "homing")
        if self._places[axis.name].homed:
            self._tell(f"{axis.name} is homed")

    # --- looking and telling ------------------------------------------------------------------

    def _look_at_places(self) -> None:
        now = self._clock.now()
        others = now - self._others_at_s >= OTHERS_EVERY_S
        if others:
            self._others_at_s = now
        for name in self._drives:
            if others or name == self._jog.chosen.name:
                self._look_at(name)

    def _look_at(self, name: str) -> None:
        self._places[name] = Place(self._drives[name].position(), self._places[name].homed)

    def _feel(self) -> float | None:
        """The largest force along any axis, in N; None where nothing measures it."""
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
        """Where a motion has ended, if one was under way."""
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

    def _tell(self, text: str) -> None:
        log.info("jog: %s", text)
        self._person.say(text)


def _urgent_alone(keys: list[Key]) -> list[Key]:
    """Of several keys at once: what stops, if any does; else each that differs from the last."""
    for urgent in (Key.LEAVE, Key.STOP):
        if urgent in keys:
            return [urgent]
    return [key for n, key in enumerate(keys) if n == 0 or key is not keys[n - 1]]
