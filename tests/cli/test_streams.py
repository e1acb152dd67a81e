"""What is printed while a terminal is held (Ctrl-S), or while nobody reads a pipe."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from nights import QUICK_NIGHT, await_answer, folder_of, write_night

from rig.cli.streams import LinesInTurn

FILLED = """
import os, sys
reader, writer = os.pipe()
os.set_blocking(writer, False)
try:
    while True:
        os.write(writer, b"x")
except BlockingIOError:
    os.set_blocking(writer, True)
"""
A_NIGHT = (
    QUICK_NIGHT
    + """
[[experiment]]
procedure = "sweep"
repeat = 20
settings = { frequencies_Hz = [200], load_N = 0.5 }
"""
)


def test_the_line_of_a_signal_does_not_wait_for_a_reader() -> None:
    """It is written by the signal's handler, in the thread that has to stop the bench."""
    code = f"{FILLED}\nos.dup2(writer, 2)\nfrom rig.cli.streams import say_at_once\n"
    subprocess.run([sys.executable, "-c", f"{code}say_at_once('stopping')"], timeout=30, check=True)


def test_the_line_of_a_signal_is_shown_where_somebody_reads() -> None:
    code = "from rig.cli.streams import say_at_once; say_at_once('stopping')"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert shown.stderr == b"stopping\n"


def test_lines_are_printed_in_their_order_and_one_that_fails_costs_only_itself() -> None:
    shown: list[str] = []

    def show(text: str) -> None:
        if text == "2":
            raise OSError
        shown.append(text)

    with LinesInTurn(show) as lines:
        for number in range(5):
            lines.say(str(number))
    assert shown == ["0", "1", "3", "4"]


def test_a_line_that_is_not_taken_keeps_nobody_waiting() -> None:
    continued = threading.Event()
    try:
        with LinesInTurn(lambda _: continued.wait() and None) as lines:
            lines.say("a")
            lines.say("b")
    finally:
        continued.set()


def test_a_stdin_that_was_closed_from_the_start_is_one_that_has_ended() -> None:
    """Python has no `sys.stdin` then, and the questions to a person were internal errors."""
    code = """
import sys
assert sys.stdin is None
from rig.cli.streams import outlast_readers
outlast_readers()
assert not sys.stdin.isatty()
assert sys.stdin.fileno() == 0
assert sys.stdin.read() == ""
"""
    subprocess.run(["sh", "-c", '"$0" -c "$1" <&-', sys.executable, code], check=True)


def fill(pipe: int) -> None:
    """Fill a pipe through another description of it: the program's own shall wait."""
    filling = os.open(f"/proc/self/fd/{pipe}", os.O_WRONLY | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(filling, b"x")
    os.close(filling)


@pytest.mark.thorough
def test_a_run_whose_last_lines_nobody_reads_has_let_the_bench_go(rig) -> None:
    simulator = rig.start("simulate", "--write", "sim.toml")
    simulator.wait_for("drive it")
    sweep = ("sweep", "--bench", "sim.toml", "--no-figures", "--frequencies")
    reader, writer = os.pipe()
    run = subprocess.Popen(
        rig.command(*sweep, "300,400"),
        cwd=rig.folder, env=rig.env, stdout=subprocess.DEVNULL, stderr=writer,
    )  # fmt: skip
    try:
        shown = b""
        while b"1/2 " not in shown:
            shown += os.read(reader, 4096)
        fill(writer)
        deadline_s = time.monotonic() + 60
        while (code := (then := rig.run(*sweep, "300")).code) == 2 and "in use" in then.stderr:
            assert time.monotonic() < deadline_s, then.stderr
            time.sleep(0.5)
        assert code == 0, then.stderr
        assert run.poll() is None, "its closing lines still wait for a reader"
    finally:
        run.kill()
        run.wait()
        os.close(reader)
        os.close(writer)
    simulator.send(signal.SIGTERM)
    assert simulator.finish().code == 0


@pytest.mark.thorough
def test_a_batch_whose_output_nobody_reads_is_stopped_all_the_same(rig) -> None:
    """``rig batch run night.toml 2>&1 | less``, with less at its first page."""
    write_night(rig, A_NIGHT)
    reader, writer = os.pipe()
    batch = subprocess.Popen(
        rig.command("batch", "run", "night.toml"),
        cwd=rig.folder, env=rig.env, stdout=subprocess.DEVNULL, stderr=writer, process_group=0,
    )  # fmt: skip
    try:
        shown = b""
        while b"run 1/" not in shown:
            shown += os.read(reader, 4096)
        fill(writer)
        folder = folder_of(rig.results)
        await_answer(folder, "SELECT state FROM run WHERE number = 1", "done")  # it says so
        batch.send_signal(signal.SIGTERM)
        # The closing lines still wait for a reader; the batch is over by then.
        state = "SELECT substr(value, 1, 18) FROM meta WHERE key = 'state'"
        await_answer(folder, state, "stopped by SIGTERM")
    finally:
        batch.kill()
        batch.wait()
        os.close(reader)
        os.close(writer)
