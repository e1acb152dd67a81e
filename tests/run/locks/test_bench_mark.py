"""The mark of a bench outlives its run, its guard and the folder of results."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rig.core.errors import RigError, UnsafeError
from rig.run.locks.bench_mark import (
    BenchMarks,
    ProcessStamp,
    clear_marks,
    made_safe_ns,
    note_made_safe,
    read_marks,
    refuse_unsafe,
)

NAMES = ("generator", "stage")
"""They stand for the names of two addresses."""


@pytest.fixture(autouse=True)
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shared folder of this test's own."""
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    return tmp_path / "shared"


@pytest.fixture
def marks() -> BenchMarks:
    return BenchMarks(NAMES, "bench-3", "/data/run.rigj")


def dead() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_safe_bench_has_no_mark(marks: BenchMarks, shared: Path) -> None:
    marks.running(os.getpid())
    marks.clear()
    assert read_marks(NAMES) == []
    assert list(shared.iterdir()) == []


def test_a_bench_without_shared_instruments_leaves_nothing(shared: Path) -> None:
    own = BenchMarks((), "simulated", None)
    own.running(os.getpid())
    own.unsafe({"daq": "silent"})
    own.clear()
    assert read_marks(()) == []
    assert not shared.exists()


def test_a_run_that_lives_refuses_nothing_by_its_mark(marks: BenchMarks) -> None:
    """Its lock does."""
    marks.running(dead())
    (mark,) = read_marks(NAMES)
    assert mark.lives
    refuse_unsafe([mark], "bench.toml")


def test_a_guard_that_lives_keeps_the_bench(marks: BenchMarks, shared: Path) -> None:
    marks.running(os.getpid())
    (mark,) = read_marks(NAMES)
    assert mark.model_copy(update={"run": ProcessStamp.of(dead())}).lives


def test_run_and_guard_killed_together_refuse_the_bench_for_who_shares_an_instrument(
    marks: BenchMarks,
) -> None:
    marks.running(dead())
    (mark,) = read_marks(["stage", "another bench's daq"])
    killed = mark.model_copy(update={"run": ProcessStamp.of(dead())})
    with pytest.raises(UnsafeError) as refused:
        refuse_unsafe([killed], "here/bench.toml")
    reported = refused.value.one_line()
    assert "the bench bench-3 was left unsafe: the run of " in reported
    assert "was killed together with its guard (run /data/run.rigj)" in reported
    assert "rig make-safe --bench here/bench.toml" in reported


def test_a_process_of_the_same_number_is_not_taken_for_a_dead_one() -> None:
    own = ProcessStamp.of(os.getpid())
    assert own.lives
    assert not own.model_copy(update={"started": "1"}).lives
    assert not own.model_copy(update={"boot": "before the power cut"}).lives
    assert not ProcessStamp.of(dead()).lives


def test_what_could_not_be_made_safe_is_named(marks: BenchMarks) -> None:
    marks.unsafe({"stage_z": "no answer", "generator": "OUTP1 0: refused"})
    with pytest.raises(UnsafeError, match=r"stage_z: no answer; generator: OUTP1 0: refused"):
        refuse_unsafe(read_marks(NAMES), "bench.toml")


def test_a_name_that_is_not_in_the_computers_encoding_does_not_cost_the_mark(shared: Path) -> None:
    """As a folder of results is called whose name was written in another locale."""
    odd = "/data/\udcfc/run.rigj"
    marks = BenchMarks(NAMES, "bench-3", odd)
    marks.running(os.getpid())
    assert [mark.state for mark in read_marks(NAMES)] == ["running"]
    marks.unsafe({"guard": f"{odd}: no report"})
    with pytest.raises(UnsafeError, match=r"/data/.udcfc/run.rigj: no report"):
        refuse_unsafe(read_marks(NAMES), "bench.toml")


def test_what_was_stopped_is_reported_and_refuses_nothing(marks: BenchMarks) -> None:
    marks.running(dead())
    marks.stopped("the guard had to act")
    found = read_marks(NAMES)
    refuse_unsafe(found, "bench.toml")
    assert [mark.in_words().endswith("the guard had to act") for mark in found] == [True]


def garbage(text: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(text)


@pytest.mark.parametrize(
    "leave",
    [
        garbage(b""),
        garbage(b"{}"),
        garbage(b'{"state": "perhaps"}'),
        garbage(b"\xff\xfe"),
        lambda path: path.mkdir(),
        lambda path: path.symlink_to("/dev/zero"),
    ],
    ids=["empty", "no word", "perhaps", "no text", "a folder", "a link"],
)
def test_a_mark_that_cannot_be_understood_refuses_the_bench(
    marks: BenchMarks, shared: Path, leave: Callable[[Path], object]
) -> None:
    marks.clear()
    leave(shared / "stage.mark")
    with pytest.raises(UnsafeError, match=r"stage\.mark cannot be read"):
        refuse_unsafe(read_marks(NAMES), "bench.toml")


def test_a_mark_that_cannot_be_written_is_a_failure_and_the_earlier_one_stays(
    marks: BenchMarks, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks.unsafe({"stage_z": "no answer"})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("rig.run.locks.shared_folder.os.fsync", full)
        with pytest.raises(RigError, match=r"cannot be written .*: No space left") as refused:
            marks.running(os.getpid())
    assert refused.value.code == 3
    (mark,) = read_marks(NAMES)
    assert mark.failures == {"stage_z": "no answer"}
    clear_marks(NAMES)
    assert read_marks(NAMES) == []


def test_a_note_that_a_bench_was_made_safe_is_of_all_its_addresses_and_ends_with_the_next_run(
    shared,
) -> None:
    assert made_safe_ns(NAMES) is None
    assert made_safe_ns(()) is None
    note_made_safe(NAMES[:1])
    assert made_safe_ns(NAMES) is None
    note_made_safe(NAMES)
    first = made_safe_ns(NAMES)
    assert first is not None
    note_made_safe(NAMES[1:])
    assert made_safe_ns(NAMES) == first
    (shared / "stage.made-safe").write_text("no number")
    assert made_safe_ns(NAMES) is None
    note_made_safe(NAMES)
    clear_marks(NAMES)
    assert made_safe_ns(NAMES) is None
    assert list(shared.iterdir()) == []
