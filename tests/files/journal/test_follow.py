"""Following a journal: whatever is there of it, its records come in order and once."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
import recorded_run as run
from hypothesis import given
from hypothesis import strategies as st

from rig.files.errors import JournalError
from rig.files.journal.follow import JournalTail, follow
from rig.files.journal.format import Block
from rig.files.journal.reader import read_journal
from rig.files.journal.values import End, RunHeader
from rig.files.journal.writer import JournalWriter

PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return run.write_run(tmp_path_factory.mktemp("follow") / "whole.rigj").read_bytes()


def shown(records: list[object]) -> list[str]:
    """Records as texts, the samples included."""
    return [
        f"{r.stream} {r.first_index} {r.host_time} {bytes(r.data)!r}"
        if isinstance(r, Block)
        else repr(r)
        for r in records
    ]


def read(path: Path, most_bytes: int = 8 << 20) -> list[object]:
    found: list[object] = []
    with JournalTail(path) as tail:
        while records := tail.poll(most_bytes):
            found += records
    return found


@given(parts=st.lists(st.floats(0, 1), min_size=1, max_size=6), most_bytes=st.integers(1, 5000))
def test_any_prefix_of_a_journal_yields_a_prefix_of_its_records(
    tmp_path_factory, parts, most_bytes
):
    path = run.write_run(tmp_path_factory.mktemp("prefix") / "a.rigj")
    journal = path.read_bytes()
    whole = shown(read(path, most_bytes))
    assert len(whole) == 1 + len(list(read_journal(path).records()))
    cuts = sorted(round(part * len(journal)) for part in parts)
    path.write_bytes(b"")
    found: list[str] = []
    with JournalTail(path) as tail, path.open("ab") as file:
        for end in cuts:
            file.write(journal[file.tell() : end])
            file.flush()
            while records := tail.poll():
                found += shown(records)
            assert found == whole[: len(found)]
        file.write(journal[file.tell() :])
        file.flush()
        while records := tail.poll():
            found += shown(records)
        assert (found, tail.ended, tail.problem) == (whole, True, None)


def test_a_journal_is_followed_while_a_run_writes_it_until_the_run_is_killed(tmp_path):
    path = tmp_path / "a.rigj"
    writer = run.start_writer(path)
    give_up = time.monotonic() + PATIENCE_S

    def go_on() -> bool:
        time.sleep(0.01)
        return writer.poll() is None and time.monotonic() < give_up

    rows = 0
    acknowledged = 0
    for record in follow(path, go_on):
        if isinstance(record, Block):
            assert record.first_index == rows
            rows += 100
        if rows == 5000:
            assert writer.stdout is not None
            acknowledged = int(writer.stdout.readline())
            os.kill(writer.pid, signal.SIGKILL)
            writer.wait()
    assert rows >= max(5000, acknowledged)
    assert rows == sum(len(r.data) // 4 for r in read(path) if isinstance(r, Block))


def test_a_torn_end_is_named_and_the_resumed_run_is_followed_behind_it(tmp_path, journal):
    path = tmp_path / "a.rigj"
    whole = read_journal(run.write_run(tmp_path / "b.rigj"))
    path.write_bytes(journal + b"\x09\0\0\0torn and wrong")
    with JournalTail(path) as tail:
        before = tail.poll()
        assert isinstance(before[-1], End)
        assert "checksum" in (tail.problem or "")
        assert tail.poll() == []
        with JournalWriter.reopen(path) as resumed:
            resumed.event(run.event(9.0, "continued"))
            resumed.sync()
            (event,) = tail.poll()
        assert "continued" in repr(event)
        assert (tail.problem, tail.ended) == (None, False)
    assert whole.problem is None


@pytest.mark.parametrize("how", ["cut", "replaced"])
def test_a_journal_that_is_cut_or_replaced_under_its_reader_is_an_error(tmp_path, journal, how):
    path = tmp_path / "a.rigj"
    path.write_bytes(journal)
    with JournalTail(path) as tail:
        tail.poll()
        if how == "cut":
            os.truncate(path, len(journal) // 2)
        else:
            path.unlink()
            path.write_bytes(journal)
        with pytest.raises(JournalError, match=r"cut to|replaced"):
            tail.poll()


def test_a_deleted_journal_is_read_to_its_end(tmp_path, journal):
    path = tmp_path / "a.rigj"
    path.write_bytes(journal)
    with JournalTail(path) as tail:
        (header,) = tail.poll(1)
        assert isinstance(header, RunHeader)
        path.unlink()
        assert isinstance(tail.poll()[-1], End)
        assert tail.deleted


def test_nonsense_is_no_journal_and_a_pipe_is_not_waited_for(tmp_path):
    (tmp_path / "a.rigj").write_bytes(b"GIF89a, a picture")
    os.mkfifo(tmp_path / "b.rigj")
    for name in ("a.rigj", "b.rigj"):
        with pytest.raises(JournalError, match="not a"), JournalTail(tmp_path / name) as tail:
            tail.poll()
    assert list(follow(tmp_path / "none.rigj", lambda: False)) == []
