"""Where the way of a weight begins, by which it is lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from procedures.slip_trial.reading import SlipTrialRecord
from procedures.slip_trial.settings import SlipTrialSettings
from procedures.slip_trial.trial import Loading, SlipTrialRun
from rig.control.force_ramp import ForceRamp
from rig.files.journal.detections import SLIP, Detection

WEIGHT_N = 3.0
STICKS = [(0.1 * n, 0.06 * n, 0.2 * n) for n in range(11)]
"""Time in s, travel in mm and F_t in N of a contact that follows a ramp of 2 N/s for 1 s."""


def way_of(course: Sequence[tuple[float, float, float]], alarm_at_s: float) -> SlipTrialRecord:
    """Return the record of a weight after such a course, with one alarm."""
    record = SlipTrialRecord(1, 100.0, 1000.0, 4.0, motion_to_s=-1.0)  # the motion is under way
    now_s = 0.0

    def asking(ramp: ForceRamp) -> Callable[[Any], Loading]:
        def ask(tick: Any) -> Loading:
            since_s, travel_mm, force_N = tick
            asked_mm_s = ramp.step(since_s, since_s, travel_mm, since_s, force_N)
            return Loading(since_s, travel_mm, force_N, asked_mm_s)

        return ask

    limits = {"speed": SimpleNamespace(nearest=lambda mm_s: mm_s)}
    run: Any = SimpleNamespace(
        settings=SlipTrialSettings(loading="ramp", hold_at_N=WEIGHT_N, distance_mm=5.0),
        record=record,
        x=SimpleNamespace(
            stage=SimpleNamespace(limits=lambda: limits),
            start_move=lambda to_mm, mm_s: None,
            latest=SimpleNamespace(position_mm=0.0),
        ),
        series=SimpleNamespace(rates=SimpleNamespace(tick_s=0.01)),
        delay_s=0.005,
        _asking=asking,
        hold_tick=lambda tick: None,
        since_s=lambda: now_s,
    )
    pull = SlipTrialRun._weight(run, WEIGHT_N)
    for tick in course:
        now_s = tick[0]
        if now_s >= alarm_at_s:
            alarm = Detection(SLIP, round(1e3 * alarm_at_s), alarm_at_s, alarm_at_s, 0.9)
            record.detections = [alarm]
        pull(tick)  # type: ignore[arg-type]
    assert len(record.alarms) == 1
    return record


def test_what_has_slid_before_a_late_alarm_counts() -> None:
    slips = [(1.0 + 0.1 * n, 0.6 + 0.1 * n, 2.0) for n in range(1, 7)]
    record = way_of(STICKS + slips, alarm_at_s=1.4)
    assert record.ramp_to_s == pytest.approx(1.0)
    assert record.slid_mm == pytest.approx(0.6)
    assert record.lost


def test_the_shear_of_a_contact_that_sticks_after_an_early_alarm_does_not_count() -> None:
    record = way_of(STICKS, alarm_at_s=0.0)
    assert record.slid_from_mm == pytest.approx(0.6)
    assert record.slid_mm == 0.0
    assert not record.lost
