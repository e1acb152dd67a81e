"""In real time, one instrument is slow or silent, or the computer has nothing more to give: the
drives are fed, and what is pressed is lifted, all the same."""

from __future__ import annotations

import contextlib
import resource
import signal
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from slow_link import slow_link

from rig.files.verify import verify

PATIENCE_S = 60.0
PARKED_mm = 5.0
START_mm = 10.0
"""Where a slide begins."""
SHORT = ("--distance", "1mm", "--speed", "0.5mm/s", "--json", "--no-figures")

HANGS = """
import time
import procedures.slip_trial.trial as trial
steadily = trial.SlipTrialRun._steadily
def hang_in_the_slide(self, arrival):
    pull = steadily(self, arrival)
    def pull_until_it_hangs(tick):
        if tick.number > 20:
            open("hangs", "w").close()
            while True:
                time.sleep(0.01)
        return pull(tick)
    return pull_until_it_hangs
trial.SlipTrialRun._steadily = hang_in_the_slide
"""
NOTHING_MORE = """
import pathlib, sys, threading
nothing_more = pathlib.Path("nothing-more")
start = threading.Thread.start
def start_if_there_is_one(thread):
    if nothing_more.exists():
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_if_there_is_one
class NoMoreModules:
    def find_spec(self, name, path=None, target=None):
        if nothing_more.exists():
            raise ImportError(f"{name}: nothing more is imported")
sys.meta_path.insert(0, NoMoreModules())
"""
NO_THREADS = """
import threading
start = threading.Thread.start
def start_none(thread):
    if thread.name == "{name}":
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_none
"""


@pytest.fixture
def serve(rig) -> Iterator[object]:
    """Simulates a bench in real time; its bench file."""
    with contextlib.ExitStack() as stack:

        def start(*arguments: str) -> Path:
            path = rig.folder / "a-bench.toml"
            serving = rig.start(
                "simulate", "--write", str(path), "--world-log", str(rig.world_log), *arguments
            )
            stack.callback(serving.finish)
            stack.callback(serving.send, signal.SIGINT)
            serving.wait_for("Ctrl-C ends it")
            return path

        yield start


def assert_lifted_before_any_drive_starved(rig) -> None:
    """Up, by drives that somebody has talked to all the time; after the end of the run nobody does,
    and they meet their time-outs where they stand."""
    assert await_rest(rig, "stage_z") == pytest.approx(PARKED_mm, abs=0.01)
    seen = [e for e in rig.log() if e["what"] in ("fault", "at-rest")]
    pressed = [e["t_us"] for e in seen if e["device"] == "stage_z" and is_pressed(e)]
    assert pressed, "it never pressed"
    lifted_us = next(
        e["t_us"]
        for e in seen
        if e["device"] == "stage_z" and e["what"] == "at-rest" and e["t_us"] > pressed[-1]
    )
    assert [e["device"] for e in seen if e["what"] == "fault" and e["t_us"] < lifted_us] == []


def is_pressed(entry) -> bool:
    return entry["what"] == "at-rest" and entry["value"] > 12.2


def await_rest(rig, stage: str) -> float:
    """Where the stage has come to rest, in mm."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        seen = [
            entry
            for entry in rig.log()
            if entry["device"] == stage and entry["what"] in ("move", "at-rest")
        ]
        if seen and seen[-1]["what"] == "at-rest":
            return float(seen[-1]["value"])
        time.sleep(0.05)
    raise AssertionError(f"{stage} still moves")


def await_slide(rig) -> None:
    """Until x slides under the force, away from where it begins."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        log = rig.log() if rig.world_log.exists() else []
        moves = [e for e in log if (e["device"], e["what"]) == ("stage_x", "move")]
        if moves and moves[-1]["value"]["target_mm"] > START_mm + 0.1:
            return
        time.sleep(0.02)
    raise AssertionError("x never slid")


