"""Make calibration records: a film from a sweep's file, sensors from known weights."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options.calibration import (
    DIRECTIONS,
    RecordOptions,
    WeighingOptions,
    conditions,
    directions,
    number,
    reading_times,
    sensor_name,
    weights_of,
)
from rig.cli.options.groups import with_option_groups
from rig.cli.outcome import print_json, reported, say
from rig.core.errors import (
    STOPPED_BY_SIGNAL,
    ConfigurationError,
    FoundWrongError,
    LimitError,
    RigError,
)

if TYPE_CHECKING:
    from rig.analysis.weighing import CellFit, ForceFit
    from rig.bench.connected import Bench
    from rig.cli.commands.weigh import WeighingOperator
    from rig.instruments.calibration import CalibrationRecord
    from rig.instruments.roles import Limits

    Vector = tuple[float, float, float]


LARGE_CROSSTALK_PERCENT = 10.0
"""Crosstalk above which two axes of the sensor are probably crossed or tilted."""
app = typer.Typer(
    name="calibrate",
    help=(__doc__ or "").split("\n", 1)[0],
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


Weights = Annotated[str, typer.Option(help="Known forces to apply, ascending.", metavar="N,N,…")]


@app.command("pvdf")
@with_option_groups
def pvdf(
    file: Annotated[Path, typer.Argument(help="Run file of a complete sweep.", metavar="FILE")],
    *,
    film: Annotated[
        str,
        typer.Option(help="Label of the film.  [default: that of the bench file]", metavar="NAME"),
    ] = "",
    wanted: RecordOptions,
) -> None:
    """Calibrate a film from its sweep.

    Determines level b and corner from the run file.
    """
    with reported(wanted.debug, wanted.as_json):
        from rig.cli.commands.film_record import (
            analysed,
            doubts,
            film_record,
            gain_is_assumed,
            sentences,
        )
        from rig.files.runfile.reader import RunFile
        from rig.instruments.calibration import FOLDER

        _refuse_changed(file)
        with RunFile.open(file) as run:
            analysis = analysed(run)
            assert run.header.start_time is not None, "a sweep has one"
            date = datetime.fromisoformat(run.header.start_time)
            fields = wanted.fields("pvdf", date, run.header.user.name)
            record = film_record(run, analysis, sensor_name("--film", film), fields)
            bench_file, assumed = Path(run.header.bench_file), gain_is_assumed(run)
        folder = bench_file.parent if bench_file.is_file() else Path()
        for line in sentences(record, analysis):
            say(line)
        _finish(record, wanted, folder / FOLDER, doubts(record, assumed))


@app.command("force")
@with_option_groups
def force(
    *,
    weights: Weights = "5N,10N,20N",
    axes: Annotated[
        str, typer.Option(help="Directions in which weights are applied.", metavar="±AXIS,…")
    ] = "+x,-x,+y,-y,+z",
    sensor: Annotated[
        str,
        typer.Option(
            help="Name of the sensor.  [default: serial number of the amplifier]", metavar="NAME"
        ),
    ] = "",
    rate: Annotated[str, typer.Option(help="Frames per second.", metavar="1/s")] = "1000",
    options: WeighingOptions,
    wanted: RecordOptions,
) -> None:
    """Calibrate the force sensor with weights.

    Determines zero and matrix from known weights on each axis, step by step.
    """
    with reported(wanted.debug, wanted.as_json), _stoppable(wanted.as_json):
        from rig.analysis.weighing import fit_force, refuse_outlier, sequence
        from rig.cli.commands.weigh import weigh
        from rig.instruments.calibration import ForceCalibration, make_record
        from rig.run.streams.scales import ForceScale

        weights_N = weights_of(weights)
        forces = sequence(directions(axes), weights_N)
        sensor = sensor_name("--sensor", sensor)
        fields = {**wanted.fields("force", _now()), **conditions(options, weights_N)}
        readings, frames_s = reading_times(options), number(rate, "1/s", "--rate")
        with _at_the_bench(options, wanted, "force_sensor") as (connected, person, folder):
            amplifier = connected.force_sensor
            _refuse_heavy(max(weights_N), options, amplifier.limits()["force"])
            scale = ForceScale(
                amplifier, connected.clock, readings, _rate(frames_s, amplifier.limits()["rate"])
            )
            means = weigh(forces, scale, person, connected.clock)
            fields["sensor"] = sensor or amplifier.identity.serial_number
            fields["simulated"] = connected.simulated
        values, errors = [m.value for m in means], [m.standard_error for m in means]
        fit = fit_force(forces, values, errors, options.tolerance / 100)
        refuse_outlier(forces, fit.residuals)
        record = make_record(ForceCalibration, {**fields, **fit.coefficients(forces, means)})
        for line in _force_lines(forces, fit):
            say(line)
        _finish(record, wanted, folder, _crosstalk_warning(fit))


@app.command("load-cell")
@with_option_groups
def load_cell(
    *,
    weights: Weights = "2N,5N,10N",
    sensor: Annotated[
        str,
        typer.Option(
            help="Name of the load cell.  [default: that of the bench file]", metavar="NAME"
        ),
    ] = "",
    input_range: Annotated[
        str, typer.Option("--range", help="Input range of the DAQ's channel.", metavar="V")
    ] = "1.25V",
    options: WeighingOptions,
    wanted: RecordOptions,
) -> None:
    """Calibrate the load cell with weights.

    Determines zero and static sensitivity from known weights along z, step by step.
    """
    with reported(wanted.debug, wanted.as_json), _stoppable(wanted.as_json):
        from rig.analysis.weighing import fit_load_cell, refuse_outlier, sequence
        from rig.cli.commands.weigh import weigh
        from rig.instruments.calibration import LoadCellCalibration, make_record
        from rig.instruments.roles import Limits
        from rig.run.streams.scales import CellScale

        weights_N = weights_of(weights)
        forces = sequence([DIRECTIONS["+z"]], weights_N)
        range_V = number(input_range, "V", "--range")
        if range_V <= 0:
            raise ConfigurationError(
                f"--range {input_range}: must be above 0 V", "give the range that is in use"
            )
        sensor = sensor_name("--sensor", sensor)
        fields = {**wanted.fields("load-cell", _now()), **conditions(options, weights_N)}
        readings = reading_times(options)
        with _at_the_bench(options, wanted, "daq") as (connected, person, folder):
            cell = connected.load_cell
            _refuse_heavy(max(weights_N), options, Limits(0.0, cell.max_load_N, "N", "load cell"))
            _refuse_out_of_range(max(weights_N) * cell.sensitivity_V_N, range_V)
            fields["sensor"] = sensor or _name_of_cell(connected)
            fields["simulated"] = connected.simulated
            scale = CellScale(
                connected.daq, connected.clock, readings, range_V, cell.sensitivity_V_N
            )
            means = weigh(forces, scale, person, connected.clock)
        loads = [known[2] for known in forces]
        values = [float(mean.value[0]) for mean in means]
        errors = [float(mean.standard_error[0]) for mean in means]
        fit = fit_load_cell(loads, values, errors, options.tolerance / 100)
        refuse_outlier(loads, fit.residuals)
        found = {**fit.coefficients(loads, means), "input_range_V": range_V}
        record = make_record(LoadCellCalibration, {**fields, **found})
        for line in _cell_lines(loads, fit):
            say(line)
        _finish(record, wanted, folder, [])


def _refuse_changed(file: Path) -> None:
    """Raise FoundWrongError if the run file is not, byte by byte, the one that was written, or not
    a run file at all."""
    from rig.files.checksum import checksum_findings
    from rig.files.file_kind import require_hdf5

    require_hdf5(file)
    if findings := list(checksum_findings(file)):
        raise FoundWrongError(
            f"{file}: {'; '.join(findings)}",
            "no record is made of a file that cannot be trusted; `rig verify` says more",
        )


# --- at the bench ----------------------------------------------------------------------------


@contextlib.contextmanager
def _at_the_bench(
    options: WeighingOptions, wanted: RecordOptions, *roles: str
) -> Iterator[tuple[Bench, WeighingOperator, Path]]:  # fmt: skip
    """Connect these instruments alone; yield the bench, the person who puts the weights on, and
    the folder for the record, in which files can be written."""
    from rig.cli.commands.weigh import WeighingOperator
    from rig.cli.streams import say_at_once
    from rig.instruments.calibration import require_folder
    from rig.run.bench_selector import BenchRequest, BenchSelector, bench_file
    from rig.run.stopping import NOTICE_WITHOUT_DATA, StopFlag

    request = BenchRequest(
        bench=bench_file(options.bench),
        results=options.results,
        seed=options.seed,
        world=options.world,
        world_log=options.world_log,
    )
    with StopFlag(say_at_once, NOTICE_WITHOUT_DATA) as stop, contextlib.ExitStack() as at_the_end:
        with stop.nothing_connected():
            bench = BenchSelector(say).select(request, at_the_end)
        plan, clock, started = bench.plan, bench.clock, bench.started
        if started is not None:
            at_the_end.callback(started.wait)
        from rig.bench.connect import connect

        needed = tuple(part for part in plan.instruments if part.role in roles)
        try:
            connected = connect(replace(plan, instruments=needed), clock, show_line=say)
        except BaseException:
            clock.close()
            raise
        at_the_end.callback(connected.close)
        folder = require_folder(wanted.to or _beside(plan.source))
        _refuse_weightless(connected, slaved=started is not None, yes=options.yes)

        def check_stop() -> None:
            try:
                stop.check()
            except RigError:
                unregister()  # what follows is clean-up, whose waits go undisturbed
                raise

        unregister = clock.each_slice(check_stop)
        present = started is None or (sys.stdin.isatty() and not options.yes)
        if started is not None:
            say("the simulated bench puts the weights on by itself")
        yield connected, WeighingOperator(check_stop, present), folder


def _refuse_weightless(bench: Bench, slaved: bool, yes: bool) -> None:
    """Refuse a bench on which neither a person nor the bench itself can put the weights on."""
    if bench.simulated and not slaved:
        raise ConfigurationError(
            f"{bench.plan.source} is a simulated bench in real time: weights cannot be put on it",
            "leave the bench file out: then the command's own simulated bench does it",
        )
    if yes and not slaved:
        raise ConfigurationError(
            "--yes is for the simulated bench: here every weight waits for a person",
            "leave it out",
        )


@contextlib.contextmanager
def _stoppable(as_json: bool) -> Iterator[None]:
    """Report a stop by signal or q in one line, with its exit code; nothing was written."""
    try:
        yield
    except RigError as stopped:
        if stopped.code not in STOPPED_BY_SIGNAL:
            raise
        say(f"{stopped.message}; nothing was written, the sensor is at rest")
        if as_json:
            shown: dict[str, Any] = {
                "file": None,
                "outcome": "stopped",
                "exit": int(stopped.code),
                "summary": {},
            }
            print_json(shown)
        raise typer.Exit(int(stopped.code)) from None


def _refuse_heavy(largest_N: float, options: WeighingOptions, limits: Limits) -> None:
    total = largest_N + number(options.preload, "N", "--preload")
    if not limits.holds(total):
        raise LimitError(
            f"weights and preload of {total:g} N are over the limit of {limits.high:g} N of the "
            f"{limits.limited_by}",
            "choose smaller weights with --weights",
        )


def _rate(rate: float, limits: Limits) -> float:
    if not limits.holds(rate):
        raise LimitError(
            f"--rate {rate:g} is outside {limits.low:g} to {limits.high:g} frames/s of the "
            f"{limits.limited_by}",
            "choose a rate inside",
        )
    return rate


def _name_of_cell(bench: Bench) -> str:
    named = str(getattr(bench.load_cell, "name", ""))
    if not named and not bench.simulated:
        raise ConfigurationError(
            "the bench file does not name the load cell", "give its serial number with --sensor"
        )
    return named or "simulated load cell"


def _refuse_out_of_range(largest_V: float, range_V: float) -> None:
    if largest_V > range_V:
        raise LimitError(
            f"the largest weight takes the load cell to {largest_V:.3g} V, beyond the range of "
            f"{range_V:g} V",
            "choose a larger --range, the one that is in use, or smaller --weights",
        )


def _crosstalk_warning(fit: ForceFit) -> list[str]:
    if fit.crosstalk_percent <= LARGE_CROSSTALK_PERCENT:
        return []
    return [
        f"crosstalk of {fit.crosstalk_percent:.1f} %: the weights were not on the sensor's axes, "
        "or the sensor is not sound"
    ]


def _force_lines(forces: Sequence[Vector], fit: ForceFit) -> Iterator[str]:
    from rig.analysis.estimate import with_error

    yield "zero (mV/V, ± 95 %):"
    yield "  " + "  ".join(
        f"{axis} {with_error(value, fit.coverage * error)}"
        for axis, value, error in zip("xyz", fit.zero, fit.zero_error, strict=True)
    )
    yield "matrix (N per mV/V, ± 95 %):"
    for row, halves in zip(fit.matrix, fit.half_widths(), strict=True):
        yield "  " + "  ".join(
            with_error(value, half) for value, half in zip(row, halves, strict=True)
        )
    yield "residuals (mN):"
    for known, off in zip(forces, fit.residuals, strict=True):
        yield f"  {_at(known):>24}  " + "  ".join(f"{1e3 * value:+7.2f}" for value in off)
    yield (
        f"residual rms {1e3 * fit.residual_rms:.2f} mN, largest {1e3 * fit.largest_residual:.2f} "
        f"mN; crosstalk {fit.crosstalk_percent:.2f} % if the matrix were left out"
    )


def _cell_lines(loads: Sequence[float], fit: CellFit) -> Iterator[str]:
    yield f"zero {fit.zero}"
    yield f"sensitivity {fit.sensitivity}"
    yield "residuals (mN): " + "  ".join(
        f"{load:g} N {1e3 * off:+.2f}" for load, off in zip(loads, fit.residuals, strict=True)
    )


def _at(force_N: Vector) -> str:
    return "(" + ", ".join(f"{value:g}" for value in force_N) + ") N"


# --- options and output ----------------------------------------------------------------------


def _finish(
    record: CalibrationRecord, wanted: RecordOptions, folder: Path, warnings: list[str]
) -> None:
    """Write the record and say where it is and how long it holds."""
    from rig.instruments.calibration import write_calibration

    path = write_calibration(record, wanted.to or folder)
    for warning in warnings:
        say(f"warning: {warning}")
    mark = "SIMULATED " if record.simulated else ""
    say(
        f"{mark}calibration of {record.sensor!r} ({record.kind}), valid until "
        f"{record.valid_until:%Y-%m-%d}"
    )
    if wanted.as_json:
        shown = {
            "file": str(path),
            "outcome": "complete",
            "exit": 0,
            "simulated": record.simulated,
            "summary": record.model_dump(mode="json", exclude={"readings", "covariance"}),
            "warnings": warnings,
        }
        print_json(shown)
    else:
        print(path)  # noqa: T201 - stdout carries data


def _beside(source: str) -> Path:
    """Return the folder of records next to the bench file, or in the current folder without a
    file."""
    from rig.instruments.calibration import FOLDER

    bench_file = Path(source)
    return (bench_file.parent if bench_file.is_file() else Path()) / FOLDER


def _now() -> datetime:
    return datetime.now().astimezone().replace(microsecond=0)
