"""What is reported where the loop of an approach, which has a rate of its own, is too slow."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from hand_clock import HandClock

from procedures.pressed.ticks import TrialTicks
from rig.control.tick_loop import TooSlowError


@pytest.mark.parametrize(
    ("tick_s", "approach_s", "words"),
    [
        (0.002, 0.01, "or for a --tick below 100 Hz: an approach runs at 100 Hz with every higher"),
        (0.02, 0.02, "or ask for fewer ticks (--tick)"),
        (0.002, None, "or ask for fewer ticks (--tick)"),
    ],
    ids=["an approach slower than the servo", "one as slow as the servo", "the servo"],
)
def test_the_remedy_for_a_slow_loop_changes_its_rate(
    tick_s: float, approach_s: float | None, words: str
) -> None:
    clock = HandClock()
    run: Any = SimpleNamespace(clock=clock, check_stop=lambda: None, check_watchers=lambda: None)
    links: Any = SimpleNamespace(working=nullcontext)
    recorder: Any = SimpleNamespace(
        loop=nullcontext, detected=list, poll_if_due=lambda: None, wait=lambda s: clock.sleep(s)
    )

    def late(tick: object) -> bool:
        clock.spend(0.1)
        return True

    with pytest.raises(TooSlowError) as raised:
        TrialTicks(run, links, recorder, [], tick_s).run(10.0, late, approach_s)
    assert words in str(raised.value.hint)
