"""What a procedure is: data plus one act.

    points(settings) -> tuple[Point, ...]     # pure: what will be done, with every move
    arm(run)                                  # make ready; everything switched on registers its off
    take(run, point) -> Reading               # act: one point
    refine(settings, readings) -> tuple[Point, ...]   # optional and pure: further points
    invalid(settings, reading) -> str         # optional and pure: why a reading does not count
    check(settings, bench)                    # optional: refuses what the bench does not allow and
                                              # no move says, before anything is armed
    import_ahead()                            # optional: what takes long to import, while nothing
                                              # is switched on yet
    overhead_s(settings, fixture, homed) -> float   # optional and pure: bench time that the
                                              # points' own leaves out: arming, making safe; homed:
                                              # the stages know where they are and are parked
    DRIFT: Mapping[str, DriftFigure]          # optional: figures of the summary by which its run
                                              # as a batch's reference shows wear

A reading that does not count is kept all the same and says so; with settings of a number
``retry_invalid``, the point is discarded and taken again up to so many times before.

The runner owns the loop between them. From this split come the check of all points before the
first motion, progress, dry runs, discarding and retaking a point, and resuming at the point where
a run was interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rig.bench.bench import Fixture
from rig.core.settings import Settings
from rig.files.journal.layout import Layout
from rig.run.points import Point, Reading

if TYPE_CHECKING:
    from rig.run.context import Run


@dataclass(frozen=True)
class StreamPlan:
    """One stream that a procedure emits: raw counts of a converter, or numbers of another kind."""

    name: str
    device: str
    channels: tuple[str, ...]
    long_name: str
    dtype: str = "<i2"
    """NumPy's notation."""
    units: str = "count"


@dataclass(frozen=True)
class DriftFigure:
    """What a figure of the summary says of the bench, where the same run is made again."""

    what: str
    """In words, such as ``gain near 200 Hz``."""
    part: str
    """Of the bench, that it speaks of: ``film``, ``strip_1``, ``strip_2``."""
    tolerance: float
    """How far it may move from the first run's, in the figure's own unit."""


class Procedure(Protocol):
    """What an entry point of group ``rig.procedures`` names: a module with these members."""

    NAME: str
    FIXTURES: tuple[Fixture, ...]
    """Fixtures it can work with."""
    Settings: type[Settings]
    LAYOUT: Layout
    """How readings become the run file's plots."""
    STREAMS: tuple[StreamPlan, ...]

    def points(self, settings: Any) -> tuple[Point, ...]:
        """All points of a run, from the settings alone."""
        ...

    def arm(self, run: Run) -> None:
        """Switch on what the points need; each thing switched on registers its off."""
        ...

    def take(self, run: Run, point: Point) -> Reading:
        """Take one point."""
        ...

    def summarise(self, settings: Any, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Figures of the whole run for the closing summary and ``--json``."""
        ...
