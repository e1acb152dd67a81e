"""The base class of a procedure, which is a kind of experiment.

A package registers its class under the entry-point group ``rig.procedures``:

    [project.entry-points."rig.procedures"]
    creep = "lab.creep:Creep"

The command ``rig creep`` makes one instance for each run, with the settings of that run. Anything
that a procedure has to remember from one point to the next is an attribute of that instance.

Hooks are called in this order:

    import_ahead()                    before anything is connected
    points()                          the plan, checked against every limit of the bench
    check(bench)                      connected, nothing armed yet
    overhead_s(fixture, homed)        for the estimate of the time that is left
    refining_s()                      for the same
    arm(run)                          before the first point, and again after every hold and trip
    take(run, point)                  each point in turn
    retries_of_invalid()              before each point
    why_invalid(reading)              after each point
    refine(readings)                  after the last point of the first plan: further points
    summarise(readings)               when the bench is safe and the data are on the disk
    put_in(readings, summary)         after it, for a run on a simulated bench
    in_brief(summary, put_in)         when `rig show` shows the file

The planning hooks (all but `check`, `arm` and `take`) must not touch an instrument: they are called
without one, for instance when a batch is planned. The runner owns the loop between the hooks. From
this split follow progress, dry runs, discarding and retaking a point, and resuming a run at the
point where it was interrupted.

What a hook raises: a `RigError` is reported as it is. Any other exception is a fault of the package
that the procedure belongs to and is reported as such, with file and line. In both cases the bench
is made safe, the data are saved and the failure is reported.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from rig.bench.connected import Bench
from rig.bench.settings import Fixture, FixtureSettings
from rig.core.settings import Settings as BaseSettings
from rig.files.journal.layout import Layout
from rig.run.in_brief import single_values
from rig.run.points import Point, Reading

if TYPE_CHECKING:
    from rig.run.context import Run


@dataclass(frozen=True)
class StreamPlan:
    """One stream that a procedure records: raw counts of a converter, or other numbers."""

    name: str
    device: str
    channels: tuple[str, ...]
    long_name: str
    dtype: str = "<i2"
    """Data type of the samples in NumPy's notation."""
    units: str = "count"
    """Unit of the rows as they are; empty where it is the one that they are recorded with, since
    only the instrument knows."""
    times: str = ""
    """Name of the stream, of one channel, that has the times of these rows in s since the record
    began, row by row; for rows without a rate of their own."""


@dataclass(frozen=True)
class DriftFigure:
    """A number of the summary that shows wear of the bench when the same run is repeated."""

    what: str
    """Name of the quantity, such as ``gain near 200 Hz``."""
    part: str
    """Part of the bench that it depends on: ``film``, ``strip_1``, ``strip_2``."""
    tolerance: float
    """Largest allowed difference from the first run, in the unit of the quantity."""


