"""Live values of a bench without a run: force sensor and DAQ are read, nothing else is connected.

Stages and generator are left alone: their drivers set limits, and lift a stop that stands, as they
connect. So nothing moves and nothing is switched. The bench is locked meanwhile as for a run, since
an instrument answers one program at a time.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import TypeVar

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rig.bench.apply_calibrations import apply_calibrations
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan
from rig.core.clock import WallClock
from rig.core.errors import ConfigurationError
from rig.instruments.roles import Acquisition, InputChannel
from rig.page.terminal import BAR_BINS, DRAWN_EVERY_S, add_value, value_table

ROLES = ("force_sensor", "daq")
FORCE_S_S = 100.0
DAQ_S_S = 1000.0
AXES = ("x", "y", "z")
T = TypeVar("T")


@dataclass
class Value:
    """The latest mean of a channel, with those before it."""

    units: str
    latest: float
    history: deque[float | None] = field(default_factory=lambda: deque(maxlen=BAR_BINS))

    def add(self, value: float) -> None:
        """Add a mean."""
        self.latest = value
        self.history.append(value)


def sensors_of(plan: BenchPlan) -> BenchPlan:
    """Return the plan with its sensors only. Raises ConfigurationError if it has none."""
    parts = tuple(part for part in plan.instruments if part.role in ROLES)
    if not parts:
        raise ConfigurationError(
            f"{plan.source}: the bench has neither a force sensor nor a DAQ to read",
            "name another bench file with --bench",
        )
    return replace(plan, instruments=parts)


def show_sensors(plan: BenchPlan, console: Console, go_on: Callable[[], bool]) -> None:
    """Connect to the sensors of a bench and show their values until `go_on` returns False.

    The caller holds the bench's lock. Raises RigError if a sensor cannot be read.
    """
    plan = sensors_of(plan)
    with contextlib.closing(connect(plan, WallClock())) as bench:
        apply_calibrations(bench, datetime.now().astimezone(), allow_expired=True)
        values: dict[str, Value] = {}
        with _streaming(bench), Live(console=console, auto_refresh=False) as live:
            while go_on():
                bench.clock.sleep(DRAWN_EVERY_S)
                _read(bench, values)
                live.update(_panel(plan, values), refresh=True)


@contextlib.contextmanager
def _streaming(bench: Bench) -> Iterator[None]:
    """Have the sensors send within the block."""
    there = bench.instruments
    with contextlib.ExitStack() as at_the_end:  # each is stopped, also where another's stop fails
        if "force_sensor" in there:
            at_the_end.callback(bench.force_sensor.stop)
            bench.force_sensor.start(FORCE_S_S)
        if "daq" in there:
            at_the_end.callback(bench.daq.stop)
            bench.daq.start(_acquisition(bench))
        yield


def _acquisition(bench: Bench) -> Acquisition:
    part = next(part for part in bench.plan.instruments if part.role == "daq")
    names = tuple(getattr(part.settings, "channels", {}))
    widest_V = bench.daq.ranges_V()[-1]
    channels = tuple(InputChannel(name, widest_V) for name in names)
    return Acquisition(channels, DAQ_S_S, round(DAQ_S_S * DRAWN_EVERY_S / 2))


def _read(bench: Bench, values: dict[str, Value]) -> None:
    """Take in everything that has come, and add its mean."""
    there = bench.instruments
    if "force_sensor" in there:
        frames = [batch.force_N for batch in come(bench.force_sensor.read)]
        if frames:
            mean = np.concatenate(frames).mean(axis=0)
            for axis, force_N in zip(AXES, mean, strict=True):
                _add(values, f"force {axis}", "N", float(force_N))
    if "daq" in there:
        blocks = list(come(bench.daq.read))
        for channel in blocks[-1].scaling.channels if blocks else ():
            volts = np.concatenate([record.volts(channel) for record in blocks])
            _add(values, channel, "V", float(volts.mean()))


def come(read: Callable[[], T | None]) -> Iterator[T]:
    """Yield what `read` returns until it returns None; no longer than one drawing takes, since on a
    busy computer something new may come before every reading."""
    until_s = time.monotonic() + DRAWN_EVERY_S
    while (one := read()) is not None:
        yield one
        if time.monotonic() > until_s:
            return


def _add(values: dict[str, Value], name: str, units: str, value: float) -> None:
    values.setdefault(name, Value(units, value)).add(value)


def _panel(plan: BenchPlan, values: dict[str, Value]) -> Group:
    parts: list[Text | Table] = []
    if plan.settings.simulation is not None:
        parts.append(Text(" SIMULATED: these are not measurements ", "bold white on purple"))
    parts.append(
        Text(f"bench {plan.settings.name}: no run; sensors only, forces as they are, not tared")
    )
    table = value_table()
    for name, value in values.items():
        add_value(table, name, value.latest, value.units, list(value.history))
    parts.append(table)
    return Group(*parts)
