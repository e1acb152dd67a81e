"""What a procedure is: data plus one act.

    points(settings) -> tuple[Point, ...]     # pure: what will be done, with every move
    arm(run)                                  # make ready; everything switched on registers its off
    take(run, point) -> Reading               # act: one point

The runner owns the loop between them. From this split come the check of all points before the
first motion, progress, dry runs, discarding and retaking a point, and resuming at the point where
a run was interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rig.instruments import Acquisition
from rig.settings import Settings

if TYPE_CHECKING:
    from rig.bench import Bench, Fixture
    from rig.recording.layout import Layout
    from rig.runner.run import Run

Reading = dict[str, float | int | bool | str | None]
"""What a point gave: plain numbers by name, as they go into the run file."""


@dataclass(frozen=True)
class Move:
    """A value that a point will ask of the bench: ``generator.frequency`` = 200."""

    quantity: str
    value: float


@dataclass(frozen=True)
class Point:
    """One condition within a procedure."""

    id: str
    """Stable name: the same settings give the same ids, whatever the order or the day."""
    condition: Any
    """What the procedure needs to know to take it."""
    moves: tuple[Move, ...]
    """Every value it will ask of an instrument, checked before the first motion."""
    acquisitions: tuple[Acquisition, ...] = ()
    """Every acquisition it will ask of the DAQ, checked before the first motion."""
    duration_s: float = 0.0
    """Bench time it is expected to take."""


@dataclass(frozen=True)
class StreamPlan:
    """One stream of raw counts that a procedure emits."""

    name: str
    device: str
    channels: tuple[str, ...]
    long_name: str


class Procedure(Protocol):
    """What an entry point of group ``rig.procedures`` names: a module with these members."""

    NAME: str
    FIXTURES: tuple[Fixture, ...]
    """Fixtures it can work with."""
    Settings: type[Settings]
    LAYOUT: Layout
    """How readings become the run file's plots."""
    STREAMS: tuple[StreamPlan, ...]
    FIGURE: str
    """Which figure shows a run: a function of ``rig.figures``."""

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


def check_points(points: Sequence[Point], bench: Bench) -> None:
    """Refuse, before anything moves, every value outside a limit; ids must be unique."""
    from rig.bench import require
    from rig.errors import ConfigurationError, LimitError

    if not points:
        raise ConfigurationError("there is no point to take", "ask for at least one")
    seen: set[str] = set()
    reach = bench.reach()
    for point in points:
        if point.id in seen:
            raise ConfigurationError(
                f"point {point.id} is asked for twice", "remove one of the two"
            )
        seen.add(point.id)
        for move in point.moves:
            if move.quantity not in reach:
                role = move.quantity.split(".")[0]
                raise ConfigurationError(
                    f"point {point.id} needs {move.quantity}, which this bench has not",
                    f"add a [{role}] table to {bench.plan.source}",
                )
            name = move.quantity.replace(".", " ")
            require(name, move.value, reach[move.quantity], f"point {point.id}")
        for acquisition in point.acquisitions:
            try:
                bench.daq.check(acquisition)
            except LimitError as error:
                raise LimitError(f"point {point.id}: {error.message}", error.hint) from error
