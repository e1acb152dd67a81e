"""Modules that run in a child process: answers, deadlines, crashes and bounds."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from rig.core import child as child_module
from rig.core.child import Child, ChildError, run_module

MODULE = """
import os, sys, time
wanted, given = sys.argv[1], sys.stdin.buffer.read()
if wanted == "echo":
    sys.stdout.buffer.write(given[::-1])
elif wanted == "refuse":
    sys.exit("first line\\nthe file is damaged")
elif wanted == "die":
    os.abort()
elif wanted == "hang":
    open(sys.argv[2], "w").write(str(os.getpid()))
    time.sleep(600)
elif wanted == "chatter":
    while True:
        os.write(1, b"x" * 65536)
elif wanted == "leave":
    if pid := os.fork():
        open(sys.argv[2], "w").write(str(pid))
        os._exit(0)
    time.sleep(600)
elif wanted == "grow":
    print(len(bytearray(1 << 31)))
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "child_of_the_test.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "child_of_the_test"


def test_the_answer_is_what_it_writes(module: str) -> None:
    given = os.urandom(3 << 20)
    assert run_module(module, ["echo"], given=given, timeout_s=60) == given[::-1]


def test_the_last_line_of_its_complaint_is_the_reason(module: str) -> None:
    with pytest.raises(ChildError, match=r"\Aexit code 1: the file is damaged\Z"):
        run_module(module, ["refuse"], timeout_s=60)


def test_a_crash_names_the_signal(module: str) -> None:
    with pytest.raises(ChildError, match="SIGABRT") as raised:
        run_module(module, ["die"], timeout_s=60)
    assert not raised.value.timed_out


@pytest.mark.thorough
def test_a_child_that_hangs_is_killed(module: str, tmp_path: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(ChildError, match="did not finish within 3 s") as raised:
        run_module(module, ["hang", str(tmp_path / "pid")], timeout_s=3)
    assert raised.value.timed_out
    assert time.monotonic() - begun < 60
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_output_without_end_is_cut_off(module: str) -> None:
    with pytest.raises(ChildError, match="its answer is longer than 1048576 bytes"):
        run_module(module, ["chatter"], timeout_s=60, max_answer_bytes=1 << 20)


def test_more_memory_than_allowed_is_an_error(module: str) -> None:
    with pytest.raises(ChildError, match="MemoryError"):
        run_module(module, ["grow"], timeout_s=60, max_memory_bytes=1 << 30)


def test_one_whose_outputs_stay_open_behind_it_has_ended(module: str, tmp_path: Path) -> None:
    """A process that it has started holds the pipes."""
    begun = time.monotonic()
    assert run_module(module, ["leave", str(tmp_path / "pid")], timeout_s=600) == b""
    assert time.monotonic() - begun < 60
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)


def test_a_child_is_at_work_until_it_has_ended_and_the_end_of_its_output_is_returned() -> None:
    program = "import sys; sys.stdin.read(1); print('x' * 100_000, 'the end')"
    child = Child([sys.executable, "-c", program], 60, given=b"go")
    while (ended := child.poll()) is None:
        child.wait(1)
    assert ended.failure == ""
    assert ended.output.endswith(b"x the end\n")
    assert len(ended.output) == child_module.TAIL_BYTES
