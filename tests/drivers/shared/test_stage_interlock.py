"""The interlock of all stage drivers: states, transitions, and calls from several threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from drivers.shared import stage
from drivers.shared.stage import (
    MotionRefusedError,
    MotionWatch,
    StageInterlock,
    StageState,
    prepared,
    stop_and_close,
)
from rig.core.errors import InstrumentError, InstrumentTimeoutError

ARMED, STOPPING, MADE_SAFE = StageState.ARMED, StageState.STOPPING, StageState.MADE_SAFE
LOST = InstrumentError("stage_z", "write", "the connection failed")
SILENT = InstrumentTimeoutError("stage_z", "write", "no answer")
PATIENCE_S = 10.0


def interlock() -> StageInterlock:
    return StageInterlock("stage_z")


def stop(lock: StageInterlock, rearm: bool = True) -> None:
    with lock.stopping(rearm):
        pass


def failed_stop(lock: StageInterlock) -> None:
    with pytest.raises(InstrumentError), lock.stopping(rearm=True):
        raise LOST


def made_safe(lock: StageInterlock) -> None:
    lock.make_safe(lambda: None)


def failed_make_safe(lock: StageInterlock) -> None:
    def fail() -> None:
        raise SILENT

    with pytest.raises(InstrumentTimeoutError):
        lock.make_safe(fail)


def own_stop(lock: StageInterlock) -> None:
    stop(lock, rearm=False)


Act = Callable[[StageInterlock], None]


@pytest.mark.parametrize(
    ("acts", "state"),
    [
        ([], ARMED),
        ([stop], ARMED),
        ([own_stop], ARMED),
        ([failed_stop], ARMED),
        ([made_safe], MADE_SAFE),
        ([failed_make_safe], MADE_SAFE),
        ([made_safe, made_safe], MADE_SAFE),
        ([made_safe, own_stop], MADE_SAFE),
        ([made_safe, failed_stop], MADE_SAFE),
        ([made_safe, failed_stop, own_stop], MADE_SAFE),
        ([made_safe, stop], ARMED),
        ([made_safe, made_safe, stop], ARMED),
        ([failed_make_safe, stop], ARMED),
        ([made_safe, failed_stop, stop], ARMED),
        ([made_safe, stop, stop], ARMED),
        ([made_safe, stop, made_safe], MADE_SAFE),
        ([made_safe, stop, made_safe, own_stop], MADE_SAFE),
        ([made_safe, stop, made_safe, stop], ARMED),
    ],
)
def test_the_state_after_one_call_after_the_other(acts: list[Act], state: StageState) -> None:
    lock = interlock()
    for act in acts:
        act(lock)
    assert lock.state is state
    assert not lock.is_stopping
    if state is ARMED:
        lock.permit(lock.ticket(), "move")
    else:
        with pytest.raises(MotionRefusedError, match="move: the axis was made safe meanwhile"):
            lock.permit(lock.ticket(), "move")


@pytest.mark.parametrize("rearm", [False, True])
def test_while_a_stop_is_under_way_no_motion_is_permitted_by_any_ticket(rearm: bool) -> None:
    lock = interlock()
    before = lock.ticket()
    with lock.stopping(rearm):
        assert lock.state is STOPPING
        for ticket in (before, lock.ticket(), before.after_own_stop()):
            with pytest.raises(MotionRefusedError, match="stopped meanwhile"):
                lock.permit(ticket, "move")
    lock.permit(lock.ticket(), "move")


def test_a_stop_makes_the_tickets_of_before_invalid_for_ever() -> None:
    lock = interlock()
    ticket = lock.ticket()
    lock.permit(ticket, "move")
    failed_stop(lock)
    with pytest.raises(MotionRefusedError, match="stopped meanwhile") as caught:
        lock.permit(ticket, "move")
    assert (caught.value.device, caught.value.hint) == ("stage_z", "begin the motion again")


def test_a_stop_of_a_motions_own_preparation_leaves_its_ticket_but_another_one_does_not() -> None:
    lock = interlock()
    ticket = lock.ticket()
    own_stop(lock)
    ticket = ticket.after_own_stop()
    lock.permit(ticket, "home")
    stop(lock)
    with pytest.raises(MotionRefusedError):
        lock.permit(ticket, "home")


def test_a_stop_by_another_thread_during_the_own_one_is_noticed() -> None:
    lock = interlock()
    ticket = lock.ticket()
    with lock.stopping():
        elsewhere(lambda: stop(lock))
    with pytest.raises(MotionRefusedError):
        lock.permit(ticket.after_own_stop(), "home")


def test_a_ticket_from_before_a_make_safe_and_its_answer_is_not_permitted() -> None:
    """The procedure was behind its watcher, and something else re-armed the stage."""
    lock = interlock()
    ticket = lock.ticket()
    made_safe(lock)
    stop(lock)
    with pytest.raises(MotionRefusedError):
        lock.permit(ticket, "move")


# --- several threads -------------------------------------------------------------------------


def elsewhere(act: Callable[[], object]) -> None:
    """Run `act` in a thread of its own and wait for it."""
    thread = threading.Thread(target=act)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


@contextmanager
def making_safe_elsewhere(lock: StageInterlock) -> Iterator[threading.Event]:
    """A `make_safe` in another thread whose command is on its way until the event is set."""
    commanded, arrived = threading.Event(), threading.Event()

    def command_stop() -> None:
        commanded.set()
        assert arrived.wait(PATIENCE_S)

    thread = threading.Thread(target=lambda: lock.make_safe(command_stop))
    thread.start()
    try:
        assert commanded.wait(PATIENCE_S)
        yield arrived
    finally:
        arrived.set()
        thread.join(PATIENCE_S)


def test_a_stop_that_the_stage_is_made_safe_during_does_not_answer_it() -> None:
    lock = interlock()
    made_safe(lock)
    with lock.stopping(rearm=True) as under_way:
        assert lock.answers_all(under_way)
        elsewhere(lambda: made_safe(lock))
        assert lock.state is MADE_SAFE
        assert not lock.answers_all(under_way), "a stop input that stands must not be lifted"
    assert lock.state is MADE_SAFE
    stop(lock)
    assert lock.state is ARMED


def test_a_drivers_own_stop_lifts_nothing_where_the_stage_is_made_safe() -> None:
    lock = interlock()
    with lock.stopping() as under_way:
        assert lock.answers_all(under_way)
    made_safe(lock)
    with lock.stopping() as under_way:
        assert not lock.answers_all(under_way)


def test_no_motion_is_permitted_from_the_moment_at_which_make_safe_begins() -> None:
    lock = interlock()
    ticket = lock.ticket()
    with making_safe_elsewhere(lock):
        assert lock.state is MADE_SAFE
        with pytest.raises(MotionRefusedError, match="made safe meanwhile"):
            lock.permit(ticket, "move")


def test_a_stop_waits_for_a_make_safe_whose_command_may_still_arrive() -> None:
    """Otherwise that command would end the motion after the stop, such as the one that lifts."""
    lock = interlock()
    order: list[str] = []
    with ExitStack() as stack:
        arrived = stack.enter_context(making_safe_elsewhere(lock))
        begun = threading.Event()

        def act() -> None:
            begun.set()
            with lock.stopping(rearm=True):
                order.append("stop sent")

        stopping = threading.Thread(target=act)
        stopping.start()
        assert begun.wait(PATIENCE_S)
        while not lock.is_stopping:
            pass
        order.append("make_safe's command arrives")
        arrived.set()
        stopping.join(PATIENCE_S)
    assert order == ["make_safe's command arrives", "stop sent"]
    assert lock.state is ARMED


def test_a_stop_that_waits_too_long_for_a_make_safe_is_sent_and_re_arms_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stage, "MAKE_SAFE_PATIENCE_S", 0.01)
    lock = interlock()
    sent = False
    with making_safe_elsewhere(lock), lock.stopping(rearm=True) as under_way:
        sent = True
        assert not lock.answers_all(under_way)
    assert sent
    assert lock.state is MADE_SAFE
    stop(lock)
    assert lock.state is ARMED


def test_of_two_stops_at_once_the_older_one_takes_nothing_back() -> None:
    lock = interlock()
    with lock.stopping(rearm=True):
        elsewhere(lambda: made_safe(lock))
        elsewhere(lambda: stop(lock))
        assert lock.state is STOPPING
    assert lock.state is ARMED


def test_however_threads_interleave_no_motion_is_sent_after_make_safe_has_begun() -> None:
    """Motions check and send under a link's lock, as the drivers do; stops are sent under it."""
    lock, link = interlock(), threading.Lock()
    sent: list[str] = []
    over = threading.Event()

    def procedure() -> None:
        while not over.is_set():
            ticket = lock.ticket()
            with link:
                try:
                    lock.permit(ticket, "move")
                except MotionRefusedError:
                    continue
                sent.append("motion")

    def command_stop() -> None:
        with link:
            sent.append("stop")

    threads = [threading.Thread(target=procedure) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(300):
            lock.make_safe(command_stop)
            after = len(sent)
            with link:
                assert "motion" not in sent[after:]
            with lock.stopping(rearm=True):
                command_stop()
                after = len(sent)
                with link:
                    assert "motion" not in sent[after:]
    finally:
        over.set()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert "motion" in sent


# --- making safe -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("failures", "tries", "error"),
    [
        ([LOST], 2, None),
        ([LOST, LOST], 2, LOST),
        ([SILENT], 1, SILENT),
        ([LOST, SILENT], 2, SILENT),
    ],
)
def test_a_broken_connection_is_tried_once_more_and_a_silent_one_is_not(
    failures: list[InstrumentError], tries: int, error: InstrumentError | None
) -> None:
    lock, left, tried = interlock(), list(failures), []

    def command_stop() -> None:
        tried.append("stop")
        if left:
            raise left.pop(0)

    if error is None:
        lock.make_safe(command_stop)
    else:
        with pytest.raises(InstrumentError) as caught:
            lock.make_safe(command_stop)
        assert caught.value is error
    assert len(tried) == tries
    assert lock.state is MADE_SAFE


