"""The command ``rig jog``: move the axes of a bench by the keys of the terminal."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from rig.bench.settings import Fixture
from rig.cli.options.groups import option_group, with_option_groups
from rig.cli.options.numbers import one_of
from rig.cli.options.settings import SimulatedStages
from rig.cli.options.shared import RESULTS, BenchFile, Debug, Fault, Seed, World, WorldLog
from rig.cli.outcome import log, reported, say, say_failure, start_log
from rig.core.errors import STOPPED_BY_SIGNAL, ConfigurationError, RigError
from rig.run.bench_selector import BenchRequest, bench_file

if TYPE_CHECKING:
    from rig.cli.terminal import Terminal
    from rig.jog.axes import JogSettings
    from rig.jog.session import JogOutcome
    from rig.run.bench_selector import ChosenBench
    from rig.run.stopping import StopFlag

OWN_BENCH_REPORT = "jog.guard.json"
"""Name of the guard's report for a simulated bench that ends with the command."""


@option_group
class JogOptions:
    """The settings of hand control, as texts with units."""

    step: Annotated[
        str | None,
        typer.Option(help="Step of a linear axis per key press.  [default: 0.1 mm]", metavar="mm"),
    ] = None
    speed: Annotated[
        str | None,
        typer.Option(help="Speed of linear axes.  [default and maximum: 1 mm/s]", metavar="mm/s"),
    ] = None
    angle_step: Annotated[
        str | None,
        typer.Option(
            help="Step of the rotary stage per key press.  [default: 0.2 deg]", metavar="deg"
        ),
    ] = None
    turn_speed: Annotated[
        str | None,
        typer.Option(
            help="Speed of the rotary stage.  [default and maximum: 2 deg/s]", metavar="deg/s"
        ),
    ] = None
    largest_force: Annotated[
        str | None,
        typer.Option(
            help="Safety limit on each force axis, not tared; exceeding it stops the bench.  "
            "[default: 5 N]",
            metavar="N",
        ),
    ] = None

    def settings(self) -> JogSettings:
        """Return the validated settings. Raises ConfigurationError, which names every option that
        is wrong."""
        from rig.cli.options.settings import settings_from
        from rig.jog.axes import JogSettings

        given = {
            "step_mm": self.step,
            "speed_mm_s": self.speed,
            "angle_step_deg": self.angle_step,
            "turn_speed_deg_s": self.turn_speed,
            "largest_force_N": self.largest_force,
        }
        settings = settings_from(JogSettings, given)
        assert isinstance(settings, JogSettings)
        return settings


@option_group
class JogBench(BenchRequest):
    """The options of hand control that select its bench."""

    bench: BenchFile = None
    results: Annotated[Path, typer.Option(help="Folder for the log.", metavar="FOLDER")] = RESULTS
    stages: SimulatedStages = None
    seed: Seed = 0
    world: World = None
    fault: Fault = None
    world_log: WorldLog = None


