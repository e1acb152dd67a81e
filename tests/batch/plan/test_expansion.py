"""What a batch file expands to: combinations, ids, order, references."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
import pytest

from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.expand import expand
from rig.batch.plan.findings import RefusedBatchError
from rig.batch.plan.settings import BatchFile
from rig.core.errors import ExitCode

SPEEDS = [0.2, 0.5, 1.0]
FORCES = [2.0, 4.0]


def planned(*experiments: dict[str, Any], **tables: Any) -> BatchPlan:
    """The plan of experiments, of slip trials where they name no procedure."""
    whole = [{"procedure": "slip-trial", **experiment} for experiment in experiments]
    batch = {"name": "night", **tables.pop("batch", {})}
    return expand(BatchFile.model_validate({"batch": batch, "experiment": whole, **tables}))


def varied(plan: BatchPlan) -> list[dict[str, Any]]:
    return [dict(condition.varied) for condition in plan.conditions.values()]


def reported(*experiments: dict[str, Any], **tables: Any) -> list[str]:
    """What is wrong with them."""
    with pytest.raises(RefusedBatchError) as caught:
        planned(*experiments, **tables)
    assert caught.value.code is ExitCode.USAGE
    return [part.one_line() for part in caught.value.parts()]


# --- combinations -----------------------------------------------------------------------------


def test_a_matrix_is_every_combination_in_the_order_it_is_written() -> None:
    plan = planned({"matrix": {"normal_force_N": FORCES, "speed_mm_s": SPEEDS}})
    assert varied(plan) == [
        {"normal_force_N": force, "speed_mm_s": speed} for force in FORCES for speed in SPEEDS
    ]
    assert list(plan.conditions) == [f"slip-trial-{k:03d}" for k in range(1, 7)]
    assert [run.number for run in plan.runs] == list(range(1, 7))
    assert [run.condition for run in plan.runs] == list(plan.conditions)


def test_a_condition_has_all_settings_of_its_procedure_defaults_under_own_under_varied() -> None:
    plan = planned(
        {"settings": {"distance_mm": 0.7, "rest_s": 1}, "matrix": {"rest_s": [2]}},
        defaults={"slip-trial": {"distance_mm": 0.5, "rest_s": 0, "object": "glass"}},
    )
    (condition,) = plan.conditions.values()
    settings = condition.settings
    assert (settings["distance_mm"], settings["rest_s"], settings["object"]) == (0.7, 2.0, "glass")
    assert settings["normal_force_N"] == 4.0, "the procedure's own"
    assert type(settings["rest_s"]) is float


def test_values_are_in_the_settings_units_whatever_they_were_written_in() -> None:
    plan = planned({"matrix": {"normal_force_N": ["400 cN"], "speed_mm_s": ["200 um/s", "1"]}})
    assert varied(plan) == [
        {"normal_force_N": pytest.approx(4.0), "speed_mm_s": pytest.approx(speed)}
        for speed in (0.2, 1.0)
    ]
    (sweep,) = planned(
        {"procedure": "sweep", "settings": {"frequencies_Hz": ["200", "1 kHz"], "loads_N": "1,2"}}
    ).conditions.values()
    assert sweep.settings["frequencies_Hz"] == [200.0, 1000.0]
    assert sweep.settings["loads_N"] == [1.0, 2.0]


def test_what_is_excluded_is_left_out_and_the_others_keep_their_ids() -> None:
    matrix = {"normal_force_N": FORCES, "speed_mm_s": SPEEDS}
    plan = planned(
        {
            "matrix": matrix,
            "exclude": [{"normal_force_N": "2 N", "speed_mm_s": 0.5}, {"speed_mm_s": 1}],
        }
    )
    assert list(plan.conditions) == ["slip-trial-001", "slip-trial-004", "slip-trial-005"]
    assert [v["speed_mm_s"] for v in varied(plan)] == [0.2, 0.2, 0.5]


def test_what_include_makes_follows_the_whole_matrix_whatever_is_excluded() -> None:
    further = {"matrix": {"speed_mm_s": SPEEDS}, "include": [{"speed_mm_s": 2.0}]}
    for excluded, ids in (([], (1, 2, 3, 4)), ([{"speed_mm_s": s} for s in SPEEDS], (4,))):
        plan = planned({**further, "exclude": excluded})
        assert list(plan.conditions) == [f"slip-trial-{number:03d}" for number in ids]


def test_include_is_that_of_github_actions() -> None:
    """The example of its documentation: forces stand for fruit (apple, pear, banana), rests for
    animals (cat, dog), objects for colours and the direction for the shape."""
    plan = planned(
        {
            "matrix": {"normal_force_N": [1, 2], "rest_s": [0.1, 0.2]},
            "include": [
                {"object": "green"},
                {"object": "pink", "rest_s": 0.1},
                {"normal_force_N": 1, "direction": "-x"},
                {"normal_force_N": 3},
                {"normal_force_N": 3, "rest_s": 0.1},
            ],
        }
    )
    assert varied(plan) == [
        {"normal_force_N": 1, "rest_s": 0.1, "object": "pink", "direction": "-x"},
        {"normal_force_N": 1, "rest_s": 0.2, "object": "green", "direction": "-x"},
        {"normal_force_N": 2, "rest_s": 0.1, "object": "pink"},
        {"normal_force_N": 2, "rest_s": 0.2, "object": "green"},
        {"normal_force_N": 3},
        {"normal_force_N": 3, "rest_s": 0.1},
    ]


def test_include_alone_lists_the_conditions() -> None:
    plan = planned({"include": [{"speed_mm_s": 0.2, "rest_s": 1}, {"speed_mm_s": 0.5}]})
    assert varied(plan) == [{"speed_mm_s": 0.2, "rest_s": 1.0}, {"speed_mm_s": 0.5}]


@pytest.mark.parametrize("points", [1, 7, 64])
@pytest.mark.parametrize("method", ["latin-hypercube", "sobol"])
def test_a_sample_fills_its_ranges_evenly(method: str, points: int) -> None:
    ranges = {"speed_mm_s": (0.1, 10.0), "rest_s": (0.0, 2.0)}
    sample = {"method": method, "points": points, "ranges": ranges, "log": ["speed_mm_s"]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = planned({"sample": sample})
    speeds = np.array([v["speed_mm_s"] for v in varied(plan)])
    rests = np.array([v["rest_s"] for v in varied(plan)])
    shares = np.log(speeds / 0.1) / np.log(100), rests / 2
    for share in shares:
        assert share.size == points
        assert np.all((share >= 0) & (share <= 1))
        if method == "latin-hypercube" or points == 64:
            # one point in each of as many equal strata
            assert sorted(np.floor(share * points).astype(int)) == list(range(points))
    assert varied(planned({"sample": sample})) == varied(plan)
    other = varied(planned({"sample": sample}, batch={"seed": 1}))
    assert other != varied(plan)


def test_the_bounds_of_a_sample_may_carry_units() -> None:
    plain, written = (
        varied(planned({"sample": {"points": 4, "ranges": {"speed_mm_s": bounds}}}))
        for bounds in ((0.1, 2), ("100 um/s", "2"))
    )
    assert plain == written


def test_a_sample_is_crossed_with_the_matrix_and_whole_where_the_setting_is() -> None:
    sample = {"points": 4, "ranges": {"trials": (1, 100)}}
    plan = planned({"matrix": {"speed_mm_s": SPEEDS}, "sample": sample})
    found = varied(plan)
    assert [v["speed_mm_s"] for v in found] == [s for s in SPEEDS for _ in range(4)]
    assert found[:4] == [{**v, "speed_mm_s": 0.2} for v in found[4:8]]
    assert all(type(v["trials"]) is int for v in found)


def test_two_experiments_of_one_name_have_ids_of_their_own() -> None:
    plan = planned({}, {}, {"name": "slip-trial-2"}, {"name": "grip"})
    assert list(plan.conditions) == [
        "slip-trial-001",
        "slip-trial-2-001",
        "slip-trial-2-2-001",
        "grip-001",
    ]


# --- order ------------------------------------------------------------------------------------


def test_as_written_the_whole_matrix_is_repeated() -> None:
    plan = planned({"matrix": {"speed_mm_s": SPEEDS}, "repeat": 2})
    assert [run.repeat for run in plan.runs] == [1, 1, 1, 2, 2, 2]
    assert [run.condition for run in plan.runs] == 2 * list(plan.conditions)


def test_shuffled_is_the_same_runs_in_an_order_of_the_seeds() -> None:
    experiment = {"matrix": {"speed_mm_s": [k / 10 for k in range(1, 21)]}, "repeat": 2}
    orders = [
        [
            (run.condition, run.repeat)
            for run in planned(experiment, batch={"order": "shuffled", "seed": seed}).runs
        ]
        for seed in (1, 1, 2)
    ]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2])
    assert orders[0] != sorted(orders[0])
    assert len(set(orders[0])) == 40


def test_blocked_keeps_equal_values_together_and_shuffles_blocks_and_runs() -> None:
    matrix = {"normal_force_N": [1, 2, 3, 4, 5], "speed_mm_s": [0.1, 0.2, 0.3, 0.4]}
    orders = set()
    for seed in range(6):
        plan = planned(
            {"matrix": matrix, "repeat": 2, "block_by": ["normal_force_N"]},
            batch={"order": "blocked", "seed": seed},
        )
        forces = [plan.conditions[run.condition].varied["normal_force_N"] for run in plan.runs]
        blocks = [force for force, _ in itertools.groupby(forces)]
        assert sorted(blocks) == [1, 2, 3, 4, 5], "each in one piece"
        assert [forces.count(force) for force in blocks] == [8] * 5
        orders.add((*blocks, *(run.condition for run in plan.runs[:8])))
    assert len(orders) == 6


def test_without_block_by_each_repeat_is_a_block() -> None:
    plan = planned(
        {"matrix": {"speed_mm_s": [k / 10 for k in range(1, 11)]}, "repeat": 3},
        batch={"order": "blocked"},
    )
    repeats = [run.repeat for run in plan.runs]
    assert sorted(key for key, _ in itertools.groupby(repeats)) == [1, 2, 3]
    for start in (0, 10, 20):
        assert {run.condition for run in plan.runs[start : start + 10]} == set(plan.conditions)


@pytest.mark.parametrize(
    ("others", "every", "expected"),
    [
        (6, 3, "R...R...R"),
        (7, 3, "R...R...R.R"),
        (2, 5, "R..R"),
        (1, 1, "R.R"),
    ],
)
def test_a_reference_is_run_first_after_every_so_many_others_and_last(
    others: int, every: int, expected: str
) -> None:
    plan = planned(
        {"name": "reference", "every": every}, {"repeat": others}, batch={"order": "shuffled"}
    )
    references = [plan.conditions[run.condition].reference for run in plan.runs]
    assert "".join("R" if reference else "." for reference in references) == expected
    repeats = [run.repeat for run in plan.runs if run.condition == "reference-001"]
    assert repeats == list(range(1, expected.count("R") + 1))
    assert [run.number for run in plan.runs] == list(range(1, len(expected) + 1))


# --- what is refused --------------------------------------------------------------------------


def test_all_that_is_wrong_is_reported_at_once_with_its_experiment() -> None:
    lines = reported(
        {"matrix": {"speed_mm_s": [-1, "3 kg", 0.5]}, "settings": {"rest": 1}},
        {"procedure": "slide"},
        {"procedure": "sweep", "settings": {"lowest_Hz": 30e3}},
        defaults={"roll": {}, "sweep": {"load_N": "heavy"}},
    )
    expected = [
        "experiment 1: matrix.speed_mm_s = -1 mm/s: must be above 0 mm/s",
        "experiment 1: matrix.speed_mm_s = '3 kg': 'kg' does not convert to mm/s",
        "experiment 1: settings.rest: the procedure has no such setting; did you mean rest_s?",
        "experiment 2: procedure = 'slide' is unknown; known are path-trial, roll-trial, ",
        "defaults: procedure = 'roll' is unknown",
        "defaults.sweep.load_N = 'heavy': is not a number in N",
        "experiment 3: sweep-001: lowest_Hz 30000 Hz is not below highest_Hz 20000 Hz",
    ]
    for words in expected:
        assert sum(line.startswith(words) for line in lines) == 1, (words, lines)
    assert len(lines) == len(expected)


SAMPLE = {"points": 3, "ranges": {"speed_mm_s": (0.1, 1.0)}}


@pytest.mark.parametrize(
    ("experiment", "words"),
    [
        ({"matrix": {"speed_mm_s": []}}, "matrix.speed_mm_s: has no value"),
        ({"matrix": {"speed_mm_s": [0.5, "0.5"]}}, "appears twice in the list"),
        ({"matrix": {"speed_mm_s": SPEEDS}, "sample": SAMPLE}, "the matrix varies it, too"),
        ({"sample": {"points": 3, "ranges": {"loading": (1, 2)}}}, "loading: is not a number"),
        ({"sample": {"points": 3, "ranges": {"pace": (1, 2)}}}, "no such setting"),
        ({"sample": {"points": 3, "ranges": {"start_mm": (-1e308, 1e308)}}}, "is too wide"),
        ({"exclude": [{"rest_s": 1}]}, "exclude.rest_s: the matrix does not vary it"),
        (
            {"matrix": {"speed_mm_s": SPEEDS}, "exclude": [{"speed_mm_s": s} for s in SPEEDS]},
            "no combination is left",
        ),
        ({"block_by": ["rest_s"]}, "block_by has no meaning with order = 'as-written'"),
        ({"every": 3}, "a reference runs between others, and there are none"),
        ({"include": [{"speed_mm_s": 0}]}, "include.speed_mm_s = 0 mm/s: must be above 0 mm/s"),
        ({"sample": SAMPLE | {"ranges": {"speed_mm_s": (-1, 1)}}}, "sample.speed_mm_s = -"),
    ],
)
def test_what_means_nothing_is_refused(experiment: dict[str, Any], words: str) -> None:
    lines = reported(experiment)
    assert any(words in line for line in lines), lines


def test_blocks_by_what_is_not_varied_are_refused() -> None:
    (line,) = reported({"block_by": ["rest_s"]}, batch={"order": "blocked"})
    assert "block_by: rest_s is not varied" in line


def test_a_queue_beyond_sense_is_refused_before_it_is_made() -> None:
    values = [k / 1000 for k in range(1, 1001)]
    matrix = {"speed_mm_s": values, "rest_s": values, "distance_mm": values}
    (line,) = [line for line in reported({"matrix": matrix}) if "conditions" in line]
    assert "1000000000 conditions are more than 100000" in line
    (line,) = reported({"repeat": 100_000, "matrix": {"trials": list(range(1, 12))}})
    assert "1100000 runs are more than 1000000" in line
    (line,) = reported(
        {
            "matrix": {"speed_mm_s": values, "trials": list(range(1, 101))},
            "exclude": [{"trials": k} for k in range(1, 31)],
        }
    )
    assert "100000 combinations are too many for so many entries" in line
