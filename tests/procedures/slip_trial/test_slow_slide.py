"""A slide that took longer than its speed allows has a warning."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.slip_trial.reading import SlipTrialRecord, warn_of_slow_slide
from procedures.slip_trial.settings import SlipTrialSettings


def warnings_of(took_s: float, **settings: Any) -> list[str]:
    """Warnings of a trial of 1 mm at 0.5 mm/s whose motion took so long."""
    said: list[str] = []
    run: Any = SimpleNamespace(
        settings=SlipTrialSettings(**settings),
        event=lambda kind, topic, text: said.append(f"{kind} {topic}: {text}"),
    )
    record = SlipTrialRecord(1, 100.0, 1000.0, 4.0)
    record.motion_from_s, record.motion_to_s = 2.0, 2.0 + took_s
    warn_of_slow_slide(run, record)
    return said


@pytest.mark.parametrize("took_s", [2.04, 2.2])
def test_a_slide_that_took_about_as_long_as_it_takes_has_none(took_s: float) -> None:
    assert warnings_of(took_s) == []


def test_a_slide_of_a_slow_stage_has_a_warning_with_both_times() -> None:
    (said,) = warnings_of(2.9)
    took = "warning slow-slide: trial-001: the slide took 2.90 s instead of 2.04 s"
    assert said.startswith(f"{took}: x was slower than 0.5 mm/s.")


def test_a_ramp_has_no_time_of_its_own() -> None:
    assert warnings_of(9.0, loading="ramp") == []
