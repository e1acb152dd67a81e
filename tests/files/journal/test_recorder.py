"""The recorder thread: order, acknowledgement, errors that reach the run."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import recorded_run as run

from rig.core.errors import RigError
from rig.files.errors import JournalMovedError, RecordingError
from rig.files.journal.format import Block
from rig.files.journal.reader import read_journal
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter


@pytest.fixture
def journal(tmp_path: Path) -> JournalWriter:
    return JournalWriter.create(tmp_path / "a.rigj", run.header())


def test_what_is_put_is_there_in_order(journal: JournalWriter) -> None:
    with Recorder(journal) as recorder:
        recorder.put_event(run.event())
        for number in range(5):
            run.take_point(recorder, number, prefix="put_")
        recorder.put_end(run.end())
    contents = read_journal(journal.path)
    assert contents.complete
    assert contents.kept_ids() == list(run.POINTS)
    assert [segment.rows for segment in contents.segments] == [500] * 5


def test_threads_keep_their_own_order(tmp_path: Path) -> None:
    streams = run.header()["streams"]
    streams = [streams[0] | {"name": f"s{k}"} for k in range(4)]
    journal = JournalWriter.create(tmp_path / "a.rigj", run.header(streams=streams))
    recorder = Recorder(journal)

    def put(stream: int) -> None:
        for n in range(300):
            recorder.put_block(stream, n, float(n), np.full((1, 2), n, np.int16))

    threads = [threading.Thread(target=put, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    recorder.close()
    contents = read_journal(journal.path)
    assert [(s.stream, s.rows) for s in sorted(contents.segments, key=lambda s: s.stream)] == [
        (k, 300) for k in range(4)
    ]


def test_a_barrier_means_that_all_before_it_is_on_the_disk(journal: JournalWriter) -> None:
    recorder = Recorder(journal)
    for n in range(20):
        recorder.put_block(0, 10 * n, 0.1 * n, run.samples(n, 10))
        recorder.barrier()
        contents = read_journal(journal.path)
        assert sum(s.rows for s in contents.segments) == 10 * (n + 1)
        assert journal.acknowledged_bytes == contents.end_offset
    recorder.close()


def test_without_a_barrier_it_is_acknowledged_soon(journal: JournalWriter) -> None:
    recorder, before = Recorder(journal), journal.acknowledged_bytes
    recorder.put_event(run.event())
    deadline = time.monotonic() + 10
    while journal.acknowledged_bytes == before:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert len(read_journal(journal.path).events) == 1
    recorder.close()


def test_it_is_known_for_how_long_the_disk_has_taken_nothing(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    sync = journal.sync

    def sync_on_a_stalled_disk() -> None:
        assert answers.wait(30)
        sync()

    monkeypatch.setattr(journal, "sync", sync_on_a_stalled_disk)
    with Recorder(journal) as recorder:
        assert recorder.unacknowledged_s == 0
        begun_s = time.monotonic()
        recorder.put_event(run.event())
        time.sleep(0.2)
        recorder.put_event(run.event())
        assert 0.2 <= recorder.unacknowledged_s <= time.monotonic() - begun_s
        answers.set()
        recorder.barrier()
        assert recorder.unacknowledged_s == 0


def test_the_caller_may_reuse_its_buffer(journal: JournalWriter) -> None:
    recorder, data, reading = Recorder(journal), np.ones((4, 2), np.int16), {"gain_dB": 1.0}
    recorder.put_point_begin("p", {})
    recorder.put_block(0, 0, 0.0, data)
    recorder.put_point_keep("p", reading)
    data[:] = 7
    reading["gain_dB"] = 7.0
    recorder.close()
    contents = read_journal(journal.path)
    (block,) = [record for record in contents.records() if isinstance(record, Block)]
    assert bytes(block.data) == np.ones((4, 2), np.int16).tobytes()
    assert contents.kept()[0].reading == {"gain_dB": 1.0}


def test_the_threads_first_error_is_raised_everywhere(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(records: object) -> None:
        raise ZeroDivisionError("the first cause")

    recorder = Recorder(journal)
    monkeypatch.setattr(journal, "append", broken)
    recorder.put_event(run.event())
    for act in (
        recorder.barrier,
        recorder.check,
        lambda: recorder.put_event(run.event()),
        recorder.close,
    ):
        with pytest.raises(ZeroDivisionError, match="the first cause"):
            act()
    recorder.close()


def test_a_limit_on_the_size_of_files_is_not_taken_for_a_full_disk(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_large(*_: object) -> int:
        raise OSError(errno.EFBIG, "File too large")

    monkeypatch.setattr(os, "writev", too_large)
    with pytest.raises(RecordingError, match="File too large") as caught:
        journal.append([b"x"])
    assert "ulimit -f" in str(caught.value.hint)
    assert "free space" not in str(caught.value.hint)


def test_a_refused_put_harms_nothing(journal: JournalWriter) -> None:
    with Recorder(journal) as recorder:
        with pytest.raises(RigError, match="not the open point"):
            recorder.put_point_keep("p", {})
        recorder.put_event(run.event())
    assert len(read_journal(journal.path).events) == 1


def test_a_disk_that_is_too_slow_is_an_error_not_a_wait(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, append = threading.Event(), journal.append
    monkeypatch.setattr(journal, "append", lambda records: (stuck.wait(30), append(records)))
    recorder = Recorder(journal, max_queued_bytes=1 << 20)
    n = 0

    def put_for_ever() -> None:
        nonlocal n
        for n in range(1000):
            recorder.put_block(0, 5000 * n, 0.0, run.samples(0, 5000))

    with pytest.raises(RecordingError, match="the disk is too slow") as caught:
        put_for_ever()
    stuck.set()
    assert str(journal.path) in caught.value.message
    with pytest.raises(RecordingError, match="the disk is too slow"):
        recorder.close()
    assert sum(s.rows for s in read_journal(journal.path).segments) == 5000 * (n + 1)


def test_an_error_of_the_run_is_not_hidden_by_the_recorders(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> None:
        raise OSError("later")

    monkeypatch.setattr(journal, "sync", broken)

    def fail() -> None:
        with Recorder(journal) as recorder:
            recorder.put_event(run.event())
            raise KeyError("first")

    with pytest.raises(KeyError, match="first"):
        fail()


def test_put_after_close_is_refused(journal: JournalWriter) -> None:
    recorder = Recorder(journal)
    recorder.close()
    with pytest.raises(RecordingError, match="closed"):
        recorder.put_event(run.event())


def _delete(path: Path) -> None:
    path.unlink()


def _move(path: Path) -> None:
    path.rename(path.with_suffix(".away"))


def _replace(path: Path) -> None:
    path.unlink()
    path.write_text("another file")


@pytest.mark.parametrize(
    ("lose", "cause"), [(_delete, "deleted"), (_move, "moved"), (_replace, "replaced")]
)
def test_a_journal_that_loses_its_name_continues_at_another_path(
    journal: JournalWriter, lose: Callable[[Path], None], cause: str
) -> None:
    recorder = Recorder(journal)
    run.take_point(recorder, 0, prefix="put_")
    recorder.barrier()
    lose(journal.path)
    run.take_point(recorder, 1, prefix="put_")
    with pytest.raises(JournalMovedError, match=cause) as raised:
        recorder.barrier()
    run.take_point(recorder, 2, prefix="put_")
    recorder.put_end(run.end())
    recorder.close()
    assert raised.value.now_at == journal.path
    assert read_journal(journal.path).kept_ids() == list(run.POINTS[:3])


def test_what_is_put_when_the_journal_has_moved_is_recorded_before_that_is_raised(
    journal: JournalWriter,
) -> None:
    recorder = Recorder(journal)
    _move(journal.path)
    recorder.put_event(run.event(message="first"))
    while recorder._moved is None:
        time.sleep(0.01)
    recorder.put_event(run.event(message="second"))
    with pytest.raises(JournalMovedError):
        recorder.check()
    recorder.check()
    recorder.close()
    assert [one.message for one in read_journal(journal.path).events] == ["first", "second"]


def test_a_journal_that_finds_no_other_place_is_the_runs_failure(
    journal: JournalWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.files.journal.writer._refuges", lambda lost: [Path("/dev/null/a")])
    recorder = Recorder(journal)
    journal.path.unlink()
    recorder.put_event(run.event())
    with pytest.raises(RecordingError, match="was deleted; no copy of it could be made"):
        recorder.barrier()
    with pytest.raises(RecordingError, match="was deleted"):
        recorder.close()
