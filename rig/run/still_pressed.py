"""Determines what is still pressed on a bench that was stopped: the position of z, and the force.

A bench that was made safe is stopped and switched off. Whether its object is still under force is
another question, which the guard answers with a measurement of its own.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from rig.bench.apply_calibrations import apply_calibrations
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.plan import parse_bench
from rig.core.clock import WallClock
from rig.core.errors import RigError

ROLES = ("stage_z", "force_sensor")
RATE_S_S = 500.0
SECONDS = 0.3
"""Time in s over which the force is averaged: above the sensor's noise, and within a person's
patience."""
PRESSED_N = 0.4
"""Force above which something is pressed: far above the sensor's noise and its drift in a run."""

Zero = tuple[float, float, float]


@dataclass(frozen=True)
class PressedState:
    """Statement on whether something is pressed, and the reason why that is not safe."""

    text: str
    """End of a sentence on the bench, such as "still pressed at 12.44 mm, 3.9 N"."""
    over_limit: str | None = None
    """The same, if the force is over the limit of the sensor; else None."""


def pressed_state(bench_toml: str, source: str, zero: Zero | None) -> PressedState:
    """Connect to z and force sensor of a bench that was stopped, read both, and leave z stopped.

    `zero` is the raw reading of the sensor without force, as the run found it; None if it found
    none: then the sensor's own zero is part of what it reads. A bench that cannot be read is not an
    error: the text says so.
    """
    try:
        return _measured(bench_toml, source, zero)
    except (RigError, OSError) as error:
        why = error.one_line() if isinstance(error, RigError) else str(error)
        return PressedState(f"not known whether something is still pressed: {why}")


def _measured(bench_toml: str, source: str, zero: Zero | None) -> PressedState:
    plan = parse_bench(bench_toml, source)
    parts = {part.role: part for part in plan.instruments if part.role in ROLES}
    if "stage_z" not in parts:
        return PressedState("nothing can be pressed without a stage_z")
    plan = replace(plan, instruments=tuple(parts.values()))
    with contextlib.closing(connect(plan, WallClock())) as bench:
        stands = f"{bench.stage_z.position_mm():.2f} mm"
        force_N = _force_N(bench, zero) if "force_sensor" in parts else None
        bench.stage_z.make_safe()  # connecting may have lifted a stop that stood
        if force_N is None:
            return PressedState(
                f"stage_z stands at {stands}; what is pressed is not known without a force sensor"
            )
        if zero is None:
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


def _force_N(bench: Bench, zero: Zero | None) -> float:  # noqa: N802 - the unit keeps its capital
    """Return the largest mean force along any axis. Raises InstrumentError if no frame comes."""
    apply_calibrations(bench, datetime.now().astimezone(), allow_expired=True)
    sensor = bench.force_sensor
    if zero is not None:
        sensor.tare(zero)
    rate_S_s = sensor.start(min(RATE_S_S, sensor.reach()["rate"].high))
    try:
        forces = _frames(bench, round(SECONDS * rate_S_s))
    finally:
        sensor.stop()
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
