"""Determines what is still pressed on a bench that was stopped, and lifts z off it where it may.

A bench that was made safe is stopped and switched off. Whether its object is still under force is
another question, which the guard answers with a measurement of its own, before a lift and after it.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from rig.bench.apply_calibrations import apply_calibrations, with_force_record_only
from rig.bench.clear_of_contact import PRESSED_N
from rig.bench.connect import connect
from rig.bench.connected import Bench, close_all
from rig.bench.plan import BenchPlan, parse_bench
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, RigError
from rig.instruments.roles import Instrument
from rig.run.interlocks.store import InterlockStore
from rig.run.making_safe.lift import Lift

RATE_S_S = 500.0
SECONDS = 0.3
"""Time in s over which the force is averaged: above the sensor's noise, and within a person's
patience."""
AGAIN_S, AGAIN_EVERY_S = 5.0, 0.5
"""Time in s for which a z that does not answer is tried again, and the pause before each try."""

LATEST = 5
"""Minimum number of frames that the first force of a lift is the mean of."""

Zero = tuple[float, float, float]


@dataclass(frozen=True)
class PressedState:
    """Statement on whether something is pressed, and the reason why that is not safe."""

    text: str
    """End of a sentence on the bench, such as "still pressed at 12.44 mm, 3.9 N"."""
    over_limit: str | None = None
    """The same, if the force is over its limit; else None."""
    released: bool = False
    """True if z is known to stand clear of contact, and nothing is felt."""
    answered: bool = True
    """False if z did not answer, or not any more on its way up: it may do so a moment later."""


@dataclass(frozen=True)
class Orders:
    """What the run has left to its guard."""

    zero: Zero | None = None
    """Raw reading of the force sensor without force, as the run found it; None if it found none:
    then the sensor's own zero is part of what it reads."""
    limit_N: float = math.inf
    """Force that the run watched for; the sensor's own range is another limit."""
    lasting: bool = False
    """Whether the bench has records of interlocks that outlive the run."""
    lifts: bool = True
    """False where a person is at the bench, who decides what moves."""
    within_s: float = math.inf
    """Time in s after which nothing may move any more."""


def pressed_state(bench_toml: str, source: str, orders: Orders) -> PressedState:
    """Connect to z and force sensor of a bench that was stopped, read both, lift z off what it may
    press (`rig.run.making_safe.lift`), read both again, and leave z stopped.

    z is lifted without a force sensor, too, where that does not answer. Where z itself does not it
    is tried again, for `AGAIN_S`. A bench that cannot be read is not an error: the text says so.
    """
    begun_s = time.monotonic()
    while True:
        passed_s = time.monotonic() - begun_s
        try:
            now = replace(orders, within_s=orders.within_s - passed_s)
            state = _measured(parse_bench(bench_toml, source), now)
        except Exception as error:  # noqa: BLE001 - the guard has to report, whatever it met
            text = f"not known whether something is still pressed: {_why(error)}"
            state = PressedState(text, answered=not isinstance(error, InstrumentError))
        if state.answered or time.monotonic() - begun_s > AGAIN_S:
            return state
        time.sleep(AGAIN_EVERY_S)


def _measured(whole: BenchPlan, orders: Orders) -> PressedState:
    """Connect to z and whatever helps to judge it, and lift z off what it may press; z is stopped
    at the end. Raises RigError or OSError for a z that cannot be reached."""
    parts = {part.role: part for part in whole.instruments}
    if "stage_z" not in parts:
        return PressedState("nothing can be pressed without a stage_z", released=True)
    plan, clock = replace(whole, instruments=(parts["stage_z"],)), WallClock()
    with contextlib.closing(connect(plan, clock)) as bench:
        until_s = clock.now() + orders.within_s
        try:
            with _others(whole, bench) as others:
                sensor = _Sensor(others.get("force_sensor"), orders)
                readers = dict(bench.instruments)
                for other in others.values():
                    if isinstance(other, Bench):
                        readers |= other.instruments
                store = InterlockStore(whole, lasting=orders.lasting)
                lift = Lift(bench, readers, store, until_s)
                return _lifted(bench, sensor, lift, orders)
        finally:
            bench.stage_z.make_safe()  # connecting may have lifted a stop that stood


