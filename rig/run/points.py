"""Points: the conditions of a run as plain values, checked before anything moves."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rig.bench.connected import Bench
from rig.bench.fixture_limits import out_of_reach
from rig.bench.limits import require
from rig.bench.plan import BenchPlan
from rig.core.errors import ConfigurationError, LimitError, RigError
from rig.core.settings import Settings, option_name, unit_of
from rig.instruments.roles import Acquisition

Reading = dict[str, float | int | bool | str | None]
"""The results of a point: plain numbers and texts by name, as they go into the run file."""

_BENCH_FILE_HINT = ", or correct the bench file if the limit is wrong"
"""End of the hint of a LimitError, for a bench that has a bench file."""

RATE = "rate_S_s"
"""The setting that states the DAQ's sampling rate, in procedures that have it."""
RANGE_FOUND_LATER_V = 0.0
"""Range of a planned channel of which the procedure finds the range when it measures, among those
that the DAQ has."""


class RetakeError(RigError):
    """Raised by `Procedure.take` to give up an attempt and have the point retaken, with the bench
    in the state in which a point begins; the message says why."""


@dataclass(frozen=True)
class Move:
    """A value that a point requires of the bench: ``generator.frequency`` = 200."""

    quantity: str
    """Role and quantity, as in `Bench.limits`."""
    value: float
    given: tuple[str, ...] = ()
    """Settings that the value is computed from, for the message that refuses it."""


@dataclass(frozen=True)
class Point:
    """One condition within a procedure."""

    id: str
    """Stable name: the same settings give the same ids, whatever the order or the day."""
    condition: Any
    """Condition of the point, for the procedure's own use."""
    moves: tuple[Move, ...]
    """Every value that it requires of an instrument; all are checked before the first motion."""
    acquisitions: tuple[Acquisition, ...] = ()
    """Every acquisition that it requires of the DAQ; all are checked before the first motion. The
    range of a channel may be `RANGE_FOUND_LATER_V`."""
    acquisitions_given: tuple[str, ...] = ()
    """Settings that the acquisitions are computed from, for the message that refuses one."""
    duration_s: float = 0.0
    """Bench time that it is expected to take."""


def require_roles(points: Sequence[Point], plan: BenchPlan) -> None:
    """Refuse, before anything is connected, a bench that lacks an instrument that the points need,
    or the load cell if the points load it.

    Raises ConfigurationError, which names what is missing.
    """
    needed = {move.quantity.split(".")[0] for point in points for move in point.moves}
    if any(point.acquisitions for point in points):
        needed.add("daq")
    there = {part.role for part in plan.instruments}
    if plan.settings.load_cell is not None:
        there.add("load_cell")
    if missing := sorted(needed - there):
        tables = " and ".join(f"[{role}]" for role in missing)
        raise ConfigurationError(
            f"{plan.source}: the bench lacks what this procedure needs: {', '.join(missing)}",
            f"add {tables}, or name another bench with --bench",
        )


def check_points(
    points: Sequence[Point],
    bench: Bench,
    taken: Iterable[str] = (),
    settings: Settings | None = None,
) -> None:
    """Refuse, before anything moves, every value outside a limit, places of the fixtures included;
    ids must be unique, also among those of an earlier plan that are `taken`. With the run's
    `settings` the message names the options that a refused value comes from.

    Raises the first LimitError or ConfigurationError that is found.
    """
    for error in refusals(points, bench, taken, settings):
        raise error


