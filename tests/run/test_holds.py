"""Holds come from any thread at any time; none is missed, and none is dealt with twice."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from rig.run.arming import Arming
from rig.run.holds import HoldError, Holds

SILENT, PAUSED = "the force sensor is silent", "paused by the operator"


def elsewhere(*acts: Callable[[], None]) -> None:
    """Let another thread do this while this one is blocked."""
    other = threading.Thread(target=lambda: [act() for act in acts])
    other.start()
    other.join()


def test_a_hold_that_came_and_went_meanwhile_is_seen_once() -> None:
    holds = Holds()
    elsewhere(lambda: holds.begin(SILENT), lambda: holds.end(SILENT))
    assert holds.active == ()
    with pytest.raises(HoldError, match=SILENT):
        holds.check()
    holds.acknowledge()
    holds.check()
    assert holds.count == 1


def test_two_that_came_and_went_are_two_although_they_have_one_reason() -> None:
    holds = Holds()
    elsewhere(*2 * (lambda: holds.begin(SILENT), lambda: holds.end(SILENT)))
    assert holds.count == 2


def test_a_hold_that_lasts_is_one_however_often_it_is_reported() -> None:
    holds = Holds()
    elsewhere(*3 * (lambda: holds.begin(SILENT),))
    assert holds.count == 1


def test_a_hold_in_force_is_not_passed_over_because_it_began_before_the_acknowledgement() -> None:
    """One that begins between the last look at those in force and the acknowledgement."""
    holds = Holds()
    elsewhere(lambda: holds.begin(PAUSED))
    holds.acknowledge()
    with pytest.raises(HoldError, match=PAUSED):
        holds.check()
    holds.end(PAUSED)
    holds.check()


def test_what_only_watches_stays_on_while_on_hold() -> None:
    arming, off = Arming(), []
    arming.register("force stream", lambda: off.append("force stream"), watches=True)
    arming.register("vibrator", lambda: off.append("vibrator"))
    assert arming.make_safe(watch_on=True) == []
    assert off == ["vibrator"]
    assert arming.names == ("force stream",)
    assert arming.make_safe() == []
    assert off == ["vibrator", "force stream"]
