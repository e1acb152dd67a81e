"""A position that is answered late: its row says how old it is, and the trial is invalid."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_pressed_reading import reading_of_record
from test_pressed_reading import record as a_record

from procedures.pressed.axes import PolledStage
from procedures.pressed.record.positions import LookWatch, PositionRecorder
from procedures.pressed.record.reading import OLDEST_LOOK
from procedures.pressed.record.trial_record import TrialRecord

TICK_S = 0.01
SPEED_mm_s = 6.0


class Slide:
    """A slide of x, in the middle of which one answer comes `late_s` late; z answers at once."""

    def __init__(self, late_s: float, ticks: int = 100):
        self.now_s = 5.0
        self.streams: dict[str, list[Any]] = {}
        run: Any = SimpleNamespace(
            clock=SimpleNamespace(now=lambda: self.now_s),
            streams=SimpleNamespace(record_rows=self.keep),
        )
        moving: Any = SimpleNamespace(position_mm=lambda: SPEED_mm_s * (self.now_s - 5.0))
        z, x = (PolledStage(run, f"stage_{name}", moving, None) for name in "zx")  # type: ignore[arg-type]
        self.record = TrialRecord(1, 1 / TICK_S, 1000.0, 4.0, begun_s=5.0, motion_from_s=0.0001)
        positions, watch = PositionRecorder(run, self.record, z, x), LookWatch(self.record)
        z.in_motion = x.in_motion = True
        x.poll(), z.poll()
        answers_at = 0
        for number in range(1, ticks):
            self.now_s = 5.0 + number * TICK_S
            watch.note((z, x), self.now_s, TICK_S)
            z.poll()
            if number == ticks // 2:
                answers_at = number + round(late_s / TICK_S)
                asked_s, seen_mm = self.now_s, x.stage.position_mm()
            if number < answers_at:
                pass
            elif number == answers_at:
                self.answer_late(x, asked_s, seen_mm)
            else:
                x.poll()
            positions.add_row()
        positions.record_rows()

    def answer_late(self, x: PolledStage, asked_s: float, seen_mm: float) -> None:
        """x answers now what it was asked then."""
        times = iter((asked_s, self.now_s))
        x.clock, clock = SimpleNamespace(now=lambda: next(times)), x.clock  # type: ignore[assignment]
        stood: Any = SimpleNamespace(position_mm=lambda: seen_mm)
        x.stage, moving = stood, x.stage
        x.poll()
        x.clock, x.stage = clock, moving

    def keep(self, stream: str, first: int, rows: Any, rate: object, units: str) -> None:
        """Keep what a run records."""
        self.streams.setdefault(stream, []).extend(rows)


def invalid_of(slide: Slide) -> str:
    """Why a trial with the looks of this slide is invalid."""
    whole = a_record(0)
    whole.unseen_s, whole.look_every_s = slide.record.unseen_s, slide.record.look_every_s
    return str(reading_of_record(whole)["invalid"])


def test_a_look_that_is_in_time_is_new_in_every_row_and_the_trial_is_valid() -> None:
    slide = Slide(late_s=0.0)
    assert np.max(slide.streams["ages"]) == pytest.approx(0.0)
    assert slide.record.unseen_s["stage_x"] == pytest.approx(TICK_S)
    assert invalid_of(slide) == ""


def test_an_answer_that_is_late_is_recorded_with_its_own_time() -> None:
    """The stage moves steadily: each position is right at the time that the row gives to it."""
    slide = Slide(late_s=0.4)
    elapsed = np.array(slide.streams["ticks"])[:, 0]
    x_mm, x_age_s = np.array(slide.streams["position"])[:, 1], np.array(slide.streams["ages"])[:, 1]
    repeated = np.flatnonzero(np.diff(x_mm) == 0)
    assert len(repeated) == pytest.approx(0.4 / TICK_S, abs=1)
    assert np.all(np.diff(x_age_s)[repeated] == pytest.approx(TICK_S))
    fresh = x_age_s < 1e-9
    assert x_mm[fresh] == pytest.approx(SPEED_mm_s * elapsed[fresh])
    times_s, places_mm = slide.record.looks_at_x()
    assert np.all(np.diff(times_s) > 0)
    assert np.abs(places_mm - SPEED_mm_s * times_s).max() <= SPEED_mm_s * 0.4 / 2 + 1e-9


@pytest.mark.parametrize(("late_s", "counts"), [(0.03, True), (0.4, False)])
def test_a_trial_whose_moving_axis_was_not_seen_for_some_ticks_does_not_count(
    late_s: float, counts: bool
) -> None:
    invalid = invalid_of(Slide(late_s))
    assert (invalid == "") is counts
    if not counts:
        assert "stage_x was not seen for 0.4" in invalid
        assert f"more than 0.05 s ({OLDEST_LOOK} looks)" in invalid
        assert "stage_z" not in invalid


def test_an_axis_at_rest_is_not_looked_at_and_makes_nothing_invalid() -> None:
    record = TrialRecord(1, 100.0, 1000.0, 4.0, motion_from_s=1.0)
    watch = LookWatch(record)
    rests: Any = SimpleNamespace(
        role="stage_x", in_motion=False, looked=SimpleNamespace(asked_s=0.0)
    )
    watch.note((rests,), 100.0, TICK_S)
    assert record.unseen_s == {}
    rests.in_motion = True
    watch.note((rests,), 200.0, TICK_S)
    watch.note((rests,), 200.0 + TICK_S, TICK_S)
    assert record.unseen_s["stage_x"] == pytest.approx(TICK_S), "from when it is in motion"
