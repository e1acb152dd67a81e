"""What a tick asks for and does not wait for: in order, the newest, and nothing after an end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError
from rig.run.aside import Aside

LONGEST_S = 5.0


class StandingClock(WallClock):
    """As a slaved one, whose time stands while an instrument answers."""

    stands = True


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


@pytest.mark.parametrize("clock", [WallClock(), StandingClock()])
def test_outside_a_loop_and_in_slaved_time_it_is_done_where_it_is_asked_for(clock: Clock) -> None:
    link, aside = Link(), Aside("a link", clock)
    link.let(2)
    aside.ask("look", link.work("before"))
    assert link.heard == ["before"]
    if clock.stands:
        with aside:
            aside.ask("look", link.work("in a loop"))
            assert link.heard[1:] == ["in a loop"]
            assert aside.idle
    assert set(link.by) == {threading.current_thread()}


def test_in_real_time_nobody_waits_and_the_end_of_the_loop_does() -> None:
    link = Link()
    with Aside("a link", WallClock()) as aside:
        aside.ask("target", link.work("target"))
        aside.ask("look", link.work("look"))
        link.await_question()
        assert link.heard == []
        assert not aside.idle
        before_s = aside.silent_s
        time.sleep(0.01)
        assert aside.silent_s >= before_s + 0.01
        link.let(2)
        aside.settle()
        assert aside.silent_s == 0
    assert link.heard == ["target", "look"]
    assert threading.current_thread() not in link.by
    assert len(set(link.by)) == 1


def test_the_newest_takes_the_place_of_what_has_not_begun() -> None:
    link = Link()
    with Aside("a link", WallClock()) as aside:
        aside.ask("target", link.work("1"))
        link.await_question()
        for name in ("2", "3", "4"):
            aside.ask("target", link.work(name))
        aside.ask("look", link.work("look"))
        link.let(3)
        aside.settle()
        assert aside.idle
        assert link.heard == ["1", "4", "look"]


def test_what_fails_is_raised_at_the_next_look_and_nothing_is_done_any_more() -> None:
    link = Link()

    def fail() -> None:
        raise InstrumentError("stage_z", "move", "a fault")

    def loop(aside: Aside) -> None:
        with aside:
            aside.ask("target", fail)
            aside.ask("look", link.work("look"))
            give_up = time.monotonic() + LONGEST_S
            while time.monotonic() < give_up:
                aside.check()
                time.sleep(0.001)

    link.let()
    aside = Aside("a link", WallClock())
    with pytest.raises(InstrumentError, match="a fault"):
        loop(aside)
    assert link.heard == []
    with pytest.raises(InstrumentError, match="a fault"):
        aside.ask("look", link.work("look"))


def test_what_ends_the_loop_waits_for_nobody_and_forgets_what_has_not_begun() -> None:
    link = Link()

    def loop() -> None:
        with Aside("a link", WallClock()) as aside:
            aside.ask("target", link.work("under way"))
            link.await_question()
            aside.ask("look", link.work("not begun"))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert link.heard == []  # it hangs, and nobody has waited
    (worker,) = set(link.by)
    link.let(2)
    worker.join(LONGEST_S)
    assert not worker.is_alive()
    assert link.heard == ["under way"]


def test_a_wait_of_the_link_is_no_sign_of_life_of_the_procedure() -> None:
    """Keep-alives and stop requests are called from the procedure's own waits alone."""
    clock, calls = WallClock(), list[threading.Thread]()
    clock.each_slice(lambda: calls.append(threading.current_thread()))
    with Aside("a link", clock) as aside:
        aside.ask("target", lambda: clock.sleep(0.03))
        aside.settle()
        assert calls == []
        clock.sleep(0)
        aside.ask("target", lambda: clock.charge(0.03))
    assert calls == [threading.current_thread()]
