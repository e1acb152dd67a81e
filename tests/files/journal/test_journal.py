"""The journal: what is written comes back exactly, and whatever happens to the file is survived."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import math
import os
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import recorded_run as run
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.core.errors import RigError
from rig.files.errors import JournalError, RecordingError
from rig.files.journal.format import (
    MAGIC,
    Block,
    RecordKind,
    frame,
    from_json,
    json_record,
    to_json,
)
from rig.files.journal.reader import read_journal
from rig.files.journal.values import JournalEvent, RunHeader
from rig.files.journal.writer import JournalWriter, begin_journal
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text().filter(lambda k: k != "$float"), inner, max_size=4)
    ),
    max_leaves=12,
)


def same(a: object, b: object) -> bool:
    """Equal, types and NaN and the sign of zero included."""
    return repr(a) == repr(b)


@given(JSON_VALUES)
def test_json_round_trips_every_value_and_every_float(value: object) -> None:
    text = to_json(value)
    assert text.isascii()
    assert same(from_json(text), value)
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_numpy_scalars_and_arrays_are_readings() -> None:
    value = {"a": np.float32(0.5), "b": np.int64(3), "c": np.array([1.0, math.nan]), "d": np.True_}
    assert same(from_json(to_json(value)), {"a": 0.5, "b": 3, "c": [1.0, math.nan], "d": True})
    with pytest.raises(TypeError, match="complex"):
        to_json({"phasor": 1j})


blocks = st.lists(
    st.tuples(st.integers(0, 2**62), st.floats(0, 1e6), st.integers(1, 50), st.integers(0, 2**31)),
    max_size=8,
)


@settings(max_examples=15, deadline=None)
@given(blocks=blocks, readings=st.lists(st.dictionaries(st.text(), JSON_VALUES), max_size=5))
def test_a_journal_gives_back_what_was_written(
    tmp_path_factory: pytest.TempPathFactory, blocks: list, readings: list
) -> None:
    path = tmp_path_factory.mktemp("j") / "run.rigj"
    rows = [run.samples(seed, count) for _, _, count, seed in blocks]
    with JournalWriter.create(path, run.header(points=[])) as journal:
        for (first, time, _, _), data in zip(blocks, rows, strict=True):
            journal.block(0, first, time, data)
        for n, reading in enumerate(readings):
            journal.point_begin(f"p{n}", {})
            journal.point_keep(f"p{n}", reading)
        journal.sync()
        assert journal.acknowledged_bytes == path.stat().st_size
    contents = read_journal(path)
    assert contents.problem is None
    found = [record for record in contents.records() if isinstance(record, Block)]
    assert [(b.first_index, b.host_time, bytes(b.data)) for b in found] == [
        (first, time, data.tobytes())
        for (first, time, _, _), data in zip(blocks, rows, strict=True)
    ]
    assert same([point.reading for point in contents.kept()], readings)


def test_a_block_longer_than_a_record_is_split_and_stays_whole(tmp_path: Path) -> None:
    data = np.zeros((5_000_000, 2), np.int16)
    data[:, 0] = np.arange(len(data)) % 30000
    with JournalWriter.create(tmp_path / "a.rigj", run.header()) as journal:
        journal.block(0, 100, 0.0, data)
    contents = read_journal(tmp_path / "a.rigj")
    assert [(s.first_index, s.rows) for s in contents.segments] == [(100, 5_000_000)]


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (lambda j: j.point_keep("p", {}), "not the open point"),
        (lambda j: j.point_begin(run.POINTS[0], {}), "still open"),
        (lambda j: j.block(1, 0, 0.0, bytes(4)), "stream 1 of 1"),
        (lambda j: j.block(0, 0, 0.0, bytes(5)), "not whole rows"),
        (lambda j: j.block(0, 0, 0.0, np.zeros((4, 2))), "expected rows of <i2"),
        (lambda j: j.block(0, 0, 0.0, np.zeros(4, np.int16)), "need 2 channels"),
        (lambda j: j.block(0, 0, math.nan, bytes(4)), "host_time"),
        (lambda j: j.event({"time": 0.0, "level": "info"}), "code: missing"),
        (lambda j: j.stream(run.state(scale=[1.0])), "2 channels"),
        (lambda j: j.end({"status": "fine"}), "status = 'fine'"),
        (lambda j: j.point_keep(run.POINTS[0], {"x": 1j}), "complex"),
    ],
)
def test_nonsense_is_refused_and_the_journal_continues(tmp_path: Path, act, reason: str) -> None:
    path = tmp_path / "a.rigj"
    with JournalWriter.create(path, run.header()) as journal:
        journal.point_begin(run.POINTS[0], {})
        with pytest.raises(RigError, match=reason) as caught:
            act(journal)
        assert str(path) in caught.value.message
        journal.point_keep(run.POINTS[0], {"x": 1.0})
    assert read_journal(path).kept_ids() == [run.POINTS[0]]


def test_a_second_writer_and_a_second_journal_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.rigj"
    with JournalWriter.create(path, run.header()):
        with pytest.raises(FileExistsError):
            JournalWriter.create(path, run.header())
        with pytest.raises(JournalError, match="another process is using"):
            JournalWriter.reopen(path)
        with pytest.raises(JournalError, match="another process is using"):
            compile_run(path)


def test_too_many_open_files_are_not_blamed_on_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(RecordingError, match="here: Too many open files") as raised:
        begin_journal(tmp_path, "sweep", run.header())
    assert raised.value.hint == "raise the limit on open files (ulimit -n)"


def test_a_share_that_locks_nothing_is_named_and_no_empty_journal_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = run.write_run(tmp_path / "a.rigj")

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(RecordingError, match=r"b\.rigj: it cannot be locked: No locks") as raised:
        JournalWriter.create(tmp_path / "b.rigj", run.header())
    assert "a file system that locks files" in str(raised.value.hint)
    assert not (tmp_path / "b.rigj").exists()
    with pytest.raises(JournalError, match=r"a\.rigj: it cannot be locked: No locks"):
        JournalWriter.reopen(earlier)


def test_a_new_journal_that_another_program_locks_at_once_is_not_blamed_on_the_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise BlockingIOError(errno.EWOULDBLOCK, "Resource temporarily unavailable")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(RecordingError, match="another process is using this journal") as raised:
        JournalWriter.create(tmp_path / "b.rigj", run.header())
    assert "file system" not in str(raised.value.hint)
    assert not (tmp_path / "b.rigj").exists()


@pytest.mark.parametrize(
    ("changes", "finding"),
    [
        ({"format": 2}, "format"),
        ({"colour": "red"}, "colour: unknown key"),
        ({"points": ["a", "a"]}, "points: two of one name"),
        ({"start_time": "2026-11-21T22:00:00"}, "offset from UTC"),
        ({"simulated": False}, "an instrument is simulated"),
        ({"layout": {"definition": "x"}}, "layout"),
    ],
)
def test_a_wrong_header_is_refused_before_the_file_exists(
    tmp_path: Path, changes: dict, finding: str
) -> None:
    with pytest.raises(JournalError, match=finding):
        JournalWriter.create(tmp_path / "a.rigj", run.header(**changes))
    assert list(tmp_path.iterdir()) == []


# Resuming


def test_resume_continues_and_counts_every_point_once(tmp_path: Path) -> None:
    path = tmp_path / "a.rigj"
    with JournalWriter.create(path, run.header()) as journal:
        run.take_point(journal, 0)
        journal.point_begin(run.POINTS[1], {})
        journal.block(0, 0, 1.1, run.samples(50))
    with path.open("ab") as file:
        file.write(frame(bytes((RecordKind.EVENT,)) + b'{"time":')[:-3])  # a torn record
    before = read_journal(path)
    assert before.torn
    assert before.problem is not None
    assert before.problem.startswith(f"bad record at byte {before.end_offset}: torn")

    with JournalWriter.reopen(path) as journal:
        with pytest.raises(RigError, match="recorded already"):
            journal.point_begin(run.POINTS[0], {})
        run.take_point(journal, 1)
        journal.end(run.end("stopped", 2, attempt=2))
        journal.sync()
    contents = read_journal(path)
    assert contents.problem is None
    assert contents.kept_ids() == list(run.POINTS[:2])
    assert [(a.id, a.status) for a in contents.attempts] == [
        (run.POINTS[0], "kept"),
        (run.POINTS[1], "discarded"),
        (run.POINTS[1], "kept"),
    ]
    assert contents.end is not None
    assert contents.end.attempt == 2


def test_a_point_kept_twice_in_a_journal_counts_once(tmp_path: Path) -> None:
    path = run.write_run(tmp_path / "a.rigj", order=(0,))
    with path.open("ab") as file:
        file.write(
            json_record(RecordKind.POINT_KEEP, {"id": run.POINTS[0], "reading": {"gain_dB": 99}})
        )
    contents = read_journal(path)
    assert [point.reading["gain_dB"] for point in contents.kept()] == [-20.0]
    assert contents.attempts[-1].status == "discarded"
    (no_begin, twice) = verify(path)
    assert no_begin == f"point {run.POINTS[0]}: its end is recorded (discarded), but no begin"
    assert twice == f"point {run.POINTS[0]}: recorded twice"


def test_a_journal_whose_end_states_other_points_than_are_recorded_is_not_sound(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.rigj"
    with JournalWriter.create(path, run.header()) as journal:
        run.take_point(journal, 0)
        journal.end(run.end(points=3))
    assert verify(path) == ["its end states 3 points, 1 are recorded"]


def test_reopen_refuses_to_cut_off_sound_records(tmp_path: Path) -> None:
    path = run.write_run(tmp_path / "a.rigj")
    data = bytearray(path.read_bytes())
    data[6000] ^= 1
    path.write_bytes(data)
    with pytest.raises(JournalError, match="sound records follow") as caught:
        JournalWriter.reopen(path)
    assert caught.value.hint
    assert path.read_bytes() == data


# Damage


def test_every_prefix_keeps_every_acknowledged_sample(tmp_path: Path) -> None:
    """Cut the file anywhere: what was acknowledged before that byte is still there."""
    path = tmp_path / "a.rigj"
    acknowledged, rows, boundaries = [(0, 0, 0)], 0, []
    with JournalWriter.create(path, run.header()) as journal:
        first = journal.size
        for number in range(2):
            journal.point_begin(run.POINTS[number], {})
            for k in range(2):
                journal.block(0, 6 * k, number + 0.1 * k, run.samples(number, 6))
                rows += 6
                boundaries.append(journal.size)
                journal.sync()
                acknowledged.append((journal.acknowledged_bytes, rows, number))
            journal.point_keep(run.POINTS[number], run.reading(number))
            journal.sync()
            acknowledged.append((journal.acknowledged_bytes, rows, number + 1))
    data = path.read_bytes()
    cut = tmp_path / "cut.rigj"
    for size in range(first, len(data) + 1):
        cut.write_bytes(data[:size])
        contents = read_journal(cut)
        _, least_rows, least_points = max(a for a in acknowledged if a[0] <= size)
        assert sum(s.rows for s in contents.segments) >= least_rows
        assert len(contents.kept_ids()) >= least_points
        assert (contents.problem is None) == (contents.end_offset == size)
        assert contents.torn or contents.problem is None
    for size in (*boundaries, boundaries[1] - 1, boundaries[3] + 7):
        cut.write_bytes(data[:size])
        _, least_rows, _ = max(a for a in acknowledged if a[0] <= size)
        with RunFile.open(compile_run(cut)) as file:  # compiling compares every sample
            waves = [
                w for s in ("kept", "discarded", "unfinished") for w in file.waveforms(None, s)
            ]
            assert sum(len(w.counts["strip_a"]) for w in waves) >= least_rows
            assert file.outcome.status == "failed"


def test_a_journal_without_a_header_says_so(tmp_path: Path) -> None:
    whole = run.write_run(tmp_path / "a.rigj", order=(0,)).read_bytes()
    with JournalWriter.create(tmp_path / "h.rigj", run.header()) as journal:
        first = journal.size
    cut = tmp_path / "cut.rigj"
    for size in (0, 1, 7, 8, 9, 15, 16, 17, 500, first - 1):
        cut.write_bytes(whole[:size])
        with pytest.raises(JournalError, match=r"byte (0|8): ") as caught:
            read_journal(cut)
        assert str(cut) in caught.value.message


@settings(max_examples=40, deadline=None)
@given(place=st.floats(0, 1), mask=st.integers(1, 255))
def test_a_flipped_byte_is_noticed_and_nothing_false_is_read(
    tmp_path_factory: pytest.TempPathFactory, place: float, mask: int
) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = folder / "whole.rigj"
    if not whole.exists():
        run.write_run(whole, order=(0, 1))
    data = bytearray(whole.read_bytes())
    at = min(int(place * len(data)), len(data) - 1)
    data[at] ^= mask
    damaged = folder / "damaged.rigj"
    damaged.write_bytes(data)
    with contextlib.suppress(JournalError):  # its header is damaged
        contents = read_journal(damaged)
        assert contents.problem is not None
        assert contents.end_offset <= at
        originals = list(read_journal(whole).records())
        found = list(contents.records())
        assert found == originals[: len(found)]
        return
    assert at < header_end(whole)


def header_end(path: Path) -> int:
    """Where the header's record ends."""
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        return len(MAGIC) + 8 + int(struct.unpack("<I", file.read(4))[0])


