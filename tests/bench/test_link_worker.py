"""One thread a link: what a tick asks for, in order; a drive fed as long as the procedure lives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from rig.bench.link_worker import SPARE_S, LinkWorker, LinkWorkers
from rig.core.clock import SIGN_OF_LIFE_S, Clock, WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError

LONGEST_S = 10.0
SILENT = InstrumentError("stage_x", "read register 100", "no answer", "switch it on")


class VirtualClock(WallClock):
    """As that of a simulated bench whose time stops while an instrument answers."""

    is_virtual = True


class Link:
    """Answers when it is let."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.by: list[threading.Thread] = []
        self._begun = threading.Semaphore(0)
        self._let = threading.Semaphore(0)

    def work(self, name: str) -> Callable[[], None]:
        """What is asked of it."""

        def answer() -> None:
            self.by.append(threading.current_thread())
            self._begun.release()
            assert self._let.acquire(timeout=LONGEST_S)
            self.heard.append(name)

        return answer

    def await_question(self) -> None:
        assert self._begun.acquire(timeout=LONGEST_S)

    def let(self, answers: int = 1) -> None:
        self._let.release(answers)


class Drive:
    """Counts how often it is fed; `answer` is what happens then."""

    def __init__(self, answer: Callable[[], None] = lambda: None) -> None:
        self.fed: list[threading.Thread] = []
        self.answer = answer

    def keep_alive(self) -> None:
        self.fed.append(threading.current_thread())
        self.answer()

    def is_fed(self, within_s: float = LONGEST_S) -> bool:
        """Whether it is, from now on."""
        fed, give_up = len(self.fed), time.monotonic() + within_s
        while len(self.fed) == fed and time.monotonic() < give_up:
            time.sleep(0.001)
        return len(self.fed) > fed


@pytest.fixture
def clock() -> WallClock:
    return WallClock()


@pytest.fixture
def links(clock: WallClock) -> Iterator[LinkWorkers]:
    workers = LinkWorkers(clock)
    clock.each_slice(workers.poll)
    yield workers
    workers.close()


@pytest.fixture
def link() -> Iterator[Link]:
    made = Link()
    yield made
    made.let(100)


@pytest.fixture
def worker(clock: WallClock, link: Link) -> Iterator[LinkWorker]:
    made = LinkWorker("stage_z", clock)
    made.start()
    yield made
    link.let(100)
    made.close()


# --- what a tick asks for -------------------------------------------------------------------------


@pytest.mark.parametrize("clock", [WallClock(), VirtualClock()])
def test_outside_a_loop_and_in_virtual_time_it_is_done_where_it_is_asked_for(clock: Clock) -> None:
    link, worker = Link(), LinkWorker("stage_z", clock)
    worker.start()
    link.let(2)
    worker.ask("look", link.work("before"))
    assert link.heard == ["before"]
    if clock.is_virtual:
        with worker:
            worker.ask("look", link.work("in a loop"))
            assert link.heard[1:] == ["in a loop"]
            assert worker.idle
    worker.close()
    assert set(link.by) == {threading.current_thread()}


def test_in_real_time_a_tick_does_not_wait_and_the_end_of_the_loop_does(
    worker: LinkWorker, link: Link
) -> None:
    with worker:
        worker.ask("target", link.work("target"))
        worker.ask("look", link.work("look"))
        link.await_question()
        assert link.heard == []
        assert not worker.idle
        before_s = worker.silent_s
        time.sleep(0.01)
        assert worker.silent_s >= before_s + 0.01
        link.let(2)
        worker.settle()
        assert worker.silent_s == 0
    assert link.heard == ["target", "look"]
    assert threading.current_thread() not in link.by
    assert len(set(link.by)) == 1


def test_the_newest_takes_the_place_of_what_has_not_begun(worker: LinkWorker, link: Link) -> None:
    with worker:
        worker.ask("target", link.work("1"))
        link.await_question()
        for name in ("2", "3", "4"):
            worker.ask("target", link.work(name))
        worker.ask("look", link.work("look"))
        link.let(3)
        worker.settle()
        assert worker.idle
        assert link.heard == ["1", "4", "look"]


