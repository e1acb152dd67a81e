"""Who holds a lock, by the kernel; and that a signal reaches that process and no other."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from rig.run.locks import lock_holder
from rig.run.locks.lock_holder import (
    NotStoppedError,
    ask_to_stop,
    holder_by_path,
    holder_of,
    holders_by_path,
    is_stopped,
)

HOLD = """
import fcntl, os, signal, sys
file = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT)
fcntl.flock(file, fcntl.LOCK_EX)
os.pwrite(file, b'{"pid": 1}', 0)
print("held", flush=True)
signal.sigwait([signal.SIGTERM]) if len(sys.argv) > 2 else signal.pause()
"""


@pytest.fixture
def holding(tmp_path):
    path = tmp_path / "a.lock"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.readline()
    yield path, process
    process.kill()
    process.wait()


def test_the_process_that_took_the_lock_is_asked_to_stop_whatever_the_file_says(holding):
    path, process = holding
    assert json.loads(path.read_text())["pid"] == 1
    reader = os.open(path, os.O_RDONLY)  # who merely has the file open is nobody
    try:
        holder = ask_to_stop(path)
    finally:
        os.close(reader)
    assert (holder.pid, holder.own) == (process.pid, True)
    assert process.wait(30) == -signal.SIGTERM
    with pytest.raises(NotStoppedError, match="no process holds"):
        ask_to_stop(path)


def test_a_process_is_found_by_the_path_of_its_lock_without_a_look_at_the_file(
    holding, monkeypatch, tmp_path
):
    """As where the disk of the file does not answer."""
    path, process = holding
    reader = os.open(path, os.O_RDONLY)
    try:
        with monkeypatch.context() as patched:
            patched.setattr(os.path, "samestat", None)
            assert path in holders_by_path("a.lock")
            assert holder_by_path(tmp_path / "b" / "a.lock") is None
            assert not is_stopped(process.pid)
            holder = ask_to_stop(path, signal.SIGSTOP, by_path=True)
        assert (holder.pid, holder.own) == (process.pid, True)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        assert is_stopped(process.pid)
        ask_to_stop(path, signal.SIGKILL, by_path=True)
        assert process.wait(30) == -signal.SIGKILL
        assert holder_by_path(path) is None
    finally:
        os.close(reader)


def test_looking_takes_no_lock_that_a_run_may_want(holding, tmp_path):
    path, _ = holding
    free = tmp_path / "free.lock"
    free.touch()
    before = lock_holder.locked_inodes()
    assert (holder_of(free), holder_of(tmp_path / "none")) == (None, None)
    assert path.stat().st_ino in before
    file = os.open(free, os.O_RDWR)
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(file)


def test_of_two_candidates_the_one_in_which_the_lock_was_seen_is_the_holder(holding, monkeypatch):
    """A file of another disk may have the same number, and be locked by another user's process."""
    path, process = holding
    found = lock_holder._holder

    def of_others(pid, status):
        if pid == process.pid:
            return found(pid, status)
        return lock_holder.LockHolder(pid, "bob", False)

    monkeypatch.setattr(lock_holder, "_holder", of_others)
    locked = {path.stat().st_ino: [1, process.pid, 2]}
    assert holder_of(path, locked) == found(process.pid, path.stat())


def test_a_number_that_another_process_has_taken_over_gets_no_signal(holding, monkeypatch):
    """As if the holder ended after it was found, and its number was given to another process."""
    path, process = holding
    bystander = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])
    try:
        found = holder_of(path)
        assert found is not None
        answers = [lock_holder.LockHolder(bystander.pid, found.user, True), found]
        monkeypatch.setattr(lock_holder, "holder_of", lambda _: answers.pop(0))
        with pytest.raises(NotStoppedError, match="does not hold"):
            ask_to_stop(path)
        time.sleep(0.1)
        assert bystander.poll() is None
        assert process.poll() is None
    finally:
        bystander.kill()
        bystander.wait()


def test_another_users_run_is_refused(holding, monkeypatch):
    path, process = holding

    def forbidden(*_):
        raise PermissionError

    monkeypatch.setattr(lock_holder, "_carries", forbidden)
    with pytest.raises(NotStoppedError, match="belongs to"):
        ask_to_stop(path)
    assert process.poll() is None
