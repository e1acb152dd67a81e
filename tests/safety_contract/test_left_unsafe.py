"""A bench that is not left safe says so to the next command, whoever gives it and wherever from."""

from __future__ import annotations

import os
import signal
import time

import pytest
from processes import children_named
from tiers import mostly_nightly

from rig.bench.plan import read_bench
from rig.run.locks.bench_mark import ProcessStamp
from rig.run.locks.lock import address_names

PATIENCE_S = 30.0
MANY = ",".join(str(f) for f in range(300, 6300, 100))
FULL_DISK = """
import errno, os, rig.run.locks.shared_folder as shared
def full(*_): raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
shared.SharedFolder.write = full
"""
"""Python that a command runs first: the disk of the shared folder is full."""


@pytest.fixture
def bench_file(rig):
    """A simulated bench that runs by itself, and the file that drives it."""
    with rig.served() as path:
        yield path


def sweep(bench_file, *more):
    return ("sweep", "--bench", str(bench_file), "--no-figures", "--frequencies", *more)


def test_a_run_whose_mark_cannot_be_written_is_refused_before_anything_is_switched_on(
    rig, bench_file
):
    refused = rig.start(*sweep(bench_file, "210"), before=FULL_DISK).finish()
    assert refused.code == 3, refused.stderr
    (error,) = refused.errors
    assert "the mark that the bench simulated is in use cannot be written" in error
    assert "No space left on device; " in error
    assert rig.outputs() == []
    assert not [entry for entry in rig.log() if entry["what"] in ("move", "homing")]
    assert rig.marks() == []


@pytest.mark.thorough
def test_a_run_and_its_guard_killed_together_are_reported_and_refuse_the_bench(rig, bench_file):
    """As a log-out or a computer without memory does; the generator stays on."""
    running = rig.start(*sweep(bench_file, MANY))
    running.wait_for("^2/60 ")
    kill_together(running)
    assert rig.outputs() == [True]
    names = set(address_names(read_bench(bench_file)))
    assert len(names) >= 4, "each instrument has an address"
    assert {path.stem for path in rig.shared.glob("*.mark")} == names, "one for each address"

    elsewhere = rig.run(*sweep(bench_file, "210", "--results", "elsewhere"))
    assert elsewhere.code == 7, elsewhere.stderr
    (error,) = elsewhere.errors
    assert f"(pid {running.process.pid}) was killed together with its guard (run " in error
    assert ".rigj" in error
    assert f"rig make-safe --bench {bench_file}" in error
    assert rig.outputs() == [True]

    safe = rig.run("make-safe", "--bench", str(bench_file))
    assert safe.code == 0, safe.stderr
    assert "was killed together with its guard" in safe.stderr.splitlines()[0]
    assert rig.outputs() == [True, False]
    assert rig.marks() == []


@pytest.mark.parametrize("moment", mostly_nightly(range(5), [3]))
def test_whenever_both_are_killed_the_next_start_is_refused_until_it_was_made_safe(
    rig, bench_file, moment
):
    """While z homes, travels, approaches, presses, or the film vibrates: each a while after it has
    begun to move, so that the moment is another one in each repetition."""
    running = rig.start(*sweep(bench_file, MANY))
    rig.await_world("homing" if moment == 0 else "move", count=max(1, moment))
    time.sleep(int.from_bytes(os.urandom(2), "big") / 65536 * 0.5)
    kill_together(running)
    results = ("--results", f"elsewhere-{moment}")
    before = len(rig.log())
    refused = rig.run(*sweep(bench_file, "210", *results))
    assert refused.code == 7, refused.stderr
    assert "was killed together with its guard" in refused.errors[0]
    begun = [entry["what"] for entry in rig.log()[before:]]
    assert not {"move", "homing"} & set(begun)
    assert rig.run("make-safe", "--bench", str(bench_file)).code == 0
    again = rig.run(*sweep(bench_file, "210", *results))
    assert again.code == 0, again.stderr
    assert rig.marks() == []


def kill_together(running):
    """Kill a run and its guard."""
    (guard,) = children_named("rig.run.making_safe.guard", running.process.pid)
    running.send(signal.SIGKILL)
    os.kill(guard, signal.SIGKILL)
    running.process.wait()
    deadline = time.monotonic() + PATIENCE_S
    while ProcessStamp.of(guard).lives:
        assert time.monotonic() < deadline
        time.sleep(0.01)
