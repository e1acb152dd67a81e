"""Journals and run files from strangers: an error in a sentence, never a crash, a hang, a blow-up
of memory or a file where none belongs."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import recorded_run as run
from hostile import HEADER, damaged, journals, json_record
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.core.errors import RigError
from rig.files.checksum import sha256_of
from rig.files.describe import describe
from rig.files.errors import RunFileError
from rig.files.journal.format import MAGIC, RecordKind
from rig.files.journal.reader import read_journal
from rig.files.naming import results_folder_of
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import recover
from rig.files.verify import verify, verify_in_child

FEW = settings(
    max_examples=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def recovered_or_refused(folder: Path, journal: bytes) -> None:
    """A journal is compiled into a sound file or refused in a sentence; nothing else appears."""
    path = folder / "given.rigj"
    path.write_bytes(journal)
    line = refusal(path)
    names = {p.name for p in folder.iterdir()}
    if line:
        assert str(path) in line
        assert len(line) < 2000
        assert names == {path.name}
        return
    assert names <= {"given.rigj", "given.h5", "given.h5.sha256"}
    assert verify(folder / "given.h5") == []
    with RunFile.open(folder / "given.h5") as opened:
        assert opened.outcome.points_done == len(opened.readings())


def refusal(journal: Path) -> str:
    """Why a journal is not recovered; empty where it is."""
    try:
        recover(journal)
    except RigError as error:
        return error.one_line()
    return ""


@FEW
@given(journal=journals())
def test_a_journal_of_a_stranger(tmp_path_factory: pytest.TempPathFactory, journal: bytes) -> None:
    recovered_or_refused(tmp_path_factory.mktemp("journal"), journal)


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"settings": {str(k): 0 for k in range(20_000)}}, "more than 10000 keys"),
        ({"instruments": HEADER["instruments"] * 100}, "instruments"),
        ({"layout": HEADER["layout"] | {"columns": HEADER["layout"]["columns"] * 90}}, "columns"),
        ({"start_time": "9999-12-31T23:59:59+00:00"}, "the year 9999"),
        ({"procedure": "../../sweep"}, "procedure"),
        ({"title": "x" * 2000}, "title"),
        ({f"key {k}": 0 for k in range(1000)}, "and 980 more"),
    ],
)
def test_a_header_beyond_sense_is_refused_before_anything_is_made_of_it(
    tmp_path: Path, changes: dict[str, Any], reported: str
) -> None:
    path = tmp_path / "a.rigj"
    path.write_bytes(MAGIC + json_record(RecordKind.HEADER, HEADER | changes))
    with pytest.raises(RigError, match=reported) as caught:
        recover(path)
    assert len(caught.value.one_line()) < 3000


def test_many_names_that_look_alike_are_distinguished(tmp_path: Path) -> None:
    """Names that HDF5 takes are ASCII: of these nothing is left, and each gets a number."""
    odd = {chr(0x4E00 + k): k for k in range(600)}
    path = run.write_run(tmp_path / "a.rigj", order=(0,), settings=odd)
    with h5py.File(compile_run(path)) as file:
        parameters = file["entry/parameters"]
        assert sorted(int(parameters[name][()]) for name in parameters) == list(range(600))


def test_a_pipe_is_no_journal(tmp_path: Path) -> None:
    pipe = tmp_path / "a.rigj"
    os.mkfifo(pipe)
    for act in (read_journal, recover, compile_run):
        with pytest.raises(RigError, match="not a regular file"):
            act(pipe)


def test_a_journal_anywhere_has_its_own_folder_for_results(tmp_path: Path) -> None:
    """So that resuming a copy writes nothing above it."""
    assert results_folder_of(tmp_path / "r" / "2026-11-21" / "a.rigj") == tmp_path / "r"
    assert results_folder_of(tmp_path / "a.rigj") == tmp_path


# --- run files -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A run file of two points."""
    journal = run.write_run(tmp_path_factory.mktemp("sound") / "a.rigj", order=(0, 1))
    return compile_run(journal).read_bytes()


def external(opened: h5py.File) -> None:
    del opened["entry/points/id"]
    opened["entry/points/id"] = h5py.ExternalLink("/etc/passwd", "/")


def soft(opened: h5py.File) -> None:
    del opened["entry/outcome"]
    opened["entry/outcome"] = h5py.SoftLink("/entry")


