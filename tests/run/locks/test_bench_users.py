"""Programs that use a bench are ended before it is made safe."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from rig.run.locks import bench_users, lock_holder
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.bench_users import (
    StopRequests,
    ask_users,
    await_users,
    still_at_work,
    take_turn,
)
from rig.run.locks.lock import try_lock
from rig.run.locks.lock_holder import lock_file
from rig.run.locks.shared_folder import SharedFolder

NAMES = ("z", "x")
HOLD = """
import fcntl, os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN if "deaf" in sys.argv else signal.default_int_handler)
file = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT)
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
try:
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)  # it makes the bench safe
    print("made safe", flush=True)
"""
Hold = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(autouse=True)
def shared_folder(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))


@pytest.fixture
def hold() -> Iterator[Hold]:
    """Start a program that holds the lock of z."""
    begun = []

    def start(*how: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HOLD, str(lock_file("z")), *how]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        begun.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    yield start
    for process in begun:
        process.kill()
        process.communicate()


def stopped() -> StopRequests:
    requests = StopRequests()
    ask_users(NAMES, requests)
    await_users(NAMES, requests)
    return requests


def test_a_run_is_asked_to_stop_and_makes_its_bench_safe_before_anything_else_does(hold) -> None:
    run = hold()
    requests = stopped()
    assert requests.pids == {run.pid}
    assert run.stdout.readline() == "made safe\n"
    assert run.wait(30) == 0
    assert still_at_work(NAMES, requests) is None


def test_a_run_that_does_not_stop_is_left_after_a_while_and_named(hold, monkeypatch) -> None:
    monkeypatch.setattr(bench_users, "UNGUARDED_S", 0.1)
    run = hold("deaf")
    BenchMarks(NAMES, "bench-3", None).running(0)
    requests = stopped()
    assert run.poll() is None
    what, remedy = still_at_work(NAMES, requests) or ("", "")
    assert what.endswith(f"(process {os.getpid()})"), "the one that has written the mark"
    assert remedy == f"end it (kill -9 {os.getpid()})"


def test_a_run_with_a_guard_is_waited_for_longer(monkeypatch) -> None:
    """A way up may take 20 s, and one that hangs is killed by its guard."""
    monkeypatch.setattr(bench_users, "GUARDED_S", 77.0)
    BenchMarks(NAMES, "bench-3", None).running(os.getpid())
    assert bench_users._patience_s(NAMES) == 77.0


def test_the_guard_of_a_run_that_has_died_is_waited_for_while_it_lifts(hold, monkeypatch) -> None:
    monkeypatch.setattr(bench_users, "GUARD_ACTS_S", 66.0)
    monkeypatch.setattr(bench_users, "holder_of", lambda *_: None)  # that has died
    BenchMarks(NAMES, "bench-3", None).stopped("its guard has stopped everything")
    assert bench_users._patience_s(NAMES) == 66.0


def test_a_bench_that_a_run_could_not_make_safe_is_not_waited_for_long(hold) -> None:
    hold()
    BenchMarks(NAMES, "bench-3", None).unsafe({"generator": "no answer"})
    assert bench_users._patience_s(NAMES) == bench_users.UNGUARDED_S


def test_another_users_program_is_not_waited_for_and_may_move_the_bench_again(
    hold, monkeypatch
) -> None:
    """Its batch may rest between two runs, when nothing has a mark."""

    def forbidden(*_):
        raise PermissionError

    run = hold()
    monkeypatch.setattr(lock_holder, "_carries", forbidden)
    requests = stopped()
    (failure,) = requests.failures
    assert "the run belongs to " in failure.message
    what, _ = still_at_work(NAMES, requests) or ("", "")
    assert what.endswith(f"(process {run.pid})")


def test_a_program_that_cannot_be_seen_may_move_the_bench_again(hold, monkeypatch) -> None:
    hold("deaf")
    monkeypatch.setattr(bench_users, "UNGUARDED_S", 0.1)
    monkeypatch.setattr(bench_users, "holder_of", lambda *_: None)
    what, _ = still_at_work(NAMES, stopped()) or ("", "")
    assert "cannot be seen" in what


def test_a_program_whose_bench_is_safe_may_still_save_its_data(hold, monkeypatch) -> None:
    monkeypatch.setattr(bench_users, "SAVED_S", 0.1)
    hold("deaf")
    requests = stopped()
    assert still_at_work(NAMES, requests) is None


def test_two_that_make_a_bench_safe_do_it_one_after_the_other(tmp_path) -> None:
    code = (
        "import os, sys, time; from rig.run.locks import bench_users\n"
        "bench_users.take_turn(('z', 'x'))\n"
        "os.write(1, b'begins '); time.sleep(0.3); os.write(1, b'ends ')"
    )
    shown = tmp_path / "shown"
    with shown.open("ab") as file:
        both = [subprocess.Popen([sys.executable, "-c", code], stdout=file) for _ in range(2)]
        assert [one.wait(60) for one in both] == [0, 0]
    assert shown.read_text() == "begins ends begins ends "


def test_one_that_hangs_while_it_makes_the_bench_safe_keeps_no_other_from_it(
    monkeypatch,
) -> None:
    monkeypatch.setattr(bench_users, "ALONE_S", 0.1)
    with SharedFolder() as folder:
        files = [folder.open_file(name + ".making-safe", create=True) for name in NAMES]
    assert all(map(try_lock, files))
    take_turn(NAMES)
    for file in files:
        os.close(file)


def test_a_bench_that_nobody_uses_is_not_waited_for() -> None:
    requests = stopped()
    assert requests == StopRequests()
    assert still_at_work(NAMES, requests) is None