def _lifted(bench: Bench, sensor: _Sensor, lift: Lift, orders: Orders) -> PressedState:
    """Lift z where it stands in the range of contact, and return what is pressed then; with the
    reason where it is not lifted."""
    before = _look(bench, sensor, lift)
    if before.clear or not orders.lifts:
        return before.state()
    try:
        lift.carry_out(sensor.latest_N)
    except (RigError, OSError) as error:
        state = _look(bench, sensor, lift).state(f"; not lifted: {_why(error)}")
        return replace(state, answered=not isinstance(error, InstrumentError))
    after = _look(bench, sensor, lift)
    text = f"{before.in_words(past=True)}; stage_z was lifted: {after.in_words()}"
    # It has moved off what it pressed, whether or not a force sensor shows it.
    released = after.clear and not after.is_pressed
    return replace(after.state(), text=text, released=released)


def _why(error: BaseException) -> str:
    """Return the cause of an error, with its remedy where it has one."""
    if isinstance(error, RigError):
        return error.one_line()
    if isinstance(error, OSError):
        return str(error)
    return f"{type(error).__name__}: {error}"


@contextlib.contextmanager
def _others(whole: BenchPlan, bench: Bench) -> Iterator[dict[str, Bench | BaseException]]:
    """Connect the force sensor and the instruments that read contacts, each by itself.

    Yield them by their roles; for one that cannot be connected, the exception.

    They use the clock of z, so that a wait for one of them feeds every drive. Each is made safe at
    the end: connecting may have lifted a stop that stood.
    """
    roles = {"force_sensor"} | {one.role for one in whole.settings.interlock}
    found: dict[str, Bench | BaseException] = {}
    with contextlib.ExitStack() as stack:
        for part in whole.instruments:
            if part.role not in roles - set(bench.instruments):
                continue
            try:
                other = connect(replace(whole, instruments=(part,)), bench.clock)
            except (RigError, OSError) as error:
                found[part.role] = error
                continue
            stack.callback(close_all, other.instruments)
            stack.callback(other.links.close)
            stack.callback(_make_safe, other.instruments[part.role])
            found[part.role] = other
        yield found


def _make_safe(instrument: Instrument) -> None:
    with contextlib.suppress(RigError, OSError):
        instrument.make_safe()


@dataclass(frozen=True)
class _Look:
    """One look at z and the force sensor of a bench that was stopped."""

    position_mm: float
    clear: bool
    """True if z stands clear of contact."""
    force_N: float | None
    """Largest mean force along any axis; None where it is not known."""
    zeroed: bool
    limit_N: float
    no_force: str
    """Reason why the force is not known."""
    has_sensor: bool
    """False on a bench without a force sensor."""

    def in_words(self, past: bool = False) -> str:
        """Return the end of a sentence on the bench, as it is or as it was."""
        at = f"at {self.position_mm:.2f} mm"
        stands = "stage_z was" if past else "stage_z is"
        if self.force_N is None:
            return f"{stands} {at}; what is pressed is not known {self.no_force}"
        reads = "read" if past else "reads"
        if not self.zeroed:
            return (
                f"{stands} {at}, the force sensor {reads} {self.force_N:.1f} N and was not zeroed "
                "by the run"
            )
        if self.is_pressed:
            return f"{'was' if past else 'still'} pressed {at}, {self.force_N:.1f} N"
        if self.clear:
            return f"nothing is pressed {at}, {self.force_N:.1f} N"
        # A sensor that is dead reads no force either.
        return f"the force sensor {reads} no force {at}, {self.force_N:.1f} N"

    def state(self, more: str = "") -> PressedState:
        """Return the statement; `more` continues its sentence."""
        over = None
        if self.force_N is not None and self.force_N > self.limit_N:
            over = f"{self.in_words()}, over the limit of {self.limit_N:g} N{more}"
        # Of what lies on a sensor that cannot be read, the place of z says nothing.
        felt = not self.has_sensor or self.force_N is not None
        released = self.clear and felt and not self.is_pressed
        return PressedState(f"{self.in_words()}{more}", over, released)

    @property
    def is_pressed(self) -> bool:
        """Whether a force is felt that the zero of the sensor does not explain."""
        return self.zeroed and self.force_N is not None and self.force_N > PRESSED_N


