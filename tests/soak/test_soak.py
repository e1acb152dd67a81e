"""The soak: whatever goes wrong, the bench ends safe, the data are sound, and it is reported why.

A trial follows from its seed alone. One that fails is shrunk to the faults that it takes and shown
as the plan with which it can be run again.
"""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from benches import DECLARED_CONTACT
from forked_rig import server
from tiers import mostly_nightly

from .batches import BatchTrial, batch_breaches, run_batch
from .invariants import Ran, breaches, said_unheard_s
from .running import PATIENCE_S, run
from .trials import Fault, Trial, draw, shrunk, world_of

TRIALS = 33
SEED_BY_DEFAULT = 6
"""A sweep with three faults."""
ALIKE = {*range(32)} - {0, 2, 4, 8, 16, 20, 21, 22, 26, 31}
"""Seeds whose faults other seeds have, too, in the same device; nightly."""
SLIP_SHARE, ROLL_SHARE = 0.06, 0.04
"""They take three times as long as a short sweep; the benchmark makes more of them."""


SEEDS = mostly_nightly(
    range(TRIALS), sorted({*range(TRIALS)} - ALIKE - {SEED_BY_DEFAULT}), [SEED_BY_DEFAULT]
)


def failing(folder: Path) -> Callable[[Trial], bool]:
    """Whether a trial breaks an invariant, each try in a folder of its own."""
    numbers = itertools.count(1)
    return lambda trial: bool(breaches(run(server(), trial, folder / f"shrunk-{next(numbers)}")))


@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_goes_wrong_the_invariants_hold(seed: int, tmp_path: Path) -> None:
    trial = draw(seed, SLIP_SHARE, ROLL_SHARE)
    ran = run(server(), trial, tmp_path / "trial")
    if found := breaches(ran):
        smallest = shrunk(trial, failing(tmp_path))
        raise AssertionError(
            f"{len(found)} invariants broken by seed {seed}:\n"
            + "\n".join(found)
            + f"\n\nrig {shlex.join(trial.arguments)}\n{smallest.world}\n"
            + f"{smallest.plan}\n{ran.stderr}"
        )


@pytest.mark.thorough
def test_a_stage_that_runs_away_from_a_suspended_computer_is_stopped_when_it_wakes(
    tmp_path: Path,
) -> None:
    """Two faults at one time, which nothing in the program can bound while it does not run; met by
    an earlier soak of rolls, seed 9143. The first orders after waking are to stop."""
    moment = {"move": 1, "of": "rotary", "after_s": 0.26}
    faults = (
        {"device": "rotary", "kind": "runaway", "move": 1, "after_s": 0.25},
        {"device": "clock", "kind": "clock-jump", **moment, "by_s": 7.35},
    )
    options = ("--angle", "1.78deg", "--start", "-2.35mm", "--normal-force", "2.4N")
    arguments = ("roll-trial", *options, "--seed", "143")
    trial = Trial(9143, arguments, world_of("roll-trial", faults), faults)
    ran = run(server(), trial, tmp_path / "trial")
    assert ran.code in (3, 7), ran.stderr
    assert breaches(ran) == []
    woke_us = next(x["t_us"] for x in ran.log if x["what"] == "fault")
    stopped_us = [x["t_us"] for x in ran.log if (x["device"], x["what"]) == ("rotary", "stop")]
    assert any(woke_us <= t_us <= woke_us + 100_000 for t_us in stopped_us)
    z_mm = [x["value"]["target_mm"] for x in ran.log if x["what"] == "move" and x["t_us"] > woke_us]
    assert all(mm <= 5.0 for mm in z_mm)


def misread(tmp_path: Path, fault: Fault) -> Ran:
    """A sweep of two points in which one answer is misread; no file has a row that was not sent."""
    fault |= {"kind": "flip"}
    options = ("--frequencies", "110,410", "--load", "1N", "--preload", "12N", "--seed", "1")
    world = DECLARED_CONTACT + world_of("sweep", [fault])
    trial = Trial(1, ("sweep", *options), world, (fault,))
    ran = run(server(), trial, tmp_path / "trial")
    assert len(ran.faults_met) == 1
    assert breaches(ran) == []
    return ran


@pytest.mark.parametrize(
    ("acquisition", "frequency"),
    [
        pytest.param(6, 110, marks=pytest.mark.thorough),
        pytest.param(10, 410, marks=pytest.mark.nightly),
    ],
)
def test_a_record_with_a_flipped_bit_is_taken_again_and_not_kept(
    acquisition: int, frequency: int, tmp_path: Path
) -> None:
    """The bit is the second highest of one of a thousand samples, a quarter of the range."""
    payload = {"command": "WAV:DATA", "acquisition": acquisition, "byte": -3, "bit": 6}
    ran = misread(tmp_path, {"device": "daq", **payload})
    assert ran.code == 0
    assert f"1 record at {frequency} Hz repeated" in ran.stderr


@pytest.mark.parametrize("byte", mostly_nightly([1, 4], [4]))
def test_a_generator_that_reads_back_another_frequency_records_nothing(
    byte: int, tmp_path: Path
) -> None:
    read_back = {"command": "SOUR1:FREQ?", "at": 2, "byte": byte}
    ran = misread(tmp_path, {"device": "generator", **read_back})
    assert ran.code == 3
    assert "generator: SOUR1:FREQ: set to 110 but reads back" in ran.errors[0]
    assert "Failed: 0 of 2 points" in ran.stderr


@pytest.mark.thorough
def test_a_seed_is_replayed_exactly(tmp_path: Path) -> None:
    """The World's own account of two runs is the same, line by line."""
    trial = draw(SEED_BY_DEFAULT)
    first, again = (run(server(), trial, tmp_path / name) for name in ("first", "again"))
    assert first.faults_met
    assert (first.code, first.log) == (again.code, again.log)


@pytest.mark.thorough
def test_a_batch_whose_bench_is_not_safe_says_so_at_once_and_begins_nothing_more(
    tmp_path: Path,
) -> None:
    """No connection to z works any more while the film is pressed in its first run."""
    lost = {"device": "stage_z", "kind": "silence", "count": 0, "acquisition": 3, "after_s": 0.05}
    arguments = ("batch", "run", "attacked.toml", "--json")
    trial = BatchTrial(1, arguments, "", (lost,), procedures=("sweep", "sweep"))
    ran = run_batch(server(), trial, tmp_path / "batch", PATIENCE_S)
    assert batch_breaches(ran) == []
    assert ran.code == 7
    assert max(ran.values("last-force")) > 1.0
    assert said_unheard_s(ran) is not None
    assert [attempt.number for attempt in ran.attempts] == [1]


def test_a_plan_is_shrunk_to_what_it_takes_to_fail() -> None:
    faults = tuple({"device": "daq", "kind": "silence", "at": at} for at in range(1, 7))
    trial = replace(draw(0), faults=faults)
    kept = shrunk(trial, lambda smaller: {2, 5} <= {fault["at"] for fault in smaller.faults})
    assert [fault["at"] for fault in kept.faults] == [2, 5]