def test_what_fails_is_raised_at_the_next_look_and_the_next_loop_begins_anew(
    worker: LinkWorker, link: Link
) -> None:
    def fail() -> None:
        raise InstrumentError("stage_z", "move", "a fault")

    def loop() -> None:
        with worker:
            worker.ask("target", fail)
            give_up = time.monotonic() + LONGEST_S
            while time.monotonic() < give_up:
                worker.check()
                time.sleep(0.001)

    def ask_after_it() -> None:
        with worker:
            worker.ask("target", fail)
            with pytest.raises(InstrumentError, match="a fault"):
                worker.settle()
            worker.ask("look", link.work("look"))

    for doomed in (loop, ask_after_it):
        with pytest.raises(InstrumentError, match="a fault"):
            doomed()
    assert link.heard == []
    link.let()
    with worker:
        worker.ask("look", link.work("retaken"))
    assert link.heard == ["retaken"]


def test_what_ends_the_loop_waits_for_no_link_and_drops_what_has_not_begun(
    worker: LinkWorker, link: Link
) -> None:
    def loop() -> None:
        with worker:
            worker.ask("target", link.work("under way"))
            link.await_question()
            worker.ask("look", link.work("not begun"))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert link.heard == []  # it hangs, and nobody has waited
    link.let(2)
    with worker:  # what is left behind is no part of the next loop, which waits for it
        worker.ask("look", link.work("next"))
    assert link.heard == ["under way", "next"]


def test_what_an_earlier_loop_has_left_behind_fails_no_later_one(
    worker: LinkWorker, link: Link
) -> None:
    late = threading.Event()

    def fail_late() -> None:
        link.work("asked")()
        late.set()
        raise InstrumentError("stage_z", "move", "no answer")

    def loop() -> None:
        with worker:
            worker.ask("target", fail_late)
            link.await_question()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    with worker:
        link.let()
        assert late.wait(LONGEST_S)
        worker.settle()


def test_the_end_of_a_loop_gives_signs_of_life_and_no_longer_than_the_link_may_take(
    clock: WallClock, link: Link
) -> None:
    """A DAQ that hangs is no excuse: the guard ends a run that is silent."""
    lives: list[float] = []
    clock.each_slice(lambda: lives.append(time.monotonic()))
    worker = LinkWorker("daq", clock, patience_s=0.0)
    worker.start()

    def loop() -> None:
        with worker:
            worker.ask("blocks", link.work("blocks"))

    begun_s = time.monotonic()
    with pytest.raises(InstrumentTimeoutError, match=r"daq: finish .*: not done within 1 s"):
        loop()
    assert SPARE_S <= time.monotonic() - begun_s < SPARE_S + LONGEST_S
    assert len(lives) > 10
    link.let()
    worker.close()


def test_a_wait_of_the_link_is_no_sign_of_life_of_the_procedure(
    clock: WallClock, worker: LinkWorker
) -> None:
    """Stop requests are looked at in the procedure's own waits alone."""
    calls = list[threading.Thread]()
    clock.each_slice(lambda: calls.append(threading.current_thread()))
    with worker:
        worker.ask("target", lambda: clock.sleep(0.03))
        worker.ask("look", lambda: clock.charge(0.03))
        worker.settle()
    assert set(calls) <= {threading.current_thread()}


# --- keeping the drives alive ---------------------------------------------------------------------


def test_a_drive_is_fed_by_its_own_thread_whatever_the_procedure_waits_for(
    clock: WallClock, links: LinkWorkers, link: Link
) -> None:
    """A DAQ at work, an x stage that hangs, a slow call of the procedure's on yet another one."""
    hangs = threading.Event()
    x, z = Drive(lambda: hangs.wait(LONGEST_S) and None), Drive()
    links.add("stage_x", x.keep_alive)
    links.add("stage_z", z.keep_alive)
    links.add("daq")
    with clock.answer_within(LONGEST_S), links["daq"] as daq:
        daq.ask("blocks", link.work("blocks"))
        link.await_question()
        time.sleep(2 * SIGN_OF_LIFE_S)
        assert z.is_fed()
        link.let()
    hangs.set()
    assert len(x.fed) == 1, "it hangs in the first"
    assert len(set(z.fed)) == 1
    assert threading.current_thread() not in z.fed


