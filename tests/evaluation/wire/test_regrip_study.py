"""The study of drops: pairs at the same seeds, its table, and what is made again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from rig.cli.commands.regrip_study import lines_of
from rig.cli.commands.regrip_study import regrip_study as command
from rig.detector.registered import ChosenDetector, chosen_detector
from rig.evaluation.wire import regrip_study
from rig.evaluation.wire.kinds import WireTrial
from rig.evaluation.wire.regrip_study import RegripStudy, Weight, as_object, table, weight_of


class Stored:
    """A cache in memory."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}

    def get(self, key: str) -> bytes | None:
        return self.kept.get(key)

    def put(self, key: str, content: bytes) -> None:
        self.kept[key] = content


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[WireTrial]:
    """Trials that were made, by a bench that holds 3 N and whose grip saves every weight."""
    trials: list[WireTrial] = []

    def make(trial: WireTrial, bench: Any, read: Callable[[Path], Any]) -> tuple[Any, str, bool]:
        trials.append(trial)
        if read is regrip_study.read_holding:
            return 3.0, "", False
        drops, grips = trial.settings["hold_at_N"] > 3.0, "regrip" in trial.settings
        outcome = "held" if not drops else "averted" if grips else "lost"
        return (
            {
                "outcome": outcome,
                "squeezes": int(grips and drops),
                "force_used_N": 1.2 * trial.settings["normal_force_N"],
                "risen_s": 0.005 if grips and drops else None,
            },
            "",
            False,
        )

    monkeypatch.setattr(regrip_study, "make_one", make)
    return trials


def weights(cache: Stored, strategies: tuple[str, ...] = ("none", "paper-hp")) -> list[Weight]:
    study = RegripStudy(cache, lambda number, total, made: None)
    return list(study.weights(range(1_000_000, 1_000_003), [0.8, 1.1], strategies))


def test_strategies_meet_the_same_bench_and_the_same_weight(made: list[WireTrial]) -> None:
    weights(Stored(), ("none", "always", "paper-hp"))
    assert len(made) == 3 * (1 + 2 * 3)
    for first in range(0, len(made), 7):
        ramp, *hung = made[first : first + 7]
        assert "hold_at_N" not in ramp.settings
        assert {json.dumps(trial.world) for trial in (ramp, *hung)} == {json.dumps(ramp.world)}
        loads = [trial.settings["hold_at_N"] for trial in hung]
        assert loads == pytest.approx([2.4] * 3 + [3.3] * 3)
        none, always, alarmed = (trial.settings for trial in hung[:3])
        assert "regrip" not in none
        assert (always["regrip_on"], always["regrip_times"]) == ("motion", 2)
        assert (alarmed["detector"], alarmed["regrip_times"]) == ("paper-hp", 5)


def test_what_was_made_is_not_made_again(made: list[WireTrial]) -> None:
    cache = Stored()
    first = weights(cache)
    number = len(made)
    assert weights(cache) == first
    assert len(made) == number


def test_with_other_parameters_of_the_detector_its_trials_are_made_again(
    made: list[WireTrial], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = Stored()
    weights(cache)
    known = len(made)
    chosen = chosen_detector("paper-hp")
    other = replace(chosen, settings=chosen.settings.model_copy(update={"fire_mV": 11.0}))
    monkeypatch.setattr(regrip_study, "chosen_detector", lambda name: other)
    weights(cache)
    assert [trial.settings["detector"] for trial in made[known:]] == ["paper-hp"] * 6


def test_the_table_has_shares_with_intervals_and_counts_false_squeezes(
    made: list[WireTrial],
) -> None:
    found = weights(Stored())
    rows = {(row.weights, row.strategy): row for row in table(found)}
    assert set(rows) == {
        (share, strategy)
        for share in ("0.8", "1.1", "drops", "holds")
        for strategy in ("none", "paper-hp")
    }
    assert rows["1.1", "none"].saved.value == 0.0
    saved = rows["drops", "paper-hp"].saved
    assert (saved.value, saved.of) == (1.0, 3)
    assert saved.low == pytest.approx(0.44, abs=0.01), "Wilson's, of 3 of 3"
    assert rows["holds", "paper-hp"].squeezes == 0
    assert rows["drops", "paper-hp"].force_over_least == pytest.approx(1.2 / 1.1)
    assert rows["drops", "paper-hp"].risen_ms == pytest.approx(5.0)
    said = "\n".join(lines_of(table(found)))
    assert "SIMULATED" in said
    assert "1.00 (0.44-1.00)" in said
    assert json.dumps(as_object(found), allow_nan=False)


@pytest.mark.parametrize(("lost", "low"), [(0, 0.757), (1, 0.646)])
def test_the_weights_of_a_bench_count_as_one_case_of_an_interval(lost: int, low: float) -> None:
    """36 of 36 on twelve benches were said to be 90 to 100 %."""
    weights = [
        Weight(seed, share, "rig", 1.0, 1.0, outcome="lost" if seed < lost else "averted")
        for seed in range(12)
        for share in (1.05, 1.1, 1.3)
    ]
    rows = {row.weights: row for row in table(weights)}
    assert (rows["drops"].n, rows["drops"].saved.of) == (36, 12)
    assert rows["drops"].saved.value == pytest.approx(1 - lost / 12)
    for row in rows.values():
        assert row.saved.low == pytest.approx(low, abs=0.001)
        assert row.squeezed.high == pytest.approx(0.243, abs=0.001)


def test_a_bench_that_cannot_be_made_is_said_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        regrip_study, "make_one", lambda trial, bench, read: (None, "exit code 3: stuck", True)
    )
    found = weights(Stored())
    assert {one.failed for one in found} == {"exit code 3: stuck"}
    assert {(row.n, row.failed) for row in table(found)} == {(0, 3)}