@with_option_groups
def jog(
    options: JogOptions,
    request: JogBench,
    axis: Annotated[
        str | None,
        typer.Option(help="Axis to begin with: stage_z, stage_x or rotary.", metavar="NAME"),
    ] = None,
    fixture: Annotated[
        Fixture | None,
        typer.Option(
            help="Fixture of a simulated bench.  [default: film-clamp]",
            parser=one_of(*get_args(Fixture)),
            metavar="[film-clamp|plate|semi-spherical-object]",
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Move an axis by keys, in small slow steps that stop when the key is released.

    Up, left or - moves towards a smaller position (z: up), down, right or + towards a larger one.
    Tab chooses the next axis, h homes it. Space or any other key stops, q or Esc leaves. Every move
    is logged in rig.log in the results folder.
    """
    with reported(debug):
        from rig.jog.axes import AXES

        settings = options.settings()
        if axis is not None and axis not in AXES:
            raise ConfigurationError(
                f"--axis {axis}: not an axis", f"choose one of {', '.join(AXES)}"
            )
        chosen = replace(request, bench=bench_file(request.bench))
        _perform(chosen, settings, axis, fixture, debug)


def _perform(
    request: BenchRequest,
    settings: JogSettings,
    axis: str | None,
    fixture: Fixture | None,
    debug: bool,
) -> None:
    """Choose the bench, jog it, report how it ended, and exit with its code."""
    from rig.cli.streams import say_at_once
    from rig.cli.terminal import Terminal
    from rig.run.bench_selector import BenchSelector
    from rig.run.stopping import NOTICE_WITHOUT_DATA, StopFlag

    terminal = Terminal()
    with ExitStack() as stack:
        stop = stack.enter_context(StopFlag(say_at_once, NOTICE_WITHOUT_DATA))
        start_log(request.results)
        log.setLevel(logging.INFO)
        with stop.nothing_connected():
            chosen = BenchSelector(say, paced=True).select(request, stack, fixture or "film-clamp")
        if chosen.started is not None:
            stack.callback(chosen.started.wait)
        elif fixture is not None:
            raise ConfigurationError(
                f"--fixture belongs to a simulated bench, not to {chosen.plan.source}",
                "leave it out: the bench file says what is mounted",
            )
        ended = _at_the_bench(chosen, request, settings, axis, stop, terminal, stack)
        for failure in ended.failures:
            if failure.code in STOPPED_BY_SIGNAL:
                say(failure.one_line())
            else:
                say_failure(failure, debug)
        for off in ended.off_failures:
            say(f"error: NOT SAFE: {off.name} could not be stopped: {off.reason}")
        if not ended.off_failures:
            say(f"every axis is at rest; the moves are in {request.results / 'rig.log'}")
    raise typer.Exit(int(ended.code))


def _at_the_bench(
    chosen: ChosenBench,
    request: BenchRequest,
    settings: JogSettings,
    axis: str | None,
    stop: StopFlag,
    terminal: Terminal,
    at_the_end: ExitStack,
) -> JogOutcome:
    """Connect axes and force sensor only, and jog; leave the bench to the guard if an axis could
    not be stopped."""
    from datetime import datetime

    from rig.bench.apply_calibrations import apply_calibrations, with_force_record_only
    from rig.bench.connect import connect
    from rig.cli.terminal import HELP
    from rig.jog.axes import AXES
    from rig.jog.session import JogSession
    from rig.run.interlocks.store import InterlockStore
    from rig.run.locks.bench_mark import BenchMarks
    from rig.run.making_safe.guard_link import GuardLink
    from rig.run.making_safe.guard_report import report_path

    plan, clock = chosen.plan, chosen.clock
    contacts = {contact.role for contact in plan.settings.interlock}
    roles = {*AXES, "force_sensor", *contacts}
    needed = tuple(part for part in plan.instruments if part.role in roles)
    part_of_plan = replace(with_force_record_only(plan), instruments=needed)
    try:
        connected = connect(part_of_plan, clock, stop.check, say)
    except RigError:
        clock.close()
        raise
    at_the_end.callback(connected.close)
    _, warnings = apply_calibrations(connected, datetime.now().astimezone(), True)
    for warning in warnings:
        say(f"warning: {warning}")
    records = InterlockStore(plan, lasting=chosen.started is None)
    session = JogSession(connected, settings, axis, stop, terminal, records)
    report = report_path(request.results, plan.settings.name)
    if chosen.started is not None:
        report = request.results / OWN_BENCH_REPORT
    held, addresses = ((), ()) if chosen.lock is None else (chosen.lock.files, chosen.lock.names)
    marks = BenchMarks(addresses, plan.settings.name, None)
    guard = GuardLink(plan, None, report, held, addresses, lifts=False)
    try:
        marks.running(guard.pid)
    except RigError:
        guard.done()
        raise
    with terminal:
        for line in HELP:
            say(line)
        ended = session.go(guard, marks)
    if not ended.off_failures:
        guard.done()
        return ended
    connected.hand_over()
    reasons = "; ".join(f"{off.name}: {off.reason}" for off in ended.off_failures)
    cause = f"the session could not stop every axis: {reasons}"
    taken_over = guard.take_over([off.name for off in ended.off_failures if off.over_limit], cause)
    say(taken_over.summary)
    if taken_over.safe and taken_over.released:
        marks.clear()
    return ended