def test_a_procedure_that_hangs_starves_its_drives(clock: WallClock, links: LinkWorkers) -> None:
    z = Drive()
    links.add("stage_z", z.keep_alive)
    clock.sleep(0)
    assert z.is_fed()
    time.sleep(SIGN_OF_LIFE_S + 0.1)  # it waits for nothing and for no answer
    assert not z.is_fed(within_s=0.3)
    clock.sleep(0)
    assert z.is_fed()


def test_an_answer_that_is_overdue_starves_them_as_well(
    clock: WallClock, links: LinkWorkers
) -> None:
    z = Drive()
    links.add("stage_z", z.keep_alive)
    with clock.answer_within(0.2):
        time.sleep(0.2 + SIGN_OF_LIFE_S + 0.1)
        assert not z.is_fed(within_s=0.3)
    assert z.is_fed()


def test_another_thread_that_waits_keeps_no_drive_of_a_hung_procedure_alive(
    clock: WallClock, links: LinkWorkers
) -> None:
    z, over = Drive(), threading.Event()
    links.add("stage_z", z.keep_alive)
    links.add("daq")

    def wait_on() -> None:
        while not over.wait(0.01):
            clock.sleep(0)
            with clock.answer_within(LONGEST_S):
                pass

    with links["daq"] as daq:
        daq.ask("blocks", wait_on)
        time.sleep(SIGN_OF_LIFE_S + 0.1)
        assert not z.is_fed(within_s=0.3)
        over.set()


def test_a_drive_that_is_not_heard_ends_a_wait_once_and_starves_no_other(
    clock: WallClock, links: LinkWorkers
) -> None:
    def silent() -> None:
        raise SILENT

    x, z = Drive(silent), Drive()
    links.add("stage_x", x.keep_alive)
    links.add("stage_z", z.keep_alive)
    with pytest.raises(InstrumentError, match="no answer"):
        clock.sleep(LONGEST_S)
    with links.making_safe():
        clock.sleep(0.1)
        fed = len(x.fed)
        clock.sleep(0.1)
        assert z.is_fed()
        assert len(x.fed) == fed, "asked once more, then left to its own time-out"
    with pytest.raises(InstrumentError, match="no answer"):
        clock.sleep(LONGEST_S)


def test_while_the_bench_is_made_safe_drives_are_fed_without_signs_of_life(
    links: LinkWorkers,
) -> None:
    z = Drive()
    links.add("stage_z", z.keep_alive)
    time.sleep(SIGN_OF_LIFE_S + 0.1)
    with links.making_safe():
        assert z.is_fed()
    assert not z.is_fed(within_s=0.3)


def test_in_virtual_time_drives_are_fed_in_the_slices_of_a_wait_in_their_order() -> None:
    clock, fed = VirtualClock(), list[str]()
    links = LinkWorkers(clock)

    def unheard() -> None:
        fed.append("x")
        raise SILENT

    links.add("stage_x", unheard)
    links.add("stage_z", lambda: fed.append("z"))
    with pytest.raises(InstrumentError, match="no answer"):
        links.poll()
    assert fed == ["x"]
    with links.making_safe():
        links.poll()
        links.poll()
    assert fed == ["x", "x", "z", "z"], "asked once more, then left to its own time-out"
    with pytest.raises(InstrumentError, match="no answer"):
        links.poll()


def test_nobody_is_fed_after_the_end(clock: WallClock, links: LinkWorkers) -> None:
    z = Drive()
    links.add("stage_z", z.keep_alive)
    assert z.is_fed()
    links.close()
    clock.sleep(0)
    assert not z.is_fed(within_s=0.2)
    assert not z.fed[0].is_alive()


def test_where_no_thread_can_be_had_it_says_so(
    links: LinkWorkers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RigError, match="'link stage_z' cannot be started: can't start new"):
            links.add("stage_z")
    assert len(links) == 0
