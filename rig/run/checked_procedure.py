"""Call the hooks of a procedure and check their exceptions and return values.

A procedure may belong to a package of a laboratory. A fault in it is reported as that package's,
with file and line; one in a procedure of this program, as a defect of the program.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

from rig.bench.foreign import foreign
from rig.core.entry_points import (
    OWN_PACKAGE,
    PROCEDURES,
    find,
    package,
    place_in,
    place_of_line,
    place_of_this_call,
)
from rig.core.errors import (
    LONGEST_REASON,
    ConfigurationError,
    ExitCode,
    RigError,
    is_stop,
    shortened,
)
from rig.core.time_limit import TimeLimitError, time_limit
from rig.core.toml_files import check_nesting
from rig.files.journal.format import MAX_JSON, to_json, unlike_json
from rig.files.journal.layout import TRUTH
from rig.run.passing import KeptBackError
from rig.run.points import Move, Point, Reading
from rig.run.procedure import Procedure

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.bench.plan import BenchPlan
    from rig.bench.settings import FixtureSettings
    from rig.files.journal.layout import Column, Layout
    from rig.run.context import Run

SIMPLER = "return numbers, texts, truth values or None, or lists and dicts of them"
"""Remedy for a value that a run file cannot hold."""
LONGEST_SUMMARY_S = 120.0
"""Longest time of a hook that computes when the bench is safe."""
VERDICT = "invalid"
"""Key of the column that says why a reading is invalid."""


class ProcedureFaultError(RigError):
    """Raised for a procedure's unexpected exception, or a return value that its layout does not
    declare."""

    code = ExitCode.INTERNAL


class UnexpectedFaultError(RigError):
    """Raised for an unexpected exception in this program's own code."""

    code = ExitCode.INTERNAL


