"""Switching off: in reverse order, each for itself, each with a deadline."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator

import pytest

from rig.core.errors import InstrumentError, RigError
from rig.run.arming import Arming, ShutdownFailure

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
    fault, refusal = arming.make_safe()
    assert fault.name == "vibrator"
    place = r"test_arming\.py line \d+: ZeroDivisionError: by zero$"
    assert re.search(place, fault.reason), "who wrote it finds the line"
    assert refusal == ShutdownFailure("stage", "stage: stop: no answer; pull the plug")
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
    assert failure == ShutdownFailure("stage", "not done within 0.05 s")
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


# --- threads that exist before; offs that do not wait for each other -----------------------------


def refuse_threads(patch: pytest.MonkeyPatch) -> None:
    """From now on the computer has no thread to give."""

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    patch.setattr(threading.Thread, "start", refuse)


@pytest.mark.parametrize("overlapping", [False, True])
def test_every_off_runs_although_no_thread_can_be_had_any_more(
    overlapping: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    arming, done = Arming(overlapping), list[str]()
    for name in ("pump", "stage", "vibrator"):
        arming.register(name, noting(done, name), emergency=noting(done, f"{name} at once"))
    with monkeypatch.context() as patch:
        refuse_threads(patch)
        assert arming.emergency_stop() == []
        assert arming.make_safe() == []
    assert sorted(done[:3]) == ["pump at once", "stage at once", "vibrator at once"]
    assert done[3:] == ["vibrator", "stage", "pump"]


def test_nothing_is_armed_for_which_no_thread_can_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    arming, done = Arming(), list[str]()
    arming.register("stage", noting(done, "old"))
    with monkeypatch.context() as patch:
        refuse_threads(patch)
        with pytest.raises(RigError, match="thread 'off' cannot be started"):
            arming.register("vibrator", noting(done, "vibrator"))
        arming.register("stage", noting(done, "new"))  # it has its thread
    assert arming.names == ("stage",)
    assert arming.make_safe() == []
    assert done == ["new"]


def test_an_off_that_is_stuck_is_tried_again_in_a_thread_of_its_own(
    release: threading.Event,
) -> None:
    arming, tries = Arming(), list[int]()

    def stuck_once() -> None:
        tries.append(1)
        if len(tries) == 1:
            release.wait(PATIENCE_S)

    arming.register("stage", stuck_once, deadline_s=0.05)
    assert [failure.name for failure in arming.make_safe()] == ["stage"]
    assert arming.make_safe() == []
    assert len(tries) == 2
    assert not release.is_set()


def test_in_real_time_an_off_that_waits_for_an_answer_holds_up_no_other() -> None:
    """The generator is silent; the film is lifted meanwhile, and the force is read until then."""
    arming, done = Arming(overlapping=True), list[str]()
    lifted = threading.Event()

    def answer_late() -> None:
        assert lifted.wait(PATIENCE_S)
        done.append("generator")

    def lift() -> None:
        done.append("film")
        lifted.set()

    arming.register("force stream", noting(done, "force stream"), watches=True)
    arming.register("film", lift, deadline_s=PATIENCE_S)
    arming.register("generator", answer_late, deadline_s=PATIENCE_S)
    assert arming.make_safe() == []
    assert done == ["film", "generator", "force stream"]


def test_in_real_time_what_stops_at_once_waits_for_no_other_answer() -> None:
    arming, stopped = Arming(overlapping=True), threading.Event()

    def answer_late() -> None:
        assert stopped.wait(PATIENCE_S), "the stage was not stopped meanwhile"

    arming.register("stage", lambda: None, PATIENCE_S, emergency=stopped.set)
    arming.register("generator", lambda: None, PATIENCE_S, emergency=answer_late)
    assert arming.emergency_stop() == []


def test_what_stops_at_once_does_not_wait_for_an_off_that_is_under_way() -> None:
    """A force over the limit while the stage is on its way up."""
    arming, stopped = Arming(overlapping=True), threading.Event()

    def lift() -> None:
        assert arming.emergency_stop() == []
        assert stopped.is_set()

    arming.register("stage", lift, PATIENCE_S, emergency=stopped.set)
    assert arming.make_safe() == []


@pytest.mark.parametrize("overlapping", [False, True])
def test_what_has_to_stop_first_has_a_head_start(
    overlapping: bool, release: threading.Event
) -> None:
    arming, done = Arming(overlapping), list[str]()

    def lift() -> None:
        arming.begin("slide", noting(done, "x stopped"))
        with pytest.raises(InstrumentError, match="no answer"):
            arming.begin("slide", refuse)
        if overlapping:  # where time stops meanwhile, one thread at a time may wait
            arming.begin("slide", lambda: release.wait(PATIENCE_S) and None, head_start_s=0.01)
            assert not release.is_set()
        done.append("lifted")
        release.set()

    def refuse() -> None:
        raise InstrumentError("stage_x", "stop", "no answer", "pull the plug")

    arming.register("slide", noting(done, "slide"))
    arming.register("normal force", lift, deadline_s=PATIENCE_S)
    assert arming.make_safe() == []
    assert done == ["x stopped", "lifted", "slide"]


def test_the_failure_of_what_drives_nothing_says_so() -> None:
    arming = Arming()

    def fail() -> None:
        raise InstrumentError("daq", "STOP", "no answer")

    arming.register("acquisition", fail, drives=False)
    arming.register("force stream", fail, watches=True)
    arming.register("normal force", fail)
    drives = {failure.name: failure.drives for failure in arming.make_safe()}
    assert drives == {"acquisition": False, "force stream": False, "normal force": True}


class Unspeakable(Exception):  # noqa: N818 - not an error of this project
    def __str__(self) -> str:
        raise ValueError("no text")


@pytest.mark.parametrize("error", [SystemExit(0), GeneratorExit(), Unspeakable()], ids=repr)
def test_an_off_that_did_not_return_has_not_worked_whatever_it_raised(
    error: BaseException,
) -> None:
    """As a driver does that calls sys.exit(). Its thread works on for the next try."""
    arming, tries = Arming(), list[int]()

    def off() -> None:
        tries.append(1)
        if len(tries) == 1:
            raise error

    arming.register("generator output", off)
    (failure,) = arming.make_safe()
    assert failure.name == "generator output"
    assert type(error).__name__ in failure.reason
    assert arming.names == ("generator output",)
    assert arming.make_safe() == []
    assert len(tries) == 2