@pytest.mark.thorough
def test_a_daq_that_answers_late_starves_no_drive_and_the_skin_is_lifted(rig, serve):
    path = serve("--fixture", "plate")
    text = path.read_text()
    daq = tomllib.loads(text)["daq"]["resource"]
    port = daq.split(",")[1].split("::")[0]
    with slow_link(int(port), delay_s=0.05) as slow:
        path.write_text(text.replace(daq, daq.replace(f",{port}:", f",{slow}:")))
        ended = rig.run("slip-trial", "--bench", str(path), *SHORT)
    assert ended.code in (0, 3, 5), ended.stderr
    assert_lifted_before_any_drive_starved(rig)
    await_rest(rig, "stage_x")
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_a_rotary_stage_that_falls_silent_does_not_keep_the_skin_pressed(rig, serve):
    plan = rig.fault(
        '[[fault]]\ndevice = "rotary"\nkind = "silence"\ncount = 0\n'
        "move = 4\n"  # a turn that measures the axis: the skin is pressed, also after a hold
    )
    path = serve("--fixture", "semi-spherical-object", "--fault", plan)
    ended = rig.run("roll-trial", "--bench", str(path), "--json", "--no-figures")
    assert ended.code == 7, ended.stderr
    assert ended.errors[0].startswith("error: rotary: ")
    assert_lifted_before_any_drive_starved(rig)


@pytest.mark.thorough
def test_a_generator_that_falls_silent_does_not_keep_the_film_pressed(rig, serve):
    """It is asked to switch off and has seconds to answer: the film does not wait for it."""
    plan = rig.fault(
        '[[fault]]\ndevice = "generator"\nkind = "silence"\ncount = 0\n'
        'command = "SOUR1:FREQ"\nat = 4\n'
    )
    path = serve("--fault", plan)
    ended = rig.run(
        "sweep", "--bench", str(path), "--json", "--no-figures", "--frequencies", "210,310,410,510"
    )
    assert ended.code in (3, 7), ended.stderr
    assert ended.errors[0].startswith("error: generator: ")
    assert_lifted_before_any_drive_starved(rig)


@pytest.mark.thorough
def test_making_safe_needs_no_new_thread_module_or_descriptor(rig, serve):
    path = serve("--fixture", "plate")
    running = rig.start("slip-trial", "--bench", str(path), *SHORT, before=NOTHING_MORE)
    await_slide(rig)
    (rig.folder / "nothing-more").touch()
    pid = running.process.pid
    descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    _, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (descriptors, hard))
    running.send(signal.SIGINT)
    deadline = time.monotonic() + PATIENCE_S
    while await_rest(rig, "stage_z") != pytest.approx(PARKED_mm, abs=0.01):
        assert time.monotonic() < deadline, "the skin is still pressed"
        time.sleep(0.05)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (hard, hard))  # the file may be made
    (rig.folder / "nothing-more").unlink()
    ended = running.finish()
    assert ended.code == 130, ended.stderr
    assert_lifted_before_any_drive_starved(rig)
    await_rest(rig, "stage_x")


@pytest.mark.parametrize("thread", ["link stage_z", "off", "force reader", "recorder"])
@pytest.mark.thorough
def test_a_run_that_gets_no_thread_is_refused_before_anything_is_switched_on(rig, serve, thread):
    path = serve()
    arguments = ("sweep", "--bench", str(path), "--json", "--no-figures", "--frequencies", "210")
    ended = rig.start(*arguments, before=NO_THREADS.format(name=thread)).finish()
    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert error.startswith(f"error: the thread {thread!r} cannot be started: can't start new")
    assert "ulimit -u" in error
    assert True not in rig.outputs()
    moves = [e for e in rig.log() if (e["device"], e["what"]) == ("stage_z", "move")]
    assert moves == []


@pytest.mark.thorough
def test_a_procedure_that_hangs_in_the_slide_starves_its_drives(rig, serve):
    """Its process lives, and so do the threads that talk to the drives: they fall silent all the
    same, and the drives stop by themselves before the guard ends the run."""
    path = serve("--fixture", "plate")
    slow = ("--distance", "5mm", "--speed", "0.5mm/s", "--rehearsal", "never")
    running = rig.start(
        "slip-trial", "--bench", str(path), *slow, "--json", "--no-figures", before=HANGS
    )
    rig.await_world("fault", rig.bench.x.silence_fault)
    assert (rig.folder / "hangs").exists()
    assert running.process.poll() is None, "nobody has ended it"
    assert running.process.wait(PATIENCE_S) == -signal.SIGKILL
    assert await_rest(rig, "stage_x") < 14.0, "it was on its way"
