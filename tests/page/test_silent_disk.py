"""STOP and "Make safe" where the disk of the results, or make-safe itself, gives no answer."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request
from test_night import HOLD, batch

from rig.page import server, watch
from rig.page.server import PageState
from rig.page.watch import BenchWatch

SILENT_S = 20.0
"""Time after which the disk answers after all, for a test that would hang."""


@contextmanager
def holding(*paths: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that holds the locks of these files."""
    command = [sys.executable, "-c", HOLD, *map(str, paths)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def fall_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """From its call on nothing is learnt of a file of the test's folder."""
    over, stat = threading.Event(), Path.stat

    def hang(path: Path, **how: bool) -> Any:
        if path.is_relative_to(tmp_path):
            over.wait(SILENT_S)
        return stat(path, **how)

    monkeypatch.setattr(server, "DISK_S", 0.3)
    monkeypatch.setattr(watch, "DISK_S", 0.3)
    yield lambda: monkeypatch.setattr(Path, "stat", hang)
    over.set()


def page_of(results: Path, journal: Path) -> PageState:
    """A page that shows the run of a journal."""
    shown = BenchWatch(results)
    shown.path = journal
    return PageState(shown, None, None)  # type: ignore[arg-type]


def press(state: PageState, wanted: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Press STOP."""
    begun_s = time.monotonic()
    answer = server._stop(state, wanted)
    assert time.monotonic() - begun_s < SILENT_S / 4
    return answer


def test_a_run_is_stopped_although_the_disk_of_its_results_is_silent(
    tmp_path: Path, fall_silent: Callable[[], None]
) -> None:
    (tmp_path / "real" / "day").mkdir(parents=True)
    results = tmp_path / "results"
    results.symlink_to(tmp_path / "real")  # the kernel knows the path without links
    journal = results / "day" / "a_sweep_r001.rigj"
    with holding(journal) as run:
        page = page_of(results, journal)
        fall_silent()
        assert press(page, {})[0] == 200
        assert run.wait(10) == -signal.SIGTERM


def test_a_batch_and_its_run_are_stopped_although_their_disk_is_silent(
    tmp_path: Path, fall_silent: Callable[[], None]
) -> None:
    night = batch(tmp_path, "night", 1)
    journal = night.journal(1, "sweep")
    with holding(night.supervisor_lock) as supervisor, holding(journal) as worker:
        page = page_of(tmp_path, journal)
        fall_silent()
        status, said = press(page, {"what": "run"})
        assert (status, "disk of the results gave no answer" in said["problem"]) == (409, True)
        assert (supervisor.poll(), worker.poll()) == (None, None)
        status, said = press(page, {"what": "night"})
        assert (status, "problem" in said) == (200, False)
        assert (supervisor.wait(10), worker.wait(10)) == (-signal.SIGTERM, -signal.SIGTERM)


def test_a_batch_that_rests_is_stopped_although_its_disk_is_silent(
    tmp_path: Path, fall_silent: Callable[[], None]
) -> None:
    night = batch(tmp_path, "night", 1)
    journal = night.journal(1, "sweep")
    journal.touch()
    with holding(night.supervisor_lock) as supervisor:
        page = page_of(tmp_path, journal)
        fall_silent()
        status, said = press(page, {})
        assert (status, said) == (200, {"text": "batch night was asked to stop"})
        assert supervisor.wait(10) == -signal.SIGTERM


async def post(endpoint: Any) -> tuple[int, dict[str, Any]]:
    """Ask for a change as who may stop."""

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"{}", "more_body": False}

    scope = {"type": "http", "method": "POST", "headers": [], "rig.right": "stop"}
    answer = await endpoint(Request(scope, receive))
    return answer.status_code, json.loads(answer.body)


def test_presses_that_hang_keep_no_make_safe_waiting_and_none_acts_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "LONGEST_TURN_S", 0.2)
    state = PageState(BenchWatch(tmp_path), None, None)  # type: ignore[arg-type]
    state.changes = ThreadPoolExecutor(1)
    silent, pressed = threading.Event(), []

    def stop(*_: object) -> tuple[int, dict[str, Any]]:
        pressed.append(time.monotonic())
        silent.wait(SILENT_S)
        return 200, {}

    async def both() -> None:
        presses = [
            asyncio.ensure_future(post(server._changing(state, stop, state.changes)))
            for _ in range(2)
        ]
        make_safe = server._changing(state, server._make_safe, state.makes_safe)
        status, said = await asyncio.wait_for(post(make_safe), SILENT_S / 4)
        assert (status, "no bench file" in said["problem"]) == (409, True)
        await asyncio.sleep(0.4)
        silent.set()
        (first, _), (late, said) = await asyncio.gather(*presses)
        assert (first, late, len(pressed)) == (200, 503, 1)
        assert said["problem"].startswith("nothing was done: this request waited for")

    asyncio.run(both())
    assert state.makes_safe is not state.changes


def test_a_make_safe_that_does_not_end_is_killed_and_the_bench_is_to_be_switched_off_by_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs = tmp_path / "python"
    hangs.write_text("#!/bin/sh\nexec sleep 60\n")
    hangs.chmod(0o755)
    monkeypatch.setattr(server, "MAKE_SAFE_S", 0.2)
    monkeypatch.setattr(sys, "executable", str(hangs))
    bench = tmp_path / "bench.toml"
    state = PageState(BenchWatch(tmp_path, bench), None, None)  # type: ignore[arg-type]
    by_hand = "the bench is not known to be safe; switch it off by hand"
    killed = f"make-safe of {bench} did not end within 0.2 s and was killed: {by_hand}"
    assert server._make_safe(state, {}) == (500, {"problem": killed, "exit": None})
    hangs.unlink()
    status, said = server._make_safe(state, {})
    assert (status, said["problem"].endswith(by_hand)) == (500, True)


def test_no_viewer_waits_for_a_look_at_a_file(tmp_path: Path) -> None:
    shown = BenchWatch(tmp_path)
    held: list[bool] = []

    def look() -> str:
        held.append(shown.lock.locked())
        return ""

    shown._files_problem = look  # type: ignore[method-assign]
    shown.path = tmp_path / "day" / "a_sweep_r001.rigj"
    shown._follow(shown.path)
    shown.poll()
    assert held
    assert not any(held)
