"""Points: the conditions of a run as plain values, checked before anything moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rig.bench.bench import Bench, BenchPlan, require
from rig.core.errors import ConfigurationError, LimitError, RigError
from rig.instruments.roles import Acquisition

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


def require_roles(points: Sequence[Point], plan: BenchPlan) -> None:
    """Refuse, before anything is connected, a bench without what the points ask of it: its
    instruments, and its load cell where they load it."""
    needed = {move.quantity.split(".")[0] for point in points for move in point.moves}
    if any(point.acquisitions for point in points):
        needed.add("daq")
    there = {part.role for part in plan.instruments}
    if plan.settings.load_cell is not None:
        there.add("load_cell")
    if missing := sorted(needed - there):
        tables = " and ".join(f"[{role}]" for role in missing)
        raise ConfigurationError(
            f"{plan.source}: this procedure needs what the bench has not: {', '.join(missing)}",
            f"add {tables}, or name another bench with --bench",
        )


def check_points(points: Sequence[Point], bench: Bench, taken: Iterable[str] = ()) -> None:
    """Refuse, before anything moves, every value outside a limit; ids must be unique, also among
    those of an earlier plan that are `taken`."""
    for error in refusals(points, bench, taken):
        raise error


def refusals(
    points: Sequence[Point], bench: Bench, taken: Iterable[str] = ()
) -> Iterator[RigError]:
    """All that `check_points` refuses."""
    if not points:
        yield ConfigurationError("there is no point to take", "ask for at least one")
    seen: set[str] = set(taken)
    reach = bench.reach()
    for point in points:
        if point.id in seen:
            yield ConfigurationError(
                f"point {point.id} is asked for twice", "remove one of the two"
            )
        seen.add(point.id)
        for move in point.moves:
            if move.quantity not in reach:
                role = move.quantity.split(".")[0]
                yield ConfigurationError(
                    f"point {point.id} needs {move.quantity}, which this bench has not",
                    f"add a [{role}] table to {bench.plan.source}",
                )
                continue
            name = move.quantity.replace(".", " ")
            try:
                require(name, move.value, reach[move.quantity], f"point {point.id}")
            except LimitError as error:
                yield error
        for acquisition in point.acquisitions:
            try:
                bench.daq.check(acquisition)
            except LimitError as error:
                yield LimitError(f"point {point.id}: {error.message}", error.hint)
