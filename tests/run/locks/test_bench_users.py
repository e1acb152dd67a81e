"""Programs that use a bench are ended before it is made safe."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from rig.run.locks import bench_users, lock, lock_holder
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.bench_users import run_at_work, stop_users, take_turn
from rig.run.locks.lock import try_lock
from rig.run.locks.lock_holder import lock_file
from rig.run.locks.shared_folder import SharedFolder

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
    for module in (bench_users, lock):
        monkeypatch.setattr(module, "address_names", lambda _: ("z", "x"))
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


def test_two_that_make_a_bench_safe_do_it_one_after_the_other(tmp_path) -> None:
    code = (
        "import os, sys, time; from rig.run.locks import bench_users\n"
        "bench_users.address_names = lambda _: ('z', 'x')\n"
        "bench_users.take_turn(None)\n"
        "os.write(1, b'begins '); time.sleep(0.3); os.write(1, b'ends ')"
    )
    shown = tmp_path / "shown"
    with shown.open("ab") as file:
        both = [subprocess.Popen([sys.executable, "-c", code], stdout=file) for _ in range(2)]
        assert [one.wait(60) for one in both] == [0, 0]
    assert shown.read_text() == "begins ends begins ends "


def test_one_that_hangs_while_it_makes_the_bench_safe_keeps_no_other_from_it(
    names, monkeypatch
) -> None:
    monkeypatch.setattr(bench_users, "ALONE_S", 0.1)
    with SharedFolder() as folder:
        files = [folder.open_file(name + ".making-safe", create=True) for name in names]
    assert all(map(try_lock, files))
    take_turn(PLAN)
    for file in files:
        os.close(file)


def test_a_bench_that_nobody_uses_is_not_waited_for() -> None:
    assert stop_users(PLAN) == []
    assert run_at_work(PLAN) is None
