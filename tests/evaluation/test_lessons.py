"""Lessons: what is heard of a trial, what is held out, and how much each counts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rig.core.errors import ConfigurationError
from rig.detector.kernel import INPUTS
from rig.detector.notices import HeldForce, XMove
from rig.evaluation.lessons import (
    BENCH_WEIGHT,
    FAULTS,
    LESSON_FRONT_END,
    Lesson,
    Teacher,
    bench_lessons,
    front_end_of,
    held_out,
    sides_of,
)
from rig.evaluation.scoring.outcomes import Truth
from rig.evaluation.wire.kinds import WireKind, drawn
from rig.evaluation.wire.making import MadeTrial
from rig.evaluation.wire.record import WireRecord


def made(kind: WireKind, seed: int) -> MadeTrial:
    """A trial of the bench with a press and a burst, as if it had been made."""
    time = np.arange(2200) / 1000
    press = np.where((time > 0.3) & (time < 0.6), -4.5 * np.sin(np.pi * (time - 0.3) / 0.3), 0.0)
    noise = 0.1 * np.random.default_rng(seed).standard_normal((2200, 2))
    volts = 1e-3 * (np.column_stack([press, press]) + noise)
    truth = Truth("slip", 1.2, 1.4, 1.5, 1.6, record_s=2.2)
    return MadeTrial(
        drawn(kind, seed, None), WireRecord(volts, 1000.0, truth, 0.2, 1.2, {}, ((1.5, 2.2),))
    )


def test_a_trial_of_the_bench_is_heard_once_as_it_was_recorded_and_then_otherwise():
    trial = made("slide", 3)
    assert trial.record is not None
    moves = (XMove(1200, 0.5, 1500),)
    trial = replace(trial, record=replace(trial.record, notices=moves))
    first, *others = bench_lessons(trial, 4)
    assert [one.notices for one in (first, *others)] == [moves, (), moves, ()]
    assert (first.volts == trial.record.volts).all()
    assert [one.first for one in (first, *others)] == [True, False, False, False]
    assert [bool((one.volts != first.volts).any()) for one in others] == [False, True, True]
    assert {one.weight for one in (first, *others)} == {BENCH_WEIGHT}
    assert all((one.slips_s == [[1.5, 2.2]]).all() for one in others)
    again = list(bench_lessons(trial, 4))
    assert all((one.volts == two.volts).all() for one, two in zip(again[1:], others, strict=True))


def test_recordings_of_which_nothing_is_known_are_refused_with_what_to_state():
    with pytest.raises(ConfigurationError) as refused:
        sides_of([("", ""), ("", "")])
    line = refused.value.one_line()
    assert "all 2 trials share samples or days (without a name)" in line
    assert "rig import --sample, --start-time" in line


def test_trials_are_on_the_same_side_as_those_that_share_a_sample_or_a_day_by_way_of_others():
    groups = [("a", "mon"), ("b", "tue"), ("a", "tue"), ("c", "wed"), ("b", "thu"), ("d", "mon")]
    assert sides_of(groups) == [False, False, False, True, False, False]


def test_thousands_of_trials_are_divided_without_comparing_each_with_each():
    """With a comparison of each with each, and a list of all for each that agrees, this takes
    twenty minutes."""
    groups = [(f"sample {number % 2000}", f"day {number % 4}") for number in range(6000)]
    sides = dict(zip(groups, sides_of(groups), strict=True))
    assert sum(sides[one] for one in groups) == 1500
    assert {day for (_, day), held in sides.items() if held} == {"day 0"}


def test_a_roll_on_the_bench_ends_when_it_has_turned():
    trial = made("roll a", 4)
    (lesson,) = bench_lessons(trial, 1)
    settings = trial.trial.settings
    turning_s = abs(settings["angle_deg"]) / settings["turn_speed_deg_s"]
    assert lesson.rolls
    assert lesson.motion_end_s == pytest.approx(1.2 + turning_s)
    assert lesson.held_out is held_out(4) is True
    (slide,) = bench_lessons(made("slide", 5), 1)
    assert not slide.rolls
    assert not slide.held_out
    assert math.isnan(slide.motion_end_s)


def test_a_trial_that_could_not_be_made_teaches_nothing():
    trial = MadeTrial(drawn("slide", 3, None), None, "the drive did not answer")
    assert list(bench_lessons(trial, 3)) == []


def test_each_front_end_has_one_fault_at_most():
    plain = LESSON_FRONT_END.model_dump()
    for number, fault in enumerate(FAULTS):
        heard = front_end_of(number, LESSON_FRONT_END).model_dump()
        assert {name for name in plain if heard[name] != plain[name]} == set(fault)
        assert len(fault) <= 1


def test_the_commands_of_x_are_inputs_from_their_row_on_at_any_rate():
    known = INPUTS.index("x known")
    (heard,) = bench_lessons(made("slide", 3), 1)
    assert not Teacher().rows_of(heard).inputs[:, known].any()
    for rate_Hz, row in ((1000.0, 1200), (2000.0, 2400)):
        volts = np.repeat(heard.volts, round(rate_Hz / 1000.0), axis=0)
        given = (HeldForce(row // 2, 4.0), XMove(row, 0.5, 2 * row))
        moved = replace(heard, volts=volts, rate_Hz=rate_Hz, notices=given)
        taught = Teacher().rows_of(moved).inputs[:, known]
        assert 0.2 < taught.astype(bool).mean() < 0.7


@pytest.mark.parametrize("rate_Hz", [1000.0, 2000.0])
def test_a_slip_that_lasts_is_taught_where_the_commands_and_its_end_are_known(rate_Hz: float):
    (heard,) = bench_lessons(made("slide", 3), 1)
    slip_s = float(heard.slips_s[0, 0])
    volts = np.repeat(heard.volts, round(rate_Hz / 1000.0), axis=0)
    held, moved = HeldForce(0, 4.0), XMove(round(slip_s * rate_Hz), 0.5, len(volts))
    lasts = replace(heard, volts=volts, rate_Hz=rate_Hz, slips_s=np.array([[slip_s, slip_s + 0.2]]))

    def cases(**changes: object) -> int:
        return int(Teacher().rows_of(replace(lasts, **changes)).slip.max()) + 1  # type: ignore[arg-type]

    assert cases(notices=(held, moved)) == 3  # the slip, and two pieces of what follows
    assert cases() == cases(notices=(held,)) == cases(notices=(moved,)) == 1
    assert cases(notices=(held, moved), ends_known=False) == 1


def test_the_rows_of_a_lesson_weigh_as_the_lesson_and_teach_its_slip():
    (heard,) = bench_lessons(made("slide", 3), 1)
    plain = Lesson(**{**vars(heard), "weight": 1.0})
    twice, once = (Teacher().rows_of(one) for one in (heard, plain))
    assert (twice.inputs == once.inputs).all()
    assert (twice.weight == BENCH_WEIGHT * once.weight).all()
    assert once.right[:, 0].sum() > 0


def test_a_recording_at_another_rate_teaches_at_the_times_of_its_own():
    (heard,) = bench_lessons(made("slide", 3), 1)
    fast = Lesson(**{**vars(heard), "volts": np.repeat(heard.volts, 4, axis=0), "rate_Hz": 4000.0})
    slow_rows, fast_rows = Teacher().rows_of(heard), Teacher().rows_of(fast)
    assert fast_rows.right[:, 0].sum() == pytest.approx(slow_rows.right[:, 0].sum(), abs=4)
