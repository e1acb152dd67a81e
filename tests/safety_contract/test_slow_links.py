"""In real time, one instrument is slow or silent, or the computer has nothing more to give: the
drives are fed, and what is pressed is lifted, all the same."""

from __future__ import annotations

import contextlib
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
SLIDES = 2
"""Which move of x is the one under the force: the first goes to where it begins."""
SHORT = ("--distance", "1mm", "--speed", "0.5mm/s", "--json", "--no-figures")

HANGS = """
import time
import procedures.slip_trial.trial as trial
steadily = trial.Trial._steadily
def hang_in_the_slide(self, tick):
    if tick.number > 20:
        open("hangs", "w").close()
        while True:
            time.sleep(0.01)
    return steadily(self, tick)
trial.Trial._steadily = hang_in_the_slide
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


def faults(rig) -> list[str]:
    """The drives that have met a fault of their own."""
    return [entry["device"] for entry in rig.log() if entry["what"] == "fault"]


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
    """Until x slides under the force."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        log = rig.log() if rig.world_log.exists() else []
        moves = sum((e["device"], e["what"]) == ("stage_x", "move") for e in log)
        if moves >= SLIDES:
            return
        time.sleep(0.02)
    raise AssertionError("x never slid")


@pytest.mark.parametrize("delay_s", [0.025, 0.05])
def test_a_daq_that_answers_late_starves_no_drive_and_the_skin_is_lifted(rig, serve, delay_s):
    path = serve("--fixture", "plate")
    text = path.read_text()
    resource = tomllib.loads(text)["daq"]["resource"]
    port = resource.split(",")[1].split("::")[0]
    with slow_link(int(port), delay_s) as slow:
        path.write_text(text.replace(resource, resource.replace(f",{port}:", f",{slow}:")))
        ended = rig.run("slip-trial", "--bench", str(path), *SHORT)
    assert ended.code in (0, 3, 5), ended.stderr
    assert faults(rig) == []
    assert await_rest(rig, "stage_z") == pytest.approx(PARKED_mm, abs=0.01)
    await_rest(rig, "stage_x")
    assert verify(rig.only("*.h5")) == []