HEADER = json_record(RecordKind.HEADER, RunHeader.model_validate(run.header()))


def raw(kind: int, body: bytes) -> bytes:
    return frame(bytes((kind,)) + body)


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (struct.pack("<II", 0, 0), "length 0"),
        (struct.pack("<II", 0xFFFFFFFF, 0), "length 4294967295"),
        (struct.pack("<II", 16 << 20, 0) + b"x", "torn"),
        (struct.pack("<II", 1, zlib.crc32(b"\x63")) + b"\x63", "unknown record type 99"),
        (HEADER, "a second HEADER"),
        (raw(RecordKind.EVENT, b"[" * 3_000_000), "not JSON"),
        (raw(RecordKind.EVENT, b'{"a":' * 500_000), "not JSON"),
        (raw(RecordKind.EVENT, b'{"time": NaN}'), "NaN is not JSON"),
        (raw(RecordKind.EVENT, b'{"time": ' + b"9" * 5000 + b"}"), "not JSON"),
        (raw(RecordKind.EVENT, b"\xff\xfe"), "not UTF-8"),
        (raw(RecordKind.EVENT, b"[]"), "not a JSON object"),
        (raw(RecordKind.EVENT, b" " * (5 << 20)), "bytes of JSON"),
        (raw(RecordKind.EVENT, b'{"$float": "nan"}'), "not a JSON object"),
        (raw(RecordKind.EVENT, b'{"$float": 3}'), "not JSON"),
        (raw(RecordKind.POINT_BEGIN, b'{"id": 3}'), "id is not a text"),
        (raw(RecordKind.POINT_KEEP, b'{"id": "a", "reading": 3}'), "wrong type"),
        (raw(RecordKind.POINT_DISCARD, b'{"id": "a", "reason": {}}'), "wrong type"),
        (raw(RecordKind.END, b'{"status": "complete"}'), "missing"),
        (raw(RecordKind.STREAM, b'{"stream": 9, "scale": [], "offset": []}'), "stream 9 of 1"),
        (raw(RecordKind.BLOCK, b"123"), "too short"),
        (raw(RecordKind.BLOCK, struct.pack("<HQd", 9, 0, 0.0) + bytes(4)), "stream 9 of 1"),
        (raw(RecordKind.BLOCK, struct.pack("<HQd", 0, 2**64 - 1, 0.0) + bytes(4)), "out of range"),
        (raw(RecordKind.BLOCK, struct.pack("<HQd", 0, 0, math.inf) + bytes(4)), "not finite"),
    ],
)
def test_a_hostile_record_is_named_and_what_is_before_it_is_kept(
    tmp_path: Path, record: bytes, reason: str
) -> None:
    path = tmp_path / "a.rigj"
    good = json_record(RecordKind.EVENT, JournalEvent(**run.event()))
    path.write_bytes(MAGIC + HEADER + good + record)
    contents = read_journal(path)
    assert contents.problem is not None
    at = len(MAGIC) + len(HEADER) + len(good)
    assert contents.problem.startswith(f"bad record at byte {at}: ")
    assert reason in contents.problem
    assert len(contents.events) == 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"RIG",
        b"hello world",
        MAGIC + raw(RecordKind.EVENT, b"{}"),
        MAGIC + raw(RecordKind.HEADER, b"{}"),
        MAGIC + raw(RecordKind.HEADER, b"[" * 1_000_000),
        MAGIC + raw(RecordKind.BLOCK, bytes(40)),
    ],
)
def test_what_is_no_journal_is_a_journal_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.rigj"
    path.write_bytes(content)
    for act in (read_journal, JournalWriter.reopen, compile_run):
        with pytest.raises(JournalError, match=r"a\.rigj"):
            act(path)
    assert path.read_bytes() == content


