"""Code that never returns is interrupted."""

from __future__ import annotations

import signal
import time
from threading import Thread

import pytest

from rig.core.time_limit import TimeLimitError, time_limit

LONG_S = 1000.0


def test_code_is_interrupted_when_its_time_is_over_and_no_later_code() -> None:
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(TimeLimitError, match=r"it took longer than 1 s"), time_limit(1.0):
        time.sleep(LONG_S)
    assert signal.getsignal(signal.SIGALRM) is before


@pytest.mark.thorough
def test_code_that_catches_the_interruption_is_interrupted_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rig.core.time_limit.AGAIN_EVERY_S", 1.0)
    caught: list[TimeLimitError] = []

    def stubborn() -> None:
        while len(caught) < 2:
            try:
                time.sleep(LONG_S)
            except TimeLimitError as error:
                caught.append(error)
        time.sleep(LONG_S)

    with pytest.raises(TimeLimitError), time_limit(1.0):
        stubborn()
    assert len(caught) == 2


def test_the_limit_around_it_holds_again_afterwards() -> None:
    def work() -> None:
        with time_limit(LONG_S):
            pass
        time.sleep(LONG_S)

    with pytest.raises(TimeLimitError, match="it took longer than 2 s"), time_limit(2.0):
        work()


def test_another_thread_has_no_limit() -> None:
    before = signal.getsignal(signal.SIGALRM)
    done: list[bool] = []

    def work() -> None:
        with time_limit(LONG_S):
            done.append(signal.getsignal(signal.SIGALRM) is before)

    thread = Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]