# --- a motion and a connection ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("begin", "target", "seen", "passed"),
    [
        (0.0, 10.0, 10.05, False),
        (0.0, 10.0, 10.11, True),
        (0.0, 10.0, -5.0, False),
        (20.0, 10.0, 9.95, False),
        (20.0, 10.0, 9.89, True),
        (10.0, 10.0, 99.0, False),
    ],
)
def test_a_motion_has_passed_its_target_only_beyond_it(
    begin: float, target: float, seen: float, passed: bool
) -> None:
    watch = MotionWatch.towards(target, begin, 1.0, 0.1, 2.0, 5.0)
    assert watch.has_passed(seen) is passed
    assert watch.arrive_by_s == 7.0


class FakeStage:
    """A stage that writes down what is done to it."""

    def __init__(self, failure: BaseException | None = None):
        self.done: list[str] = []
        self._failure = failure

    def _do(self, what: str) -> None:
        self.done.append(what)
        if self._failure is not None:
            raise self._failure

    def prepare(self) -> None:
        self._do("prepare")

    def stop_and_wait(self) -> None:
        self._do("stop")

    def close(self) -> None:
        self.done.append("close")


def test_a_stage_that_cannot_be_prepared_is_closed_and_one_that_can_is_not() -> None:
    good = FakeStage()
    assert prepared(good) is good
    assert good.done == ["prepare"]
    for failure in (LOST, KeyboardInterrupt()):
        bad = FakeStage(failure)
        with pytest.raises(type(failure)):
            prepared(bad)
        assert bad.done == ["prepare", "close"]


def test_a_stage_that_was_only_stopped_is_closed_even_where_the_stop_fails() -> None:
    good, bad = FakeStage(), FakeStage(LOST)
    stop_and_close(good)
    with pytest.raises(InstrumentError):
        stop_and_close(bad)
    assert good.done == bad.done == ["stop", "close"]
