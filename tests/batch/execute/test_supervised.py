"""No run of a batch begins while its supervisor is stopped or hangs."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from nights import QUICK_NIGHT, await_answer, await_point, folder_of, worker_of, write_night

from rig.batch.execute import worker_link
from rig.batch.execute.between_runs import SUPERVISOR_S, BetweenRuns, SelfEnding
from rig.batch.execute.worker_process import BEAT, WorkerProcess, send_beat
from rig.run.stopping import StopRequestedError


class Between:
    """A worker between two runs, whose supervisor was heard `silent_s` ago."""

    def __init__(self, silent_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.reported, self.stopped = silent_s, list[str](), False
        self.waited_s = 0.0
        self.heard_after_s = 30.0
        """Waiting time after which the supervisor is heard again."""
        self.commands = SimpleNamespace(
            heard_s=0.0, stop_after_run=False, paused=_Unset(), paused_because=""
        )
        waits: Any = BetweenRuns.__new__(BetweenRuns)
        waits._stop = SimpleNamespace(check=self.check)
        waits._commands = self.commands
        waits._check_interlocks = lambda: None
        waits._interlocks_watched = contextlib.nullcontext
        waits._send = lambda event, **fields: self.reported.append(fields["text"])
        self.waits = waits
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def check(self) -> None:
        if self.stopped:
            raise StopRequestedError(signal.SIGTERM)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.waited_s += seconds
        if self.waited_s >= self.heard_after_s:
            self.commands.heard_s = self.now_s


class _Unset:
    def is_set(self) -> bool:
        return False


def test_a_supervisor_that_is_heard_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    between = Between(0.9 * SUPERVISOR_S, monkeypatch)
    between.waits.check()
    assert (between.waited_s, between.reported) == (0.0, [])


def test_a_supervisor_that_hangs_is_waited_for_before_a_run_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    between = Between(1.1 * SUPERVISOR_S, monkeypatch)
    between.waits.check()
    assert between.waited_s == pytest.approx(30.0, abs=0.1)
    (reported,) = between.reported
    assert "the supervisor of the batch was not heard for 10 s" in reported
    assert "no run was begun until it was heard again" in reported


def test_a_hold_that_ends_by_itself_says_what_is_there_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    between = Between(0.0, monkeypatch)
    between.waits._until = None
    between.commands.paused = threading.Event()
    between.commands.paused.set()
    between.waits._wait("held", SelfEnding(lambda: True, "the folder is in its place"))
    assert between.reported == ["the folder is in its place again"]
    assert not between.commands.paused.is_set()


@pytest.mark.parametrize(
    ("commands", "paused"), [([], False), (["pause"], True), (["pause", "go"], False)]
)
@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_a_hold_that_ends_by_itself_leaves_the_pause_of_a_person(
    commands: list[str], paused: bool, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = SimpleNamespace(start=lambda: None)
    monkeypatch.setattr(worker_link.threading, "Thread", lambda **_: nothing)  # type: ignore[attr-defined]
    listener = worker_link.CommandListener(SimpleNamespace(), lambda *_, **__: None)  # type: ignore[arg-type]
    between = Between(0.0, monkeypatch)
    waits = between.waits
    waits._commands, waits._until, waits._on_hold = listener, None, "wait"
    waits._queue = SimpleNamespace(add_event=lambda *_: None)

    def is_over() -> bool:
        if when == "meanwhile":
            for command in commands:
                listener._handle(command)
        return True

    if when == "before":
        for command in commands:
            listener._handle(command)
    waits.hold("the disk is full", SelfEnding(is_over, "there is room on the disk"))
    assert listener.paused.is_set() == paused


def test_a_reason_to_wait_reaches_the_next_worker_with_any_characters(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[list[str]] = []

    def popen(arguments: list[str], **_: Any) -> None:
        given.append(arguments)
        raise InterruptedError

    monkeypatch.setattr(subprocess, "Popen", popen)
    reason = "stage_z: answered 'a\0\ud800 µ'; " + "check it; " * 20000
    with pytest.raises(InterruptedError):
        WorkerProcess(tmp_path, io.BytesIO(), reason)
    (arguments,) = given
    (option,) = (one for one in arguments if one.startswith("--paused="))
    assert option.isascii()
    assert option.isprintable()
    assert len(option) < 1000
    read = json.loads(option.removeprefix("--paused="))
    assert read.startswith("stage_z: answered 'a\0\ud800 µ'; check it")


def test_a_stop_request_ends_that_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    between = Between(1.1 * SUPERVISOR_S, monkeypatch)
    plain = between.sleep

    def sleep(seconds: float) -> None:
        plain(seconds)
        between.stopped = between.waited_s > 1.0

    monkeypatch.setattr(time, "sleep", sleep)
    with pytest.raises(StopRequestedError):
        between.waits.check()
    assert between.waited_s < 2.0


def test_a_worker_that_reads_nothing_gets_one_sign_of_life_and_no_more() -> None:
    reads, writes = os.pipe()
    try:
        for _ in range(3):
            send_beat(writes)
        assert os.read(reads, 100) == BEAT.encode() + b"\n"
        send_beat(writes)
        assert os.read(reads, 100) == BEAT.encode() + b"\n"
        os.close(reads)
        send_beat(writes)  # it may have died
    finally:
        os.close(writes)


def test_a_worker_that_follows_one_of_a_paused_batch_begins_no_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nothing = SimpleNamespace(start=lambda: None)
    monkeypatch.setattr(worker_link.threading, "Thread", lambda **_: nothing)  # type: ignore[attr-defined]
    reported: list[str] = []
    listener = worker_link.CommandListener(
        SimpleNamespace(),  # type: ignore[arg-type]
        lambda event, **fields: reported.append(f"{fields['state']}: {fields.get('text', '')}"),
        paused_because="the film is torn",
    )
    between = Between(0.0, monkeypatch)
    between.waits._commands, between.waits._until = listener, None
    plain = between.sleep

    def sleep(seconds: float) -> None:
        plain(seconds)
        if between.waited_s > 5.0:
            listener._handle("go")

    monkeypatch.setattr(time, "sleep", sleep)
    listener.heard_s = 0.0
    between.waits.check()
    assert between.waited_s > 5.0, "until a person has resumed the batch"
    assert reported == ["running: "]
    assert between.reported == ["the film is torn"]


@pytest.mark.thorough
def test_under_nohup_a_worker_whose_supervisor_has_died_stops_as_well(rig: Any) -> None:
    """It learns of it by SIGHUP, which nohup has ignored."""
    sweeps = """
[[experiment]]
procedure = "sweep"
repeat = 20
settings = { frequencies_Hz = [200, 220, 240], load_N = 0.5 }
"""
    write_night(rig, QUICK_NIGHT + sweeps)
    batch = subprocess.Popen(
        ["nohup", *rig.command("batch", "run", "night.toml")],
        cwd=rig.folder, env=rig.env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        deadline_s = time.monotonic() + 60
        while not list(rig.results.glob("*/queue.sqlite")) and time.monotonic() < deadline_s:
            time.sleep(0.1)
        folder = folder_of(rig.results)
        await_answer(folder, "SELECT state FROM run WHERE number = 1", "running")
        await_point(folder, 1)
        assert (worker := worker_of(folder)) is not None
    finally:
        batch.kill()
        batch.wait()
    deadline_s = time.monotonic() + 60
    while worker_of(folder) is not None and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert worker_of(folder) is None, f"process {worker} still takes runs"
