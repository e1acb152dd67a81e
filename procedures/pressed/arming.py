"""The arming of a trial with the skin pressed on an object.

The skin hangs on the x-z stage above the object, which stands on the force sensor. A trial goes
down until the object is felt, brings the normal force up and holds it by a servo on z while
something moves, and lifts off. Whatever ends it, what moves stops first, then z goes up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.approach.contact import arm_from_where_it_stands, park, stream_force
from procedures.pressed.approach.unload import say_if_lost, unload
from rig.core.errors import RigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rig.run.context import Run

MIN_FORCE_RATE_S_S = 100.0
"""Minimum number of frames a second of a force sensor: below, a frame is longer than the tap's way
back, so that the clocks could not be compared, and some ticks bring the servo no new force."""


def arm_pressed(
    run: Run,
    what: str,
    stop: Callable[[], None],
    emergency: Callable[[], None],
    done: str,
    tick_Hz: float,
) -> None:
    """Watch the force; register the end of everything before it begins; park.

    `what` moves under the held force; it is ended by `stop`, or by `emergency` where a watcher
    acts; `done` is what a person reads when it has ended. LimitError before any motion for a force
    sensor with less than `MIN_FORCE_RATE_S_S`, or less than a frame for each of `tick_Hz` ticks a
    second.
    """
    bench, settings = run.bench, run.settings
    least_S_s = max(MIN_FORCE_RATE_S_S, tick_Hz)

    def lift(came_from_mm: float) -> None:
        _lift(run, what, stop, came_from_mm)

    arm_from_where_it_stands(run, "normal force", lift)
    stream_force(run, least_S_s, f"a trial whose servo acts at {tick_Hz:g} Hz")
    run.force.watch(settings.largest_force_N)
    # Last, since a DAQ that hangs keeps no skin pressed.
    run.arm("acquisition", bench.daq.stop, drives=False)
    run.arm(what, stop, emergency=emergency, done=done)
    stop()
    park(run, "normal force", lift)
    if not bench.stage_x.homed():  # only now: the skin is clear of everything
        bench.stage_x.home()


def _lift(run: Run, what: str, stop: Callable[[], None], came_from_mm: float) -> None:
    """Stop, what moves first; then away from the object, if the drive still can. An instrument that
    does not answer its stop does not keep the skin pressed."""
    say_if_lost(run)
    try:
        run.arming.begin(what, stop)
    except RigError as error:  # its own off says so, too: up is what matters here
        run.event("warning", f"{what}-not-stopped", error.one_line())
    unload(run, "skin", came_from_mm)