def outside(opened: h5py.File) -> None:
    del opened["entry/points/gain"]
    opened["entry/points"].create_dataset("gain", (2,), "f8", external=[("/etc/passwd", 0, 16)])


def virtual(opened: h5py.File) -> None:
    del opened["entry/points/gain"]
    layout = h5py.VirtualLayout((2,), "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (2,))
    opened["entry/points"].create_virtual_dataset("gain", layout)


def huge(opened: h5py.File) -> None:
    del opened["entry/points/gain"]
    opened["entry/points"].create_dataset("gain", (2**45,), "f8", chunks=(1024,))


def huge_in_one_piece(opened: h5py.File) -> None:
    del opened["entry/points/gain"]
    opened["entry/points"].create_dataset("gain", (2**40,), "f8")


def huge_chunk(opened: h5py.File) -> None:
    del opened["entry/points/gain"]
    made = opened["entry/points"].create_dataset(
        "gain", (2**26,), "f8", chunks=(2**26,), compression="gzip"
    )
    made.id.write_direct_chunk((0,), b"x" * 2**20)


def many_texts(opened: h5py.File) -> None:
    del opened["entry/points/id"]
    opened["entry/points"].create_dataset("id", (2**40,), h5py.string_dtype(), chunks=(64,))


def numbers_for_text(opened: h5py.File) -> None:
    del opened["entry/points/id"]
    opened["entry/points/id"] = np.arange(3)


def group_for_number(opened: h5py.File) -> None:
    del opened["entry/outcome/seed"]
    opened.create_group("entry/outcome/seed")


def endless(opened: h5py.File) -> None:
    opened["entry/points/again"] = opened["entry"]
    del opened["entry/points/id"]
    opened["entry/points/id"] = opened["entry"]


SPOILING = [
    *(external, soft, outside, virtual, huge, huge_in_one_piece, huge_chunk, many_texts),
    *(numbers_for_text, group_for_number, endless),
]


def look(file: Path) -> None:
    """What ``rig show`` and the figures ask of a file."""
    with RunFile.open(file) as opened:
        describe(file, opened.header, opened.outcome)
        opened.point_ids()
        for name in opened.columns():
            opened.column(name)


@pytest.mark.parametrize("spoil", SPOILING)
@pytest.mark.thorough
def test_a_run_file_of_a_stranger(
    tmp_path: Path, sound: bytes, spoil: Callable[[h5py.File], None]
) -> None:
    file = tmp_path / "a.h5"
    file.write_bytes(sound)
    with h5py.File(file, "a") as opened:
        spoil(opened)
    (tmp_path / "a.h5.sha256").write_text(f"{sha256_of(file)}  a.h5\n")
    with pytest.raises(RunFileError, match=r"a\.h5"):
        look(file)
    findings = verify_in_child(file)
    assert findings
    assert all("MemoryError" not in finding for finding in findings), findings


@settings(FEW, max_examples=3)
@given(data=st.data())
def test_a_damaged_run_file_is_found_damaged(
    tmp_path_factory: pytest.TempPathFactory, sound: bytes, data: st.DataObject
) -> None:
    file = tmp_path_factory.mktemp("damaged") / "a.h5"
    file.write_bytes(data.draw(damaged(sound)))
    file.with_name("a.h5.sha256").write_text(f"{'0' * 64}  a.h5\n")
    reported = "; ".join(findings_or_death(file))
    assert reported
    assert "(error" not in reported, "the program itself has died, not HDF5"


def findings_or_death(file: Path) -> list[str]:
    """The findings, or that HDF5 died of the file or hung."""
    try:
        return verify_in_child(file, patience_s=20.0)
    except RunFileError as error:
        return [error.reason]


@pytest.mark.thorough
def test_a_file_on_which_hdf5_hangs_is_reported_as_such(tmp_path: Path, sound: bytes) -> None:
    """As damage at random brings it about: texts whose heap leads in a circle."""
    file = tmp_path / "a.h5"
    harmed = bytearray(sound)
    size_of_the_first_text = harmed.index(b"GCOL") + 16 + 8
    struct.pack_into("<Q", harmed, size_of_the_first_text, 2**64 - 16)
    file.write_bytes(harmed)
    with pytest.raises(RunFileError, match="hangs on it: it did not finish within"):
        verify_in_child(file, patience_s=5.0)