class Procedure(ABC):
    """A kind of experiment. The first line of a subclass's docstring is its command's help text."""

    name: ClassVar[str]
    """Name of the command and of the run files; equal to the name of the entry point."""
    fixtures: ClassVar[tuple[Fixture, ...]]
    """Fixtures it can work with. A simulated bench gets the first one."""
    Settings: ClassVar[type[BaseSettings]]
    """Settings class of the procedure. Each field becomes an option of the command."""
    layout: ClassVar[Layout]
    """Columns of the readings, and how the run file plots them and the streams."""
    streams: ClassVar[tuple[StreamPlan, ...]] = ()
    """Every stream that `take` records."""
    drift: ClassVar[Mapping[str, DriftFigure]] = MappingProxyType({})
    """Numbers of the summary by which a batch's reference run shows wear, by their key."""
    stated_in_title: ClassVar[str] = ""
    """Field of the settings whose value the title of a run states, such as ``preload_N``
    (`values_in_title`)."""
    summary_labels: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Label and, after a semicolon, unit of values of the summary, by name, for the terminal. The
    other values are shown by their names."""
    put_in_label: ClassVar[str] = "true value"
    """What the values of `put_in` are, where `in_brief` shows them with the measured ones."""
    method: ClassVar[str] = ""
    """How the summary is computed, in a sentence for the run file."""
    summary_origins: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Where values of the summary come from that were not measured, by name: ``set`` for a setting,
    ``calibrated`` for a number of a calibration, or in words. A dotted name reaches into tables
    (``model.bounds``); a table's origin is that of all that is in it."""
    force_axes: ClassVar[str] = "z"
    """Axes of the force sensor that it cannot do without, such as ``xz`` for a friction. A run with
    a sensor that lacks one is refused before anything is armed."""
    reading_hook: ClassVar[str] = "take"
    """Name of the method whose return value becomes the reading, for messages about a wrong one."""
    point_name: ClassVar[tuple[str, str]] = ("point", "points")
    """Noun for one of its points, and for several."""

    settings: Any
    """Settings of this run. A subclass may declare its own type: ``settings: CreepSettings``."""

    def __init__(self, settings: Any):
        self.settings = settings

    # --- planning: no instrument is touched -----------------------------------------------------

    def import_ahead(self) -> None:  # noqa: B027 - a hook that need not do anything
        """Import slow modules, before anything is connected or switched on.

        Called once, first of all hooks, while a simulated bench boots.
        """

    @abstractmethod
    def points(self) -> tuple[Point, ...]:
        """Return all points of the run, from the settings alone.

        Called several times, before anything is connected and while a batch is planned: equal
        settings must give equal points with equal ids. Each point lists the values that it will ask
        of the instruments; the run is refused before any motion if one is outside a limit. Raise
        ConfigurationError or LimitError for settings that cannot be run.
        """

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the bench time in s that `arm` and making safe take in all.

        The durations of the points leave it out. `homed`: the stages know where they are and are
        parked already. Only estimates of time depend on it.
        """
        return 0.0

    def refining_s(self) -> float:
        """Return the bench time in s that the points of `refine` are expected to take.

        Only estimates of time depend on it.
        """
        return 0.0

    def check(self, bench: Bench) -> None:  # noqa: B027 - a hook that need not do anything
        """Raise ConfigurationError or LimitError for a bench that the run cannot work on.

        Called once, after the points were checked and before anything is armed. It may read
        settings and limits of the connected instruments; it must not move or switch anything.
        """

    def refine(self, readings: Sequence[Reading]) -> tuple[Point, ...]:
        """Return further points where the readings of the first plan call for them.

        Called once, after the last point of `points`, with the bench still armed; `readings` are
        in the order of the plan. The new points are checked like the first ones.
        """
        return ()

    def why_invalid(self, reading: Reading) -> str:
        """Return why a reading is invalid, in words; "" for a valid one.

        Called after each point. An invalid reading is recorded all the same, reported at the end
        of the run, and makes its exit code 5. Before that, its point is discarded and retaken as
        often as `retries_of_invalid` says. Where the layout has a text column ``invalid``, that
        gets the reason, and a reading for which this fails is invalid; without that column a
        failure here ends the run.
        """
        return ""

    def retries_of_invalid(self) -> int:
        """Return how many times a point with an invalid reading is retaken before it is recorded.

        Called before each point.
        """
        return 0

    # --- acting: instruments may be used --------------------------------------------------------

    @abstractmethod
    def arm(self, run: Run) -> None:
        """Switch on what the points need and bring the bench to where the first one can begin.

        Called before the first point, and again after each hold and trip, when everything has been
        switched off: what has to last from one arming to the next must not be made again. Register
        how a thing is switched off (`run.arm`) before you switch it on. An exception ends the run:
        what was registered is switched off, in reverse order.
        """

    @abstractmethod
    def take(self, run: Run, point: Point) -> Reading:
        """Measure one point and return its reading, with a value for every column of the layout.

        Called once for each point in the order of the plan, and again for a point that a hold, a
        trip or an invalid reading has disturbed. Use ``run.clock.sleep`` for every wait, and
        ``run.check_stop()`` at least every 0.2 s while computing: stop requests and trips are
        raised there; let them pass. Use None for a column without a value. An exception discards
        the point and ends the run; `RetakeError` discards it and has it retaken, at most 10 times,
        and leaves the bench as a point finds it.
        """

    # --- afterwards -----------------------------------------------------------------------------

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return the results of the whole run for the closing lines and ``--json``.

        Called when the bench is safe and the data are on the disk, also for a run that was stopped,
        but not for one without a reading. It is called for old run files too (``rig show``). The
        run file has the result as ``/entry/results``. There, a table with the keys value,
        standard_error, low, high and unit is an estimate, and a table ``standard_errors`` has the
        errors of other values by their names. An exception costs the summary and is a warning, as
        is more than 120 s; the data stay saved.
        """
        return {}

    def put_in(self, readings: Sequence[Reading], summary: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what a simulated bench had put in, by the dotted name of the value of the summary
        that recovers it, in the same unit. Called for a simulated run, after `summarise`; for a
        list of tables a name has a list.
        """
        return {}

    def values_in_title(self) -> Sequence[float]:
        """Return the values that the title states of `stated_in_title`, where these are not the one
        of the settings; none if the title states nothing."""
        value = getattr(self.settings, self.stated_in_title, None)
        return (value,) if isinstance(value, float) else ()

    def in_brief(self, summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> Sequence[str]:
        """Return the summary in a few lines of at most 78 characters, the most important first.

        ``rig show`` calls it for files of this and of earlier versions: `summary` and `put_in` are
        those of the file. An exception costs nothing but the choice: the single values of the
        summary are shown then, as they are by default.
        """
        return single_values(summary, put_in, self.summary_labels, self.put_in_label)
