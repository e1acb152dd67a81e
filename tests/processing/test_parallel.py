"""Many files at once: every answer has its number, and what goes wrong is reported."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest

from rig.core.errors import ConfigurationError, RigError
from rig.processing import parallel
from rig.processing.parallel import completed


def square(number: int) -> int:
    return number * number


def stumble(number: int) -> int:
    if number == 2:
        raise ValueError("two is too many")
    return number


def die(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("processes", [1, 2])
def test_every_answer_has_the_number_of_its_item(processes: int) -> None:
    assert dict(completed(square, range(7), processes)) == {n: n * n for n in range(7)}


def test_processes_work_beside_the_command() -> None:
    mine = os.getpid()
    others = dict(completed(_where, range(4), 2)).values()
    assert mine not in others
    assert 1 <= len(set(others)) <= 2


def _where(_: int) -> int:
    return os.getpid()


def test_what_one_file_raises_is_its_own() -> None:
    found = dict(completed(stumble, range(4), 2))
    failure = found.pop(2)
    assert isinstance(failure, RigError)
    assert failure.message == "ValueError: two is too many"
    assert found == {0: 0, 1: 1, 3: 3}


def test_a_process_that_dies_is_reported() -> None:
    found = dict(completed(die, range(3), 2))
    assert len(found) == 3
    for failure in found.values():
        assert isinstance(failure, RigError)
        assert "the process that read it died" in failure.message


def never_return(_: int) -> int:
    while True:
        time.sleep(1.0)


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_an_interruption_does_not_wait_for_a_file_that_never_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parallel, "END_S", 0.1)
    monkeypatch.setattr(parallel, "as_completed", interrupt)
    with pytest.raises(KeyboardInterrupt):
        list(completed(never_return, range(3), 2))
    assert not multiprocessing.active_children()


def test_a_second_interruption_ends_the_processes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "as_completed", interrupt)
    monkeypatch.setattr(parallel, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        list(completed(never_return, range(3), 2))
    assert not multiprocessing.active_children()


def test_one_file_may_be_read_apart_from_the_command() -> None:
    ((_, failure),) = completed(die, [0], 1, apart=True)
    assert isinstance(failure, RigError)
    assert dict(completed(die, [], 1, apart=True)) == {}


def test_a_cluster_that_is_not_there_is_a_usage_error() -> None:
    with pytest.raises(ConfigurationError, match=r"--scheduler nowhere: no Dask scheduler"):
        list(completed(square, range(2), 1, "nowhere"))


def test_an_address_that_is_none_is_refused_without_a_client(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A client that was half made waited for 20 s at its end, and printed a traceback."""
    made: list[object] = []
    monkeypatch.setattr("distributed.Client.__init__", lambda self, *_, **__: made.append(self))
    with pytest.raises(ConfigurationError, match="missing port number"):
        list(completed(square, range(2), 1, "nowhere"))
    assert not made
