"""Stop requests at any instant: safe first, then a readable file, then one line and its code."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from tiers import mostly_nightly
from typist import Typist

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SIXTY_POINTS = (
    "--frequencies", ",".join(str(f) for f in range(300, 6300, 100)), "--settling", "0.3s"
)  # fmt: skip
"""They take seconds: what is done to a run in the middle finds it there on a busy machine too."""
FORTY_POINTS = (
    "--frequencies", ",".join(str(f) for f in range(300, 4300, 100)), "--settling", "0.3s"
)  # fmt: skip
"""The same, for a run that is not ended."""
PATIENCE_S = 120.0
STOPS = {signal.SIGINT: 130, signal.SIGQUIT: 131, signal.SIGTERM: 143, signal.SIGHUP: 129}
CALLED = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGQUIT: "Ctrl-\\",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "SIGHUP",
}


@pytest.mark.parametrize(
    "number",
    mostly_nightly(STOPS, [signal.SIGQUIT, signal.SIGHUP], [signal.SIGTERM]),
    ids=lambda number: number.name,
)
def test_a_signal_in_the_middle_ends_the_run_in_order(rig, number):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    running.send(number)
    ended = running.finish()

    assert ended.code == STOPS[number]
    assert rig.outputs() == [True, False]
    reported = ended.object
    assert reported["outcome"] == "stopped"
    assert 5 <= reported["points_done"] < 60
    file = rig.only("*.h5")
    *_, ending, saved, safe, resume = ended.stderr.splitlines()
    done = rf"Stopped by {re.escape(CALLED[number])}: {reported['points_done']} of 60 points"
    assert re.fullmatch(rf"{done} in [\d.]+ s of bench time \(simulated\)\.", ending), ending
    assert saved == f"Saved: {file.relative_to(rig.folder)}"
    assert safe == "Bench is safe: generator off, preload released, force stream stopped."
    assert resume == f"Resume with: rig resume {reported['journal']}"
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.outcome.status == "stopped"
        assert len(run.point_ids()) == reported["points_done"]


@pytest.mark.thorough
def test_what_a_key_of_the_terminal_sends_ends_neither_the_bench_nor_the_guard(rig):
    running = rig.start(*rig.sweep_arguments(*FORTY_POINTS), fresh=True)
    running.wait_for(r"^5/40 ")
    tasks = Path(f"/proc/{running.process.pid}/task").glob("*/children")
    started = {
        int(pid): Path(f"/proc/{pid}/cmdline") for t in tasks for pid in t.read_text().split()
    }
    programs = {pid: cmdline.read_bytes().split(b"\0") for pid, cmdline in started.items()}
    for program in (b"drivers.simulated.bench.process", b"rig.run.making_safe.guard"):
        (pid,) = [pid for pid, words in programs.items() if program in words]
        for number in (signal.SIGINT, signal.SIGQUIT):
            os.kill(pid, number)
    ended = running.finish()
    assert ended.code == 0, ended.stderr
    assert "the guard has died" not in ended.stderr
    assert ended.object["points_done"] == 40


@pytest.mark.thorough
def test_a_signal_before_the_bench_is_connected_switches_nothing_on(rig):
    running = rig.start_sweep()
    rig.await_world("ch1.load_ohm")
    running.send(signal.SIGINT)
    ended = running.finish()

    assert ended.code == 130
    assert rig.outputs() in ([], [True, False])  # the signal met the connection, or came just after
    assert ended.object["outcome"] == "stopped"


def test_further_signals_do_not_disturb_the_clean_up(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    until = time.monotonic() + 60
    while running.process.poll() is None and time.monotonic() < until:
        running.send(signal.SIGINT)  # up to the last instruction of the process
        time.sleep(0.01)
    ended = running.finish()

    assert ended.code == 130
    assert rig.outputs() == [True, False]
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_a_stop_while_waiting_is_seen_within_the_wait(rig):
    """A sweep that settles for an hour at its only point stops at once, not after the hour."""
    running = rig.start_sweep("--frequencies", "20", "--settling", "60")
    rig.await_world("ch1.on", True)
    running.send(signal.SIGTERM)
    ended = running.finish()

    assert ended.code == 143
    assert rig.outputs() == [True, False]
    assert ended.object["points_done"] == 0
    assert verify(rig.only("*.h5")) == []


PAUSED = r"^PAUSED \(bench is safe\)\. Ctrl-Z continues, Ctrl-C ends the run\.$"


def assert_stopped_in_order(rig, ended, number):
    """Its own exit code, whatever was going on; nothing on, nothing pressed, a readable file."""
    assert ended.code == STOPS[number], ended.stderr
    assert ended.object["outcome"] == "stopped"
    assert not ended.errors
    assert rig.outputs()[-1] is False
    stood = [e["value"] for e in rig.log() if (e["device"], e["what"]) == ("stage_z", "at-rest")]
    assert stood[-1] == pytest.approx(5.0, abs=0.02)
    assert verify(rig.only("*.h5")) == []


@pytest.mark.parametrize(
    "number",
    mostly_nightly(STOPS, [signal.SIGINT]),
    ids=lambda number: number.name,
)
def test_a_signal_while_paused_ends_the_run_in_order(rig, number):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    running.send(signal.SIGTSTP)
    running.wait_for(PAUSED)
    running.send(number)
    assert_stopped_in_order(rig, running.finish(), number)
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_a_signal_while_a_pause_makes_the_bench_safe_waits_for_that_and_ends_the_run(rig):
    """The generator is off already, the stage on its way up: it gets there."""
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    running.send(signal.SIGTSTP)
    rig.await_world("ch1.on", False)
    running.send(signal.SIGINT)
    assert_stopped_in_order(rig, running.finish(), signal.SIGINT)


@pytest.mark.thorough
@pytest.mark.parametrize("number", STOPS, ids=lambda number: number.name)
def test_a_signal_while_the_program_starts_has_the_same_exit_code(rig, number):
    running = rig.start(*rig.sweep_arguments(), fresh=True)
    while not rig.world_log.exists():
        time.sleep(0.005)
    running.send(number)
    ended = running.finish()

    assert ended.code == STOPS[number]
    assert rig.outputs() in ([], [True, False])
    left_behind = [p for p in Path("/proc").glob("[0-9]*/cmdline") if names_log(rig, p)]
    assert left_behind == []


def names_log(rig, cmdline):
    """Whether it is the command line of this test's simulated bench."""
    try:
        return str(rig.world_log).encode() in cmdline.read_bytes()
    except OSError:  # it has ended meanwhile
        return False


