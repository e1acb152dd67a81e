"""Programs that use a bench are ended before it is made safe."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from rig.run.locks import bench_users, lock_holder
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.bench_users import run_at_work, stop_users
from rig.run.locks.lock_holder import lock_file

PLAN: object = None
"""Nothing is asked of it: its addresses are given."""
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
def names(tmp_path, monkeypatch) -> tuple[str, ...]:
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    monkeypatch.setattr(bench_users, "address_names", lambda _: ("z", "x"))
    return ("z", "x")


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


def test_a_run_is_asked_to_stop_and_makes_its_bench_safe_before_anything_else_does(hold) -> None:
    run = hold()
    assert stop_users(PLAN) == []
    assert run.stdout.readline() == "made safe\n"
    assert run.wait(30) == 0
    assert run_at_work(PLAN) is None


def test_a_run_that_does_not_stop_is_left_after_a_while_and_named(hold, names, monkeypatch) -> None:
    monkeypatch.setattr(bench_users, "MADE_SAFE_S", 0.1)
    run = hold("deaf")
    BenchMarks(names, "bench-3", None).running(os.getpid())
    assert stop_users(PLAN) == []
    assert run.poll() is None
    mark = run_at_work(PLAN)
    assert mark is not None
    assert mark.run is not None
    assert mark.run.pid == os.getpid()


def test_another_users_run_is_not_waited_for(hold, monkeypatch) -> None:
    def forbidden(*_):
        raise PermissionError

    hold()
    monkeypatch.setattr(lock_holder, "_carries", forbidden)
    (failure,) = stop_users(PLAN)
    assert "the run belongs to " in failure.message


def test_a_bench_that_nobody_uses_is_not_waited_for() -> None:
    assert stop_users(PLAN) == []
    assert run_at_work(PLAN) is None
