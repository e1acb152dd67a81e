"""Switching off: in reverse order, each for itself, each with a deadline."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from rig.core.errors import InstrumentError
from rig.run.arming import Arming, OffFailure

PATIENCE_S = 30.0


@pytest.fixture
def release() -> Iterator[threading.Event]:
    """Lets stuck offs go at the end of a test."""
    event = threading.Event()
    yield event
    event.set()


def noting(done: list[str], name: str) -> Callable[[], None]:
    return lambda: done.append(name)


def test_offs_run_in_reverse_order_once() -> None:
    arming, done = Arming(), []
    for name in ("pump", "stage", "vibrator"):
        arming.register(name, noting(done, name))
    assert arming.names == ("pump", "stage", "vibrator")
    assert arming.make_safe() == []
    assert done == ["vibrator", "stage", "pump"]
    assert arming.names == ()
    assert arming.make_safe() == []
    assert len(done) == 3


def test_an_off_that_fails_holds_up_no_other_and_stays_armed() -> None:
    arming, done = Arming(), []

    def refuse() -> None:
        raise InstrumentError("stage", "stop", "no answer", "pull the plug")

    def bug() -> None:
        raise ZeroDivisionError("by zero")

    arming.register("pump", noting(done, "pump"))
    arming.register("stage", refuse)
    arming.register("vibrator", bug)
    arming.register("lamp", noting(done, "lamp"))
    assert arming.make_safe() == [
        OffFailure("vibrator", "ZeroDivisionError: by zero"),
        OffFailure("stage", "stage: stop: no answer; pull the plug"),
    ]
    assert done == ["lamp", "pump"]
    assert arming.names == ("stage", "vibrator")


def test_an_off_that_failed_once_is_tried_again() -> None:
    arming, tries = Arming(), []

    def second_time_lucky() -> None:
        tries.append(1)
        if len(tries) == 1:
            raise OSError("link down")

    arming.register("stage", second_time_lucky)
    assert [failure.name for failure in arming.make_safe()] == ["stage"]
    assert arming.make_safe() == []
    assert arming.names == ()


def test_a_stuck_off_does_not_hold_up_the_others(release: threading.Event) -> None:
    arming, done = Arming(), []
    arming.register("pump", noting(done, "pump"))
    arming.register("stage", lambda: release.wait(PATIENCE_S) and None, deadline_s=0.05)
    (failure,) = arming.make_safe()
    assert failure == OffFailure("stage", "not done within 0.05 s")
    assert done == ["pump"]
    assert not release.is_set()
    assert arming.names == ("stage",)


def test_registering_again_replaces_the_off_and_moves_it_last() -> None:
    arming, done = Arming(), []
    arming.register("stage", noting(done, "stage, old"))
    arming.register("pump", noting(done, "pump"))
    arming.register("stage", noting(done, "stage, new"))
    assert arming.names == ("pump", "stage")
    arming.make_safe()
    assert done == ["stage, new", "pump"]


def test_what_is_armed_while_the_others_are_switched_off_is_not_forgotten() -> None:
    """A watcher may make safe from its thread while the procedure is arming the next thing."""
    arming, done = Arming(), []

    def off_and_arm() -> None:
        done.append("stage")
        arming.register("vibrator", noting(done, "vibrator"))

    arming.register("stage", off_and_arm)
    assert arming.make_safe() == []
    assert arming.names == ("vibrator",)
    arming.make_safe()
    assert done == ["stage", "vibrator"]


def test_a_long_clean_up_keeps_saying_that_it_is_alive():
    """The guard kills a run that is silent for seconds; an unloading stage takes as long."""
    alive = threading.Semaphore(0)
    arming = Arming()

    def unload() -> None:
        for _ in range(5):
            assert alive.acquire(timeout=PATIENCE_S)

    arming.register("stage", unload, deadline_s=6 * PATIENCE_S)
    assert arming.make_safe(beat=alive.release) == []