def refusals(
    points: Sequence[Point],
    bench: Bench,
    taken: Iterable[str] = (),
    settings: Settings | None = None,
) -> Iterator[RigError]:
    """Yield every error that `check_points` would raise, one after the other."""
    if not points:
        yield ConfigurationError("there is no point to measure", "ask for at least one")
    yield from out_of_reach(bench)
    seen: set[str] = set(taken)
    limits = bench.limits()
    for point in points:
        if point.id in seen:
            yield ConfigurationError(
                f"point {point.id} is asked for twice", "remove one of the two"
            )
        seen.add(point.id)
        for move in point.moves:
            if move.quantity not in limits:
                yield _unknown_quantity(point, move, limits, bench)
                continue
            name = move.quantity.replace(".", " ")
            try:
                require(name, move.value, limits[move.quantity], f"point {point.id}")
            except LimitError as error:
                origin = _origin(move.given, settings)
                yield LimitError(error.message + origin, remedy(error, bench))
        for acquisition in point.acquisitions:
            try:
                bench.daq.check(_in_widest_range(acquisition, bench))
            except LimitError as error:
                message = error.message + _origin(point.acquisitions_given, settings)
                hint = _one_rate(acquisition, bench, settings) or remedy(error, bench)
                yield LimitError(f"point {point.id}: {message}", hint)


def _unknown_quantity(
    point: Point, move: Move, limits: Collection[str], bench: Bench
) -> ConfigurationError:
    """Return the error for a quantity without a limit: the bench lacks the role, or the instrument
    in this role has no such quantity, which a procedure or a driver has misspelt."""
    role, _, quantity = move.quantity.partition(".")
    if known := sorted(name for name in limits if name.startswith(f"{role}.")):
        return ConfigurationError(
            f"point {point.id} needs {move.quantity}, but {role} has no limit {quantity!r}",
            f"it has {', '.join(known)}: correct the point's Move, or limits() of the driver",
        )
    return ConfigurationError(
        f"point {point.id} needs {move.quantity}, which this bench does not have",
        f"add a [{role}] table to {bench.plan.source}",
    )


def _in_widest_range(acquisition: Acquisition, bench: Bench) -> Acquisition:
    """Return an acquisition with the widest range of the DAQ where its range is found later."""
    if all(channel.range_V != RANGE_FOUND_LATER_V for channel in acquisition.channels):
        return acquisition
    widest_V = max(bench.daq.ranges_V())
    channels = tuple(
        replace(channel, range_V=channel.range_V or widest_V) for channel in acquisition.channels
    )
    return replace(acquisition, channels=channels)


def _one_rate(acquisition: Acquisition, bench: Bench, settings: Settings | None) -> str:
    """Return the remedy where the DAQ has one rate, which is not the one that was asked for; ""
    where it has several, or where the procedure could not use that one rate."""
    rate = bench.limits().get("daq.rate")
    if rate is None or rate.low != rate.high or rate.holds(acquisition.rate_S_s):
        return ""
    if settings is None or RATE not in type(settings).model_fields:
        return ""
    try:
        type(settings).model_validate(
            {**settings.model_dump(exclude_unset=True), RATE: float(rate.low)}
        )
    except ValidationError:
        return ""
    return f"the {rate.limited_by} has this rate only: give {option_name(RATE)} {rate.low:g}Hz"


def remedy(error: LimitError, bench: Bench) -> str | None:
    """Return the hint of a refused value; only a bench with a bench file is hinted to correct
    it."""
    if error.hint is None or Path(bench.plan.source).exists():
        return error.hint
    return error.hint.removesuffix(_BENCH_FILE_HINT)


def as_option(settings: Settings, field: str) -> str:
    """Return a setting as it is given on the command line: ``--distance 100 mm``."""
    value, unit = getattr(settings, field), unit_of(field)
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return option_name(field)
    shown = f"{value:g}" if isinstance(value, float) else str(value)
    return f"{option_name(field)} {shown}" + (f" {unit}" if unit else "")


def _origin(given: tuple[str, ...], settings: Settings | None) -> str:
    """Return the settings that a value is computed from, as the end of a message."""
    options = [as_option(settings, field) for field in given] if settings is not None else []
    if len(options) > 1:
        options[-1] = f"and {options[-1]}"
    return f" (from {(', ' if len(options) > 2 else ' ').join(options)})" if options else ""