@pytest.mark.thorough
def test_a_run_outlasts_the_terminal_that_it_speaks_to(rig):
    """Nobody reads stderr or stdout any more; only the run file can tell how it ended."""
    running = subprocess.Popen(
        rig.command(*rig.sweep_arguments("--frequencies", "300,400,500,600,700")),
        cwd=rig.folder,
        env=rig.env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    running.stderr.readline()
    running.stderr.close()
    running.stdout.close()
    assert running.wait(PATIENCE_S) == 0
    assert rig.outputs() == [True, False]
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.outcome.status == "complete"


@pytest.mark.thorough
def test_a_stop_is_acknowledged_and_the_last_line_says_how_to_resume(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    running.send(signal.SIGINT)
    ended = running.finish()
    lines = ended.stderr.splitlines()
    assert "stopping: making the bench safe, then saving the data ..." in lines
    assert f"Resume with: rig resume {ended.object['journal']}" in lines[-1]


@pytest.mark.thorough
def test_a_stop_before_the_first_point_leaves_no_progress_bar_on_a_terminal(rig):
    person = Typist(rig, "sweep", "--no-figures", *SIXTY_POINTS)
    try:
        person.types_after("ETA", b"\x03")
        code, shown = person.ends()
    finally:
        person.close()
    assert code == 130
    assert "\r\x1b[2Kstopping: making the bench safe" in shown, "the bar is erased first"
    bars, ending = shown.rindex("ETA"), shown.index("Stopped by Ctrl-C: 0 of 60 points")
    assert bars < shown.rindex("\x1b[2K") < ending
    assert "\x1b[?25h" in shown[bars:ending], "the cursor is shown again"


def test_a_usage_error_gives_an_object_too(rig):
    for wrong in ("--nonsense", "--seed=-1"):
        ended = rig.run("sweep", "--json", wrong)
        assert ended.code == 2
        assert ended.object["exit"] == 2
        assert wrong.split("=")[0] in ended.object["errors"][0]


@pytest.mark.thorough
def test_a_log_that_cannot_be_written_disturbs_no_run(rig):
    (rig.results / "rig.log").mkdir(parents=True)
    ended = rig.sweep("--load=1000N", "--frequencies", "210")
    assert ended.code == 4, ended.stderr
    assert "Traceback" not in ended.stderr
    assert ended.object["exit"] == 4
