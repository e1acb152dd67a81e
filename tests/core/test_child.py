"""Modules that run in a child process: answers, deadlines, crashes and bounds."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from rig.core.child import ChildError, run_module

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
    with pytest.raises(ChildError, match=r"\Aerror: the file is damaged\Z"):
        run_module(module, ["refuse"], timeout_s=60)


def test_a_crash_names_the_signal(module: str) -> None:
    with pytest.raises(ChildError, match="SIGABRT") as raised:
        run_module(module, ["die"], timeout_s=60)
    assert not raised.value.timed_out


def test_a_child_that_hangs_is_killed(module: str, tmp_path: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(ChildError, match="did not finish within 3 s") as raised:
        run_module(module, ["hang", str(tmp_path / "pid")], timeout_s=3)
    assert raised.value.timed_out
    assert time.monotonic() - begun < 60
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_output_without_end_is_cut_off(module: str) -> None:
    with pytest.raises(ChildError, match=r"SIGXFSZ|File too large"):
        run_module(module, ["chatter"], timeout_s=60, max_answer_bytes=1 << 20)


def test_more_memory_than_allowed_is_an_error(module: str) -> None:
    with pytest.raises(ChildError, match="MemoryError"):
        run_module(module, ["grow"], timeout_s=60, max_memory_bytes=1 << 30)
