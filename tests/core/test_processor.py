"""Two processes that take turns share a processor, and nobody else is kept there."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from rig.core import processor
from rig.core.processor import GIVEN, Turns, let_run_anywhere

pytestmark = pytest.mark.skipif(len(GIVEN) < 2, reason="one processor is shared in any case")


@pytest.fixture(autouse=True)
def own_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of other tests hold theirs."""
    monkeypatch.setattr(processor, "CLAIM", f"\0test {os.getpid()} {{}}")


@pytest.fixture
def other() -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        yield process.pid


def test_both_run_on_one_processor_until_the_turns_end(other: int) -> None:
    turns = Turns(other)
    assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(other) == os.sched_getaffinity(0)

    turns.close()
    turns.close()
    assert os.sched_getaffinity(0) == GIVEN


def test_no_two_pairs_get_the_same_and_the_last_goes_without(other: int) -> None:
    held = []
    places = set()
    try:
        for _ in GIVEN:
            held.append(Turns(other))
            places |= os.sched_getaffinity(other)
        assert places == GIVEN

        let_run_anywhere(other)
        held.append(Turns(other))
        assert os.sched_getaffinity(other) == GIVEN
    finally:
        for turns in held:
            turns.close()
    free_again = Turns(other)
    assert len(os.sched_getaffinity(0)) == 1
    free_again.close()


def test_a_child_is_let_go_and_one_that_is_gone_is_nobodys_trouble(other: int) -> None:
    turns = Turns(other)
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert len(os.sched_getaffinity(child.pid)) == 1
    let_run_anywhere(child.pid)
    assert os.sched_getaffinity(child.pid) == GIVEN
    child.communicate(b"\n")

    let_run_anywhere(child.pid)
    Turns(child.pid).close()
    turns.close()