def _look(bench: Bench, sensor: _Sensor, lift: Lift) -> _Look:
    """Return where z stands and what is pressed there."""
    force_N = sensor.mean_N()
    position_mm, clear = bench.stage_z.position_mm(), not lift.is_needed()
    return _Look(
        position_mm,
        clear,
        force_N,
        sensor.zeroed,
        sensor.limit_N,
        sensor.trouble,
        sensor.is_there,
    )


class _Sensor:
    """The force sensor of a bench that was stopped, if it can be read."""

    def __init__(self, bench: Bench | BaseException | None, orders: Orders):
        """`bench` has the sensor alone; None where there is none, or the reason why it is not
        connected."""
        self.is_there, self.zeroed = bench is not None, orders.zero is not None
        self.limit_N = orders.limit_N
        self.trouble = "without a force sensor"
        """Reason why the latest force is not known."""
        self._bench: Bench | None = None
        self._latest_N: float | None = None
        self._streams = False
        if bench is None:
            return
        if not isinstance(bench, Bench):
            self.trouble = f"since {_why(bench)}"
            return
        try:
            bench.plan = with_force_record_only(bench.plan)
            apply_calibrations(bench, datetime.now().astimezone(), allow_expired=True)
            if orders.zero is not None:
                bench.force_sensor.tare(orders.zero)
            self.limit_N = min(orders.limit_N, bench.force_sensor.limits()["force"].high)
        except (RigError, OSError) as error:
            self.trouble = f"since {_why(error)}"
            return
        self._bench = bench

    def mean_N(self) -> float | None:  # noqa: N802 - the unit keeps its capital, here and below
        """Return the largest mean force along any axis over `SECONDS` from now on; None where the
        sensor cannot be read."""
        if self._bench is None:
            return None
        sensor = self._bench.force_sensor
        try:
            if self._streams:
                self._streams = False
                sensor.stop()
            rate_S_s = sensor.start(min(RATE_S_S, sensor.limits()["rate"].high))
            try:
                return _largest_N(_frames(self._bench, round(SECONDS * rate_S_s)))
            finally:
                sensor.stop()
        except (RigError, OSError) as error:
            self.trouble = f"since {_why(error)}"
            return None

    def latest_N(self) -> float | None:  # noqa: N802
        """Return the largest mean force along any axis of the latest frames; starts to stream. None
        where the sensor cannot be read."""
        if self._bench is None:
            return None
        sensor = self._bench.force_sensor
        try:
            if not self._streams:
                sensor.start(min(RATE_S_S, sensor.limits()["rate"].high))
                self._streams = True
                self._latest_N = _largest_N(_frames(self._bench, LATEST))
            elif (frames := sensor.read()) is not None and len(frames):
                self._latest_N = _largest_N(frames.force_N)
        except (RigError, OSError):
            self._latest_N = None
        return self._latest_N


def _largest_N(forces: np.ndarray) -> float:  # noqa: N802
    largest_N = float(np.abs(forces.mean(axis=0)).max())
    if not math.isfinite(largest_N):
        raise RigError("force_sensor: it sends forces that are not finite numbers")
    return largest_N


def _frames(bench: Bench, wanted: int) -> np.ndarray:
    found: list[np.ndarray] = []
    give_up_s = bench.clock.now() + 10 * SECONDS
    while sum(map(len, found)) < wanted:
        frames = bench.force_sensor.read()
        if frames is not None:
            found.append(frames.force_N)
        elif bench.clock.now() > give_up_s:
            raise RigError("force_sensor: too few frames come")
        else:
            bench.clock.sleep(0.01)
    return np.concatenate(found)