def test_the_table_says_how_many_trials_it_leaves_out() -> None:
    made = Weight(1_000_000, 1.1, "rig", 2.0, 3.3, outcome="averted", squeezes=1, force_used_N=4.0)
    left_out = Weight(1_000_001, 1.1, "rig", 2.0, 3.3, failed="the trial is invalid: late ticks")
    first, head, *rows = lines_of(table([made, left_out, left_out]))
    assert "Left out: trials that could not be made or were invalid" in first
    ends = head.index("left out") + len("left out")
    assert [line[:ends].split()[-2:] for line in rows] == [["1", "2"]] * 2


@pytest.mark.parametrize(
    ("seeds", "tuning", "words"),
    [
        ("101:102", False, "seeds 101:102 are reserved for tuning"),
        ("999999:1000001", False, "lie on both sides of 1000000"),
        ("1000000:1000001", True, "are reserved for reporting"),
    ],
)
def test_seeds_of_the_other_purpose_are_refused(
    made: list[WireTrial], seeds: str, tuning: bool, words: str
) -> None:
    done = study("--seeds", seeds, *(["--tuning"] if tuning else []))
    assert done.exit_code == 2, done.output
    assert words in done.stderr
    assert not made


def test_seeds_that_a_detector_was_tuned_on_are_refused(
    made: list[WireTrial], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ChosenDetector, "seeds_seen", lambda self: [(1_000_000, 1_000_004)])
    done = study("--seeds", "1000003:1000005")
    assert done.exit_code == 2, done.output
    assert "rig was tuned on seeds 1000000:1000005" in done.stderr
    assert not made


def test_a_study_in_which_nothing_could_be_made_is_not_a_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It printed a table of dashes and ended with the exit code 0."""
    monkeypatch.setenv("RIG_CACHE", str(tmp_path))
    monkeypatch.setattr(regrip_study, "make_one", lambda *_: (None, "exit code 3: stuck", False))
    done = study("--seeds", "1900000:1900001", "--shares", "1.1", "--strategies", "none,always")
    assert done.exit_code == 5, done.output
    assert "seed 1900000, 1.1, none: exit code 3: stuck" in done.stderr
    assert "none of the 2 weights could be tried, so the table would be empty" in done.stderr
    assert not done.stdout


def test_weights_slip_at_the_speed_that_is_asked_for(
    made: list[WireTrial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_CACHE", str(tmp_path))
    done = study("--seeds", "1900000:1900001", "--shares", "1.1", "--speed", "0.0005m/s", "--json")
    assert done.exit_code == 0, done.output
    assert {trial.settings["speed_mm_s"] for trial in made} == {0.5}
    assert json.loads(done.stdout)["speed_mm_s"] == 0.5


@pytest.mark.parametrize(
    "given", [("--shares", "1.1,0.8,1.10"), ("--strategies", "none,paper-hp,none")]
)
def test_what_is_given_twice_is_refused(made: list[WireTrial], given: tuple[str, str]) -> None:
    """Its weights would be in a row of the table twice."""
    refused = study("--seeds", "1000000:1000001", *given)
    assert refused.exit_code == 2
    assert "is given twice; give each value once" in refused.stderr
    assert not made


@pytest.mark.parametrize("speed", ["0mm/s", "nan", "2 N", "fast", "21"])
def test_a_speed_that_cannot_be_is_refused(made: list[WireTrial], speed: str) -> None:
    done = study("--seeds", "1900000:1900001", "--speed", speed)
    assert done.exit_code == 2, done.output
    assert f"--speed {speed}" in done.stderr
    assert not made


def test_the_table_of_tuning_seeds_is_marked(
    made: list[WireTrial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_CACHE", str(tmp_path))
    done = study("--seeds", "101:102", "--tuning", "--shares", "1.1")
    assert done.exit_code == 0, done.output
    assert "SIMULATED. TUNING seeds. Weights are" in done.stdout
    assert made
    said = json.loads(study("--seeds", "101:102", "--tuning", "--shares", "1.1", "--json").stdout)
    assert (said["seeds"], said["tuning"]) == ("101:102", True)


def study(*arguments: str) -> Result:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command)
    return CliRunner().invoke(app, ["--strategies", "rig", *arguments])


def test_a_trial_whose_detector_was_dropped_is_not_a_hold_without_a_squeeze() -> None:
    reading: dict[str, Any] = {
        "outcome": "held", "squeezes": 0, "force_used_N": 2.1, "squeeze_risen_s": None,
        "invalid": None,
    }  # fmt: skip
    assert weight_of(reading)["outcome"] == "held"
    reading["invalid"] = "detector lab was dropped, so the grip got no alarms"
    with pytest.raises(ValueError, match="invalid: detector lab was dropped"):
        weight_of(reading)