class CheckedProcedure:
    """Calls the hooks of a procedure, which are described at `rig.run.procedure.Procedure`.

    Every method raises what the hook raised if that is a RigError, and ProcedureFaultError for any
    other exception and for a wrong return value.
    """

    def __init__(self, procedure: Procedure):
        self._procedure = procedure

    def import_ahead(self) -> None:
        """Import slow modules."""
        with self._blamed():
            self._procedure.import_ahead()

    def points(self) -> tuple[Point, ...]:
        """Return all points of the run."""
        with self._blamed():
            return self._points("points", self._procedure.points())

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the bench time in s that arming and making safe take."""
        with self._blamed():
            return float(self._procedure.overhead_s(fixture, homed))

    def refining_s(self) -> float:
        """Return the bench time in s that the points of `refine` are expected to take."""
        with self._blamed():
            return float(self._procedure.refining_s())

    def check(self, bench: Bench) -> None:
        """Refuse a bench that the run cannot work on."""
        self._require_axes(bench)
        with self._blamed():
            self._procedure.check(bench)

    def _require_axes(self, bench: Bench) -> None:
        """Raise ConfigurationError where the force sensor lacks an axis that the procedure needs,
        which would be recorded as a force of zero."""
        if "force_sensor" not in bench.instruments:
            return
        from rig.instruments.roles import axes_of

        sensor = bench.force_sensor
        there = axes_of(sensor)
        missing = [axis for axis in self._procedure.force_axes if axis not in there]
        if missing:
            raise ConfigurationError(
                f"{self._procedure.name} needs the force along {' and '.join(missing)}, and the "
                f"force sensor {sensor.identity.model} measures {' and '.join(there)} only",
                "mount a force sensor with this axis and name it in the bench file, or run a "
                "procedure that needs the normal force alone",
            )

    def refine(self, readings: Sequence[Reading]) -> tuple[Point, ...]:
        """Return further points that the readings of the first plan require."""
        with self._blamed():
            return self._points("refine", self._procedure.refine(readings))

    def why_invalid(self, reading: Reading) -> str:
        """Return why a reading that `take` has returned is invalid; "" for a valid one."""
        # A run that was begun by an earlier version has readings whose column was left empty.
        written = str(reading.get(VERDICT) or "") if self._has_verdict else ""
        return written or self._judged(reading)

    @property
    def _has_verdict(self) -> bool:
        """True if the procedure judges its readings and they have a column for the reason."""
        columns = self._procedure.layout.columns
        written = any(column.key == VERDICT and column.kind == "text" for column in columns)
        return written and type(self._procedure).why_invalid is not Procedure.why_invalid

    def _judged(self, reading: Reading) -> str:
        with self._blamed():
            found: Any = self._procedure.why_invalid(dict(reading)) or ""
        if not isinstance(found, str):
            shown = f"{_quoted(found)} ({_kind(found)})"
            return f"why_invalid() returned {shown}, not the reason as text"
        return found

    def retries_of_invalid(self) -> int:
        """Return how many times a point with an invalid reading is retaken."""
        with self._blamed():
            return int(self._procedure.retries_of_invalid())

    def arm(self, run: Run) -> None:
        """Switch on what the points need."""
        with self._blamed():
            self._procedure.arm(run)

    def take(self, run: Run, point: Point) -> Reading:
        """Measure one point; return a reading with the columns that the layout declares, of which
        ``invalid``, where there is one, has what the procedure's `why_invalid` says.

        Raises ProcedureFaultError if the procedure returns anything else.
        """
        with self._blamed():
            reading: Any = self._procedure.take(run, point)
        fault = reading_fault(self._procedure.layout, reading)
        if fault is not None:
            raise self._fault(f"{self._procedure.reading_hook}() returned {fault}")
        whole: Reading = dict(reading)
        if self._has_verdict:  # what the file, the summary and the exit code go by
            try:
                whole[VERDICT] = self._judged(whole)
            except (ProcedureFaultError, UnexpectedFaultError) as failure:
                # The reading is measured: it is kept, and not taken for valid.
                whole[VERDICT] = f"it could not be judged: {failure.message}"
        return whole

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return the results of the whole run.

        Raises ProcedureFaultError if the procedure returns no mapping, or one with a value that a
        run file cannot hold.
        """
        with self._blamed(), self._in_time("summarise"):
            found: Any = self._procedure.summarise(readings)
        return self._values("summarise", found)

    def put_in(self, readings: Sequence[Reading], summary: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what a simulated bench had put in, by the name of the value that recovers it.

        Raises ProcedureFaultError as `summarise`.
        """
        with self._blamed(), self._in_time("put_in"):
            found: Any = self._procedure.put_in(readings, summary)
        return self._values("put_in", found)

    def in_brief(self, summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> list[str]:
        """Return the summary in a few lines.

        Raises ProcedureFaultError if the procedure returns no list of lines.
        """
        with self._blamed(), self._in_time("in_brief"):
            found: Any = self._procedure.in_brief(summary, put_in)
        if isinstance(found, str) or not isinstance(found, Sequence):
            raise self._fault(f"in_brief() returned {_kind(found)}, not a list of lines")
        return [str(line) for line in found]

    def kept_back(self, kept: KeptBackError) -> str:
        """Return what the procedure has kept back and where, as a sentence for who wrote it. An
        error that was not raised stands for the place that calls this."""
        cls = type(self._procedure)
        top = cls.__module__.split(".")[0]
        place = place_in(top, kept) if kept.__traceback__ else place_of_this_call(top)
        where = f" ({place.removesuffix(': ')})" if place else ""
        return (
            f"procedure {cls.name} of package {package_of(cls)} suppressed what should end the run"
            f"{where}: let exceptions of waits pass, or raise them again ({kept.cause.message})"
        )

    def packages(self, plan: BenchPlan) -> dict[str, str]:
        """Return whose code the top modules of other packages are that a run of this procedure
        calls on a bench: that of the procedure and those of drivers."""
        found = {}
        for part in plan.instruments:
            if (entry := foreign(part)) is not None:
                name = f"driver {part.driver_name} of package {package(entry)}"
                found[entry.module.split(".")[0]] = name
        cls = type(self._procedure)
        if (name := package_of(cls)) != OWN_PACKAGE:
            found[cls.__module__.split(".")[0]] = f"procedure {cls.name} of package {name}"
        return found

    def _points(self, hook: str, found: Any) -> tuple[Point, ...]:
        points = tuple(found) if isinstance(found, (tuple, list)) else (found,)
        moves: Any = ()
        for point in points:
            if not isinstance(point, Point):
                what = f"{hook}() returned {_kind(point)} in place of points"
                raise self._fault(f"{self._place_of(hook)}{what}")
            if point.moves is not moves:
                moves = point.moves
                self._require_moves(point)
        return points

    def _require_moves(self, point: Point) -> None:
        """Raise ProcedureFaultError for moves that cannot be checked against the limits."""
        settings = self._procedure.settings
        for move in point.moves:
            where = f"point {point.id} asks for {_quoted(move)}"
            if not isinstance(move, Move):
                raise self._fault(f"{where}, which is not a Move")
            if not isinstance(move.value, Real):
                raise self._fault(f"{where}, whose value is not a number")
            if isinstance(move.given, str):
                raise self._fault(
                    f"{where}: its settings are a text", f"write them as ({move.given!r},)"
                )
            if strangers := [name for name in move.given if not hasattr(settings, name)]:
                raise self._fault(f"{where}, but there is not a setting {strangers[0]!r}")

    def _values(self, hook: str, found: Any) -> Mapping[str, Any]:
        """Return a mapping of values that a run file can hold."""
        if not isinstance(found, Mapping):
            raise self._fault(f"{hook}() returned {_kind(found)}, not a mapping")
        try:
            check_nesting(found)
        except ValueError as error:
            raise self._fault(f"{hook}() returned values {error}", SIMPLER) from None
        if (unlike := unlike_json(found)) is not None:
            name, value, why = unlike
            shown = f"{name!r} = {_quoted(value)}" if name else _quoted(value)
            raise self._fault(f"{hook}() returned {shown} ({_kind(value)}), which {why}", SIMPLER)
        if (size := len(to_json(found))) > MAX_JSON:
            raise self._fault(
                f"{hook}() returned values of {size} bytes as JSON; a run file holds {MAX_JSON}",
                "return fewer; a value for each point belongs in a column",
            )
        return found

    @contextlib.contextmanager
    def _in_time(self, hook: str) -> Iterator[None]:
        """End a hook that computes when the bench is safe: nothing else would, not even Ctrl-C."""
        try:
            with time_limit(LONGEST_SUMMARY_S):
                yield
        except TimeLimitError as error:
            hint = (
                "compute in it what is quick, and the rest in an analysis (docs/add-an-analysis.md)"
            )
            raise self._fault(f"{hook}() was ended: {error.message}", hint) from error

    @contextlib.contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            # What a hook prints must not mix with what the command prints for other programs.
            with contextlib.redirect_stdout(sys.stderr):
                yield
        except RigError:
            raise
        except (Exception, SystemExit) as error:
            if is_stop(error):  # a signal before the run
                raise
            raise _blame(type(self._procedure), error) from error

    def _place_of(self, hook: str) -> str:
        """Return where the package defines a hook, in the words of `place_in`."""
        cls = type(self._procedure)
        function = getattr(cls, hook)
        top = cls.__module__.split(".")[0]
        code = getattr(inspect.unwrap(function), "__code__", None)
        if code is None or function.__module__.split(".")[0] != top:
            return ""
        return place_of_line(top, code.co_filename, code.co_firstlineno)

    def _fault(self, what: str, hint: str = "") -> ProcedureFaultError:
        cls = type(self._procedure)
        named = f"procedure {cls.name} of package {package_of(cls)}"
        return ProcedureFaultError(f"{named}: {what}", hint)


def package_of(procedure: type[Procedure]) -> str:
    """Return the name of the package that a procedure belongs to."""
    top = procedure.__module__.split(".")[0]
    with contextlib.suppress(ConfigurationError):
        entry = find(PROCEDURES, procedure.name)
        if entry is not None and entry.module.split(".")[0] == top:
            return package(entry)
    return top


def internal(error: BaseException) -> RigError:
    """Return the RigError that reports an unexpected exception: as a defect of this program, unless
    the computer lacks memory."""
    if isinstance(error, MemoryError):
        wrapped = RigError(
            "there is not enough memory" + (f": {error}" if str(error) else ""),
            "end other programs, or raise the limit (ulimit -v), and start again",
        )
    else:
        wrapped = UnexpectedFaultError(
            f"internal error: {type(error).__name__}: {error}",
            "this is a defect of the program: run again with --debug and report the traceback",
        )
    wrapped.__cause__ = error
    return wrapped


def reading_fault(layout: Layout, reading: Any) -> str | None:
    """Return what is wrong with a reading, as the end of a sentence; None if it has a value or None
    for every column of the layout, of the column's kind, and nothing else."""
    if not isinstance(reading, Mapping):
        return f"{_kind(reading)}, not a reading (a dict)"
    columns = {column.key: column for column in layout.columns}
    for key in reading:
        if key not in columns and key != TRUTH:
            near = difflib.get_close_matches(str(key), columns.keys() - reading.keys(), 1)
            meant = f"; did you mean {near[0]!r}?" if near else ""
            return f"{key!r}, which its layout does not declare{meant}"
    for key, column in columns.items():
        if key not in reading:
            return f"no {key!r}, which its layout declares (use None for no value)"
        if not _fits(column, reading[key]):
            kind = "a number" if column.kind == "number" else "text"
            value = shortened(repr(reading[key]))
            return f"{key!r} = {value} ({_kind(reading[key])}), which its layout declares as {kind}"
    return None


def _fits(column: Column, value: Any) -> bool:
    if value is None:
        return True
    if column.kind == "text":
        return isinstance(value, str)
    return isinstance(value, Real) or type(value).__name__ in ("bool_", "bool")


def _kind(value: Any) -> str:
    """Return what kind of value this is, with its article."""
    name = type(value).__name__
    return "None" if value is None else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def _quoted(value: Any) -> str:
    """Return a value as its package writes it, shortened."""
    try:
        return shortened(repr(value))
    except Exception:  # noqa: BLE001 - a number of 5000 digits, or a fault of the package
        return "a value"


def _blame(procedure: type[Procedure], error: BaseException) -> RigError:
    """Return the error that reports an exception: a fault of a foreign package if its code took
    part."""
    name = package_of(procedure)
    if name == OWN_PACKAGE:
        return internal(error)
    top = procedure.__module__.split(".")[0]
    return _package_fault(name, place_in(top, error), error)


def driver_fault(plan: BenchPlan, error: BaseException | None) -> RigError | None:
    """Return the error that reports an exception from a driver of another package; None for an
    exception in which none took part, and for errors that say what is wrong already."""
    if error is None or isinstance(error, (RigError, MemoryError)):
        return None
    for part in plan.instruments:
        entry = foreign(part)
        if entry is not None and (place := place_in(entry.module.split(".")[0], error)):
            fault = _package_fault(package(entry), place, error)
            fault.__cause__ = error
            return fault
    return None


def _package_fault(name: str, place: str, error: BaseException) -> ProcedureFaultError:
    message = " ".join(str(error).split())
    text = shortened(f"{place}{type(error).__name__}: {message}", LONGEST_REASON)
    return ProcedureFaultError(
        f"a fault in the package {name}: {text}",
        "the traceback is in rig.log; report it to whoever maintains the package",
    )
