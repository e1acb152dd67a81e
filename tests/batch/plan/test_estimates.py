"""What a plan is expected to take."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from calibrated import write_record

from procedures.roll_trial import RollTrial
from procedures.slip_trial import SlipTrial
from procedures.sweep import Sweep
from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.estimate import ExpectedRun, expect, forecast, homing_s
from rig.batch.plan.expand import expand
from rig.batch.plan.settings import BatchFile, BatchSettings
from rig.bench.plan import BenchPlan, parse_bench
from rig.bench.settings import FixtureSettings

NOW = datetime(2026, 11, 22, 20, 0, tzinfo=UTC)
PLATE = FixtureSettings(mounted="plate", contact_from_mm=12.0, contact_to_mm=13.0)
CLAMP = FixtureSettings(mounted="film-clamp", contact_from_mm=12.0, contact_to_mm=13.0)
HEAD = FixtureSettings(
    mounted="semi-spherical-object",
    contact_from_mm=12.0,
    contact_to_mm=13.6,
    centre_mm=20.0,
    upright_deg=0.0,
)
PLACES = {"slip-trial": PLATE, "sweep": CLAMP, "roll-trial": HEAD}


def plan_of(*experiments: dict[str, Any]) -> BatchPlan:
    whole = [{"procedure": "slip-trial", **experiment} for experiment in experiments]
    return expand(BatchFile.model_validate({"batch": {"name": "night"}, "experiment": whole}))


def batch(**own: Any) -> BatchSettings:
    return BatchSettings.model_validate({"name": "night", **own})


def of_one(procedure: str = "slip-trial", real: bool = False, **settings: Any) -> ExpectedRun:
    (expected,) = expect(
        plan_of({"procedure": procedure, "settings": settings}), PLACES, real
    ).values()
    return expected


# --- one run ----------------------------------------------------------------------------------

TAKEN_S = [
    ("slip-trial", {}, 16.1),
    ("slip-trial", {"trials": 4}, 33.2),
    ("slip-trial", {"speed_mm_s": 5.0, "distance_mm": 5.0}, 20.2),
    ("slip-trial", {"loading": "ramp"}, 16.0),
    ("roll-trial", {"trials": 3}, 36.1),
    ("sweep", {"frequencies_Hz": "200,300,500,1000"}, 18.4),
    ("sweep", {"frequencies_Hz": "2,5,20,100,2000,10000"}, 22.8),
    ("sweep", {}, 31.7),
    ("sweep", {"loads_N": "1,2"}, 48.9),
    ("sweep", {"loads_N": "1,2,5"}, 65.3),
    ("sweep", {"lowest_Hz": 100.0, "highest_Hz": 3000.0}, 22.1),
    ("sweep", {"points_per_half_width": 0}, 30.5),
]
"""Bench time of runs on the simulated bench, all of which begin unhomed."""


@pytest.mark.parametrize(("procedure", "settings", "taken_s"), TAKEN_S)
def test_a_run_takes_what_is_expected_of_it(
    procedure: str, settings: dict[str, Any], taken_s: float
) -> None:
    expected = of_one(procedure, **settings)
    assert abs(expected.duration_s - taken_s) < 2 * expected.spread_s
    assert expected.duration_s == pytest.approx(taken_s, rel=0.1)


def test_what_takes_longer_is_expected_to() -> None:
    longer: list[tuple[dict[str, Any], dict[str, Any], float]] = [
        ({"rest_s": 0.0}, {"rest_s": 5.0}, 5.0),
        ({"distance_mm": 1.0}, {"distance_mm": 3.0}, 4.0),
        ({"distance_mm": 1.0, "trials": 2}, {"distance_mm": 3.0, "trials": 2}, 8.2),
    ]
    for short, long, difference_s in longer:
        found_s = of_one(**long).duration_s - of_one(**short).duration_s
        assert found_s == pytest.approx(difference_s, abs=0.01)


def test_the_less_is_known_of_the_contact_the_wider_is_the_spread() -> None:
    plan = plan_of({})
    vague = PLATE.model_copy(update={"contact_to_mm": 15.0})
    (sure,), (unsure,) = (
        expect(plan, {"slip-trial": place}, real=False).values() for place in (PLATE, vague)
    )
    assert unsure.spread_s > 2 * sure.spread_s


def test_a_bench_that_stands_there_homes_once() -> None:
    plan = plan_of({"repeat": 10})
    (simulated,), (real,) = (expect(plan, PLACES, real).values() for real in (False, True))
    first_s = homing_s(plan, PLACES)
    assert 1.0 < first_s < 7.0
    assert real.duration_s < simulated.duration_s
    once = forecast(batch(), plan, {"slip-trial-001": real}, NOW, first_s)
    assert once.duration_s == pytest.approx(10 * real.duration_s + first_s)


def test_a_run_file_is_about_as_large_as_it_becomes() -> None:
    files_B = [
        (of_one(), 674_388),
        (of_one(trials=4), 1_698_792),
        (of_one("roll-trial", trials=3), 1_233_291),
        (of_one("sweep"), 4_178_643),
    ]
    for expected, size_B in files_B:
        assert size_B / 2 < expected.size_B < 2.5 * size_B


def test_every_procedure_expects_to_take_time() -> None:
    for kind in (SlipTrial, RollTrial, Sweep):
        procedure = kind(kind.Settings())
        assert all(point.duration_s > 0 for point in procedure.points())
        place = PLACES[procedure.name]
        unhomed_s, homed_s = (procedure.overhead_s(place, homed) for homed in (False, True))
        assert 0 < homed_s < unhomed_s


# --- the night --------------------------------------------------------------------------------


def test_runs_follow_one_another_with_their_rests() -> None:
    plan = plan_of({"repeat": 3, "rest_s": 60})
    one = of_one()
    night = forecast(batch(), plan, {"slip-trial-001": one}, NOW)
    assert night.begins == NOW
    assert night.duration_s == pytest.approx(3 * (60 + one.duration_s))
    assert night.ends == NOW + timedelta(seconds=night.duration_s)
    begins = [placed.begins for placed in night.runs]
    gaps = [(b - a).total_seconds() for a, b in itertools.pairwise(begins)]
    assert gaps == pytest.approx([60 + one.duration_s] * 2, abs=1e-5)
    assert night.size_B == 3 * one.size_B


def test_what_all_runs_share_adds_up_and_what_they_do_not_averages() -> None:
    plan = plan_of({"repeat": 100})
    shared = forecast(batch(), plan, {"slip-trial-001": ExpectedRun(10.0, 1.0, 0)}, NOW)
    assert shared.spread_s == pytest.approx(100.0, rel=0.01)
    own = forecast(batch(), plan, {"slip-trial-001": ExpectedRun(10.0, 0.0, 0)}, NOW)
    assert own.spread_s < 2.0


@pytest.mark.parametrize(
    ("common_s", "in_time"),
    [
        (0.0, 9),  # the tenth would end at 22:10:00, and making safe may take 10 s
        (40.0, 8),  # two standard deviations more for each: the ninth would end at 22:10:30
    ],
)
def test_a_window_places_the_batch_and_says_how_many_runs_are_in_time(
    common_s: float, in_time: int
) -> None:
    plan = plan_of({"repeat": 100})
    night = forecast(
        batch(not_before="22:00", stop_by="22:10"),
        plan,
        {"slip-trial-001": ExpectedRun(60.0, common_s, 0)},
        NOW,
    )
    assert night.begins == NOW.replace(hour=22)
    assert night.stop_by == NOW.replace(hour=22, minute=10)
    assert night.in_time == in_time


def bench_with(folder: Path, valid_until: str) -> BenchPlan:
    write_record(folder / "cell.json", NOW - timedelta(days=100), valid_until)
    text = '[fixture]\nmounted = "plate"\n[calibrations]\nload_cell = "cell.json"\n'
    return parse_bench('name = "bench-6"\n' + text, str(folder / "bench.toml"))


@pytest.mark.parametrize(
    ("valid_until", "expires"),
    [
        ("2026-11-22T20:30:00+00:00", True),
        ("2026-11-22T21:30:00+00:00", False),
        ("2026-11-22T19:30:00+00:00", False),
    ],
    ids=["on the way", "after the end", "before: it is refused"],
)
def test_a_record_that_expires_on_the_way_is_named(
    tmp_path: Path, valid_until: str, expires: bool
) -> None:
    plan = plan_of({"repeat": 60})
    expected = {"slip-trial-001": ExpectedRun(60.0, 0.0, 0)}
    night = forecast(batch(), plan, expected, NOW, bench=bench_with(tmp_path, valid_until))
    assert [one.path.name for one in night.expiring] == (["cell.json"] if expires else [])


def test_a_batch_without_records_has_none_that_expire() -> None:
    plan = plan_of({})
    assert not forecast(batch(), plan, {"slip-trial-001": of_one()}, NOW).expiring
