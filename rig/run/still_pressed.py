"""Determines what is still pressed on a bench that was stopped, and lifts z off it where it may.

A bench that was made safe is stopped and switched off. Whether its object is still under force is
another question, which the guard answers with a measurement of its own, before a lift and after it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from rig.bench.apply_calibrations import apply_calibrations
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan, parse_bench
from rig.core.clock import WallClock
from rig.core.errors import RigError
from rig.instruments.roles import Instrument
from rig.run.interlock_store import InterlockStore
from rig.run.lift import Lift

ROLES = ("stage_z", "force_sensor")
RATE_S_S = 500.0
SECONDS = 0.3
"""Time in s over which the force is averaged: above the sensor's noise, and within a person's
patience."""
PRESSED_N = 0.4
"""Force above which something is pressed: far above the sensor's noise and its drift in a run."""

LATEST = 5
"""Fewest frames that the first force of a lift is the mean of."""

Zero = tuple[float, float, float]


@dataclass(frozen=True)
class PressedState:
    """Statement on whether something is pressed, and the reason why that is not safe."""

    text: str
    """End of a sentence on the bench, such as "still pressed at 12.44 mm, 3.9 N"."""
    over_limit: str | None = None
    """The same, if the force is over the limit of the sensor; else None."""


def pressed_state(
    bench_toml: str, source: str, zero: Zero | None, *, lasting: bool = False
) -> PressedState:
    """Connect to z and force sensor of a bench that was stopped, read both, lift z off what it may
    press (`rig.run.lift`), read both again, and leave z stopped.

    `zero` is the raw reading of the sensor without force, as the run found it; None if it found
    none: then the sensor's own zero is part of what it reads. `lasting` says whether the bench has
    records of interlocks that outlive the run. A bench that cannot be read is not an error: the
    text says so.
    """
    try:
        return _measured(bench_toml, source, zero, lasting)
    except (RigError, OSError) as error:
        why = error.one_line() if isinstance(error, RigError) else str(error)
        return PressedState(f"not known whether something is still pressed: {why}")


def _measured(bench_toml: str, source: str, zero: Zero | None, lasting: bool) -> PressedState:
    whole = parse_bench(bench_toml, source)
    parts = {part.role: part for part in whole.instruments if part.role in ROLES}
    if "stage_z" not in parts:
        return PressedState("nothing can be pressed without a stage_z")
    plan = replace(whole, instruments=tuple(parts.values()))
    with contextlib.closing(connect(plan, WallClock())) as bench:
        sensor = _Sensor(bench, zero) if "force_sensor" in parts else None
        try:
            found = _state(bench, sensor)
            return _lifted(bench, whole, sensor, found, lasting)
        finally:
            bench.stage_z.make_safe()  # connecting may have lifted a stop that stood


def _lifted(
    bench: Bench, whole: BenchPlan, sensor: _Sensor | None, found: PressedState, lasting: bool
) -> PressedState:
    """Lift z where it stands in the range of contact, and return what is pressed then; with the
    reason where it is not lifted."""
    with _readers(bench, whole) as readers:
        lift = Lift(bench, readers, InterlockStore(whole, lasting=lasting))
        if not lift.is_needed():
            return found
        try:
            lift.carry_out(sensor.latest_N if sensor is not None else lambda: None)
        except (RigError, OSError) as error:
            why = error.message if isinstance(error, RigError) else str(error)
            now = _state(bench, sensor)
            over = now.over_limit and f"{now.over_limit}; not lifted: {why}"
            # A sensor that is dead reads no force either.
            stands = now.text.replace("nothing is pressed", "the force sensor reads no force")
            return PressedState(f"{stands}; not lifted: {why}", over)
    now = _state(bench, sensor)
    was = found.text.replace("still pressed", "was pressed").replace(" stands ", " stood ")
    return PressedState(f"{was}; stage_z was lifted: {now.text}", now.over_limit)


@contextlib.contextmanager
def _readers(bench: Bench, whole: BenchPlan) -> Iterator[dict[str, Instrument]]:
    """The instruments that read the bench's contacts, as far as they can be connected."""
    roles = {one.role for one in whole.settings.interlock} - set(bench.instruments)
    with contextlib.ExitStack() as stack:
        found = dict(bench.instruments)
        for part in whole.instruments:
            if part.role not in roles:
                continue
            with contextlib.suppress(RigError, OSError):
                plan = replace(whole, instruments=(part,))
                reader = stack.enter_context(contextlib.closing(connect(plan, WallClock())))
                found |= reader.instruments
        yield found


def _state(bench: Bench, sensor: _Sensor | None) -> PressedState:
    """Return where z stands and what is pressed there."""
    stands = f"{bench.stage_z.position_mm():.2f} mm"
    if sensor is None:
        return PressedState(
            f"stage_z stands at {stands}; what is pressed is not known without a force sensor"
        )
    force_N = sensor.mean_N()
    if not sensor.zeroed:
        return PressedState(
            f"stage_z stands at {stands}, the force sensor reads {force_N:.1f} N and was not "
            "zeroed by the run"
        )
    if force_N <= PRESSED_N:
        return PressedState(f"nothing is pressed at {stands}, {force_N:.1f} N")
    text = f"still pressed at {stands}, {force_N:.1f} N"
    limit_N = bench.force_sensor.reach()["force"].high
    over = f"{text}, over the limit of {limit_N:g} N" if force_N > limit_N else None
    return PressedState(text, over)


class _Sensor:
    """The force sensor of a bench that was stopped."""

    def __init__(self, bench: Bench, zero: Zero | None):
        apply_calibrations(bench, datetime.now().astimezone(), allow_expired=True)
        self._bench, self._sensor = bench, bench.force_sensor
        self.zeroed = zero is not None
        if zero is not None:
            self._sensor.tare(zero)
        self._latest_N: float | None = None
        self._streams = False

    def mean_N(self) -> float:  # noqa: N802 - the unit keeps its capital, here and below
        """Return the largest mean force along any axis over `SECONDS` from now on. Raises
        InstrumentError if no frame comes."""
        if self._streams:
            self._sensor.stop()
            self._streams = False
        rate_S_s = self._sensor.start(min(RATE_S_S, self._sensor.reach()["rate"].high))
        try:
            forces = _frames(self._bench, round(SECONDS * rate_S_s))
        finally:
            self._sensor.stop()
        return _largest_N(forces)

    def latest_N(self) -> float | None:  # noqa: N802
        """Return the largest mean force along any axis of the latest frames; starts to stream. None
        where the sensor cannot be read."""
        try:
            if not self._streams:
                self._sensor.start(min(RATE_S_S, self._sensor.reach()["rate"].high))
                self._streams = True
                self._latest_N = _largest_N(_frames(self._bench, LATEST))
            elif (frames := self._sensor.read()) is not None and len(frames):
                self._latest_N = _largest_N(frames.force_N)
        except RigError:
            self._latest_N = None
        return self._latest_N


def _largest_N(forces: np.ndarray) -> float:  # noqa: N802
    return float(np.abs(forces.mean(axis=0)).max())


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