def test_settings_nested_deeper_than_sense_are_refused(tmp_path: Path) -> None:
    deep: dict = {}
    for _ in range(100):
        deep = {"a": deep}
    with pytest.raises(JournalError, match="nested deeper"):
        JournalWriter.create(tmp_path / "a.rigj", run.header(settings=deep))


@pytest.mark.parametrize("tail", [bytes(4096), b"\xff" * 4096, os.urandom(4096)])
def test_a_torn_end_of_zeros_or_garbage_is_cut_off_on_resume(tmp_path: Path, tail: bytes) -> None:
    path = run.write_run(tmp_path / "a.rigj", order=(0, 1))
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(tail)
    JournalWriter.reopen(path).close()
    assert path.stat().st_size == size


# Kills and full disks


def kill_a_writer(path: Path, lines: int) -> int:
    """Start a writer, kill -9 it after so many acknowledgements; the rows it knew were safe."""
    with run.start_writer(path) as process:
        assert process.stdout is not None
        heard = [process.stdout.readline() for _ in range(lines)]
        process.send_signal(signal.SIGKILL)
        heard += process.stdout.readlines()
    return max(int(line) for line in heard if line.endswith("\n"))


@pytest.mark.parametrize("lines", [1, 17, 40])
def test_kill_9_loses_no_acknowledged_sample(tmp_path: Path, lines: int) -> None:
    path = tmp_path / "a.rigj"
    acknowledged = kill_a_writer(path, lines)
    with RunFile.open(compile_run(path)) as file:
        (wave,) = file.waveforms(status="unfinished")
        counts = wave.counts["strip_a"]
        assert len(counts) >= acknowledged > 0
        for n in range(acknowledged // 100):
            part = counts[100 * n : 100 * (n + 1)]
            np.testing.assert_array_equal(part, run.samples(n % 7, 100)[:, 0])
    assert path.exists()


FULL = """
import resource, sys
sys.path.insert(0, sys.argv[2])
import recorded_run as run
from rig.core.errors import RigError
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter
recorder = Recorder(JournalWriter.create(sys.argv[1], run.header()))
recorder.put_block(0, 0, 0.0, run.samples(0, 1000))
recorder.barrier()
resource.setrlimit(resource.RLIMIT_FSIZE, (10000, 10000))
try:
    for n in range(1, 10**6):
        recorder.put_block(0, 1000 * n, 0.0, run.samples(0, 1000))
        recorder.barrier()
except RigError as error:
    print(error.one_line())
try:
    recorder.put_event(run.event())
except RigError as again:
    print(again.one_line())
try:
    recorder.close()
except RigError as again:
    print(again.one_line())
"""


def test_a_full_disk_is_an_error_with_path_and_remedy_and_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.rigj"
    command = [sys.executable, "-c", FULL, str(path), str(Path(run.__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    assert len(set(lines)) == 1
    assert str(path) in lines[0]
    assert "File too large" in lines[0]
    assert "rig recover" in lines[0]
    assert sum(s.rows for s in read_journal(path).segments) >= 1000


def test_a_journal_that_finds_no_room_for_its_beginning_names_no_journal_to_recover(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int, parts: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "writev", full)
    with pytest.raises(RecordingError) as caught:
        JournalWriter.create(tmp_path / "a.rigj", run.header())
    assert "No space left on device; free space" in caught.value.one_line()
    assert caught.value.one_line().endswith("; nothing was recorded")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_a_recording_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        JournalWriter.create(tmp_path / "none" / "a.rigj", run.header())
