"""A plan against a bench: what is mounted, what is there, every limit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest

from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.expand import expand
from rig.batch.plan.findings import RefusedBatchError
from rig.batch.plan.settings import BatchFile
from rig.batch.plan.validate import BenchConnector, ValidationResult, validate
from rig.bench.connected import Bench
from rig.bench.link_worker import LinkWorkers
from rig.bench.plan import BenchPlan, InstrumentPlan, parse_bench
from rig.bench.settings import Fixture
from rig.core.clock import WallClock
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.settings import Settings
from rig.instruments.roles import Acquisition, Limits

BENCH = """
name = "bench-5"
[fixture]
mounted = "plate"
contact_from_mm = 12.0
contact_to_mm = 13.0
"""
ALSO = """
[[also_mounted]]
mounted = "film-clamp"
contact_from_mm = 2.0
contact_to_mm = 3.0
parked_mm = 1.0
"""


class Instrument:
    """Something with limits."""

    def __init__(self, **highest: float):
        self._highest = highest

    def limits(self) -> dict[str, Limits]:
        return {name: Limits(0.0, high, "u", "it") for name, high in self._highest.items()}

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        return (10.0,)

    def check(self, acquisition: Acquisition) -> None:
        """Any acquisition."""

    def close(self) -> None:
        """Nothing is open."""


INSTRUMENTS: dict[str, Any] = {
    "generator": Instrument(frequency=50e3, amplitude=5.0),
    "daq": Instrument(),
    "stage_z": Instrument(position=20.0, speed=20.0, update_rate=1000.0),
    "stage_x": Instrument(position=40.0, speed=20.0),
    "force_sensor": Instrument(force=40.0),
}
LOAD_CELL = """
[load_cell]
sensitivity_V_N = 0.1
[daq]
driver = "keysight-u2300a"
resource = "TCPIP::1::INSTR"
channels = { load_cell = 101 }
"""


class InstrumentSettings(Settings):
    """Settings of every instrument of these benches; a run demands the limit of the z stage."""

    torque_limit_percent: float = 30.0


def equipped(plan: BenchPlan) -> BenchPlan:
    """The plan of a bench that has these instruments."""
    driver: Any = ModuleType("driver")
    parts = [InstrumentPlan(role, "", driver, InstrumentSettings()) for role in INSTRUMENTS]
    return replace(plan, instruments=tuple(parts))


def plan_of(*experiments: dict[str, Any]) -> BatchPlan:
    whole = [{"procedure": "slip-trial", **experiment} for experiment in experiments]
    return expand(BatchFile.model_validate({"batch": {"name": "night"}, "experiment": whole}))


def benches() -> tuple[BenchConnector, list[Fixture]]:
    """Benches with these instruments, and which fixtures they were asked for."""
    asked: list[Fixture] = []

    @contextmanager
    def connected(fixture: Fixture) -> Iterator[Bench]:
        asked.append(fixture)
        text = BENCH.replace("plate", fixture) + LOAD_CELL
        clock = WallClock()
        plan = equipped(parse_bench(text, "simulated"))
        yield Bench(plan, clock, INSTRUMENTS, LinkWorkers(clock))

    return connected, asked


def check(plan: BatchPlan, text: str | None) -> tuple[ValidationResult, list[Fixture]]:
    real = None if text is None else equipped(parse_bench(text, "bench.toml"))
    connected, asked = benches()
    return validate(plan, real, connected), asked


# --- what is mounted --------------------------------------------------------------------------

TWO = (
    {"matrix": {"speed_mm_s": [0.2, 0.5]}},
    {"procedure": "sweep", "name": "film", "settings": {"frequencies_Hz": [200.0]}, "repeat": 5},
)


def test_a_batch_that_needs_another_fixture_half_way_is_refused_with_its_runs_and_a_remedy() -> (
    None
):
    checked, asked = check(plan_of(*TWO), BENCH)
    (finding,) = checked.findings
    assert finding.where == ("experiment", 1, "procedure")
    assert "sweep (run 3, 4, 5 and 2 more) needs the film-clamp, the bench has the plate" in (
        finding.text
    )
    assert '[[also_mounted]] mounted = "film-clamp" in bench.toml' in (finding.hint or "")
    assert asked == ["plate"], "the rest is checked all the same"


def test_fixtures_that_are_mounted_together_serve_one_batch() -> None:
    checked, asked = check(plan_of(*TWO), BENCH + ALSO + LOAD_CELL)
    assert not checked.findings
    assert asked == ["plate", "film-clamp"]


def test_what_only_the_simulated_bench_has_is_missed_on_the_real_one() -> None:
    (finding,) = check(plan_of(*TWO), BENCH + ALSO)[0].findings
    assert "film-001: bench.toml: the bench lacks what this procedure needs: load_cell" in (
        finding.message
    )


def test_simulated_benches_of_the_runs_own_have_what_each_needs() -> None:
    checked, asked = check(plan_of(*TWO), None)
    assert not checked.findings
    assert asked == ["plate", "film-clamp"]
    assert checked.fixtures["sweep"].mounted == "film-clamp"
    assert checked.fixtures["slip-trial"].mounted == "plate"


# --- limits -----------------------------------------------------------------------------------


def test_every_limit_of_every_condition_is_reported_once_with_its_experiment() -> None:
    plan = plan_of(
        {"matrix": {"speed_mm_s": [0.5, 21.0], "start_mm": [39.5, 41.0, 10.0]}},
        {"settings": {"largest_force_N": 50.0}},
    )
    checked, _ = check(plan, None)
    reported = [finding.text.split(" u is outside")[0] for finding in checked.findings]
    assert reported == [
        "experiment 1: slip-trial-001 and 1 more: point trial-001: stage_x position 40.5",
        "experiment 1: slip-trial-002 and 1 more: point trial-001: stage_x position 41",
        "experiment 1: slip-trial-002 and 1 more: point trial-001: stage_x position 42",
        "experiment 1: slip-trial-004 and 2 more: point trial-001: stage_x speed 21",
        "experiment 2: slip-trial-2-001: point trial-001: force_sensor force 50",
    ]
    error = RefusedBatchError(checked.findings)
    assert error.code is ExitCode.LIMIT
    assert {part.code for part in error.parts()} == {ExitCode.LIMIT}


def test_a_limit_that_only_the_points_know_is_reported_too() -> None:
    plan = plan_of(
        {"procedure": "sweep", "settings": {"preload_N": 5}, "matrix": {"load_N": [3, 4]}}
    )
    (finding,) = check(plan, None)[0].findings
    assert "sweep-002: --load 4 N (peak) is not below 0.8 of --preload" in finding.message


def test_a_roll_beyond_the_stage_is_refused_before_anything_begins() -> None:
    plan = plan_of({"procedure": "roll-trial"})
    (finding,) = check(plan, None)[0].findings
    assert "lacks what this procedure needs: rotary" in finding.message


# --- the bench file ---------------------------------------------------------------------------


def test_a_plan_on_another_mounted_fixture_has_its_places() -> None:
    plan = parse_bench(BENCH + ALSO, "bench.toml")
    assert plan.mounted == ("plate", "film-clamp")
    assert plan.on("plate") is plan
    clamp = plan.require_fixture("film-clamp")
    assert clamp.settings.fixture.parked_mm == 1.0
    assert clamp.mounted == ("film-clamp", "plate")
    assert clamp.on("plate").settings == plan.settings
    with pytest.raises(ConfigurationError, match="has the plate and the film-clamp mounted"):
        plan.require_fixture("semi-spherical-object")


def test_a_fixture_is_mounted_once() -> None:
    with pytest.raises(ConfigurationError, match="name the plate twice"):
        parse_bench(BENCH + ALSO.replace("film-clamp", "plate"), "bench.toml")
