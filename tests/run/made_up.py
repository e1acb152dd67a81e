"""A procedure, a bench and a run of both, put together for tests of the runner."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.bench.plan import BenchPlan, InstrumentPlan
from rig.bench.settings import BenchSettings
from rig.core.clock import Clock, WallClock
from rig.core.settings import Settings
from rig.files.journal.layout import Column, Layout, Plot
from rig.instruments.roles import Identity
from rig.run import execute as execution
from rig.run.context import Run
from rig.run.execute import execute
from rig.run.job import RunJob
from rig.run.making_safe.guard_link import TakenOver
from rig.run.observers import RunObserver
from rig.run.outcome import RunOutcome
from rig.run.points import Point, Reading
from rig.run.procedure import Procedure
from rig.run.stopping import StopFlag

LAYOUT = Layout(
    definition="NXrig_noop",
    version="1",
    columns=(
        Column("x", "V", "x"),
        Column("y", "mm/s", "y"),
        Column("note", "", "Note", "text"),
    ),
    plots=(Plot("data", "y", ("x",)),),
)


class Instrument:
    """An instrument that does nothing."""

    identity = Identity("made up", "made up", "SIM1", "0")

    def limits(self) -> Mapping[str, Any]:
        return {}

    def close(self) -> None:
        pass


class Example(Procedure):
    """The smallest procedure: two points, one thing that is switched on and off."""

    name, fixtures = "example", ("film-clamp",)
    Settings, layout = Settings, LAYOUT

    def __init__(self, settings: Settings):
        super().__init__(settings)
        self.log: list[str] = []

    def points(self) -> tuple[Point, ...]:
        return Point("first", 1, ()), Point("second", 2, ())

    def arm(self, run: Run) -> None:
        run.arm("lamp", lambda: self.log.append("off"), done="lamp off")
        self.log.append("on")

    def take(self, run: Run, point: Point) -> Reading:
        run.clock.sleep(0.01)
        self.log.append(point.id)
        return {"x_V": float(point.condition), "y_mm_s": None, "note": ""}

    def summarise(self, readings: Any) -> Mapping[str, Any]:
        return {"points": len(readings)}


class Guard:
    """What the run reports to its guard."""

    taken_over = TakenOver(True, "the guard then made the bench safe", released=True)
    """Result of its try on a bench that the run could not make safe."""

    def __init__(self, log: list[str]) -> None:
        self._log = log

    pid = 0

    def beat(self) -> None:
        pass

    def limit(self, limit_N: float) -> None:
        pass

    def zero(self, raw: object) -> None:
        pass

    def trouble(self) -> None:
        pass

    def hangs(self, what: str) -> None:
        pass

    def safe(self) -> None:
        self._log.append("guard: safe")

    def done(self) -> None:
        self._log.append("guard: done")

    def take_over(self, over_limit: Sequence[str] = (), cause: str = "") -> TakenOver:
        self._log.append(f"guard: take over {', '.join(over_limit)}")
        return self.taken_over


def run_of(
    procedure: Example,
    folder: Path,
    patch: pytest.MonkeyPatch,
    *observers: RunObserver,
    stop: StopFlag | None = None,
    clock: Clock | None = None,
    pauses: bool = False,
) -> RunOutcome:
    """Execute a procedure on a bench with one instrument; nothing else is replaced but the guard,
    which is a process of its own, and unless it `pauses` the handler of Ctrl-Z, which only the main
    thread may set."""
    patch.setattr(execution, "GuardLink", lambda *_: Guard(procedure.log))
    if not pauses:
        patch.setattr(execution, "PauseSwitch", lambda _: contextlib.nullcontext())
    driver: Any = SimpleNamespace(connect=lambda settings, clock: Instrument())
    part = InstrumentPlan("generator", "made-up", driver, Settings())
    own = BenchSettings.model_validate({"name": "b", "fixture": {"mounted": "film-clamp"}})
    plan = BenchPlan(own, (part,), "", "bench.toml")
    job = RunJob(procedure, 0, folder)
    return execute(job, plan, clock or WallClock(), stop or StopFlag(), *observers)
