"""The shim under the file calls: what a full, a read-only and a slow disk do to this process."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.simulated.faults.disk import FaultyDisk
from drivers.simulated.faults.plan import FaultPlan, FileFault


@contextmanager
def faulty(folder: Path, **fault: object) -> Iterator[None]:
    plan = FaultPlan.model_validate({"fault": [{"device": "disk", **fault}]})
    disk = FaultyDisk(plan.of(FileFault), folder)
    disk.install()
    try:
        yield
    finally:
        disk.remove()


def appended(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)


def test_a_full_disk_takes_what_fits_and_then_nothing(tmp_path: Path) -> None:
    file = appended(tmp_path / "journal")
    with faulty(tmp_path, kind="disk-full", after_bytes=10):
        assert os.writev(file, [b"abcd", b"efgh"]) == 8
        assert os.writev(file, [b"ijkl"]) == 2
        with pytest.raises(OSError, match="No space left") as caught:
            os.writev(file, [b"kl"])
        assert caught.value.errno == errno.ENOSPC
        with pytest.raises(OSError, match="No space left"):
            os.pwrite(file, b"x", 0)
        with pytest.raises(OSError, match="No space left"):
            (tmp_path / "other").write_text("x")
    os.close(file)
    assert (tmp_path / "journal").read_bytes() == b"abcdefghij"


def test_a_read_only_disk_refuses_every_change_and_can_be_read(tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.write_text("as it was")
    with faulty(tmp_path, kind="read-only"):
        for change in (
            lambda: appended(tmp_path / "new"),
            lambda: there.write_text("changed"),
            lambda: (tmp_path / "folder").mkdir(),
            lambda: there.replace(tmp_path / "moved"),
            there.unlink,
        ):
            with pytest.raises(OSError, match="Read-only") as caught:
                change()
            assert caught.value.errno == errno.EROFS
        assert there.read_text() == "as it was"
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_disk_that_becomes_read_only_has_kept_what_came_before(tmp_path: Path) -> None:
    file = appended(tmp_path / "journal")
    with faulty(tmp_path, kind="read-only", after_bytes=4):
        os.writev(file, [b"abcd"])
        with pytest.raises(OSError, match="Read-only"):
            os.writev(file, [b"e"])
    os.close(file)
    assert (tmp_path / "journal").read_bytes() == b"abcd"


def test_a_slow_disk_only_takes_its_time(tmp_path: Path) -> None:
    file = appended(tmp_path / "journal")
    with faulty(tmp_path, kind="slow-sync", delay_s=0.2):
        begun = time.monotonic()
        os.writev(file, [b"abcd"])
        os.fdatasync(file)
        assert time.monotonic() - begun >= 0.2
    os.close(file)
    assert (tmp_path / "journal").read_bytes() == b"abcd"


def test_other_folders_and_other_times_are_not_disturbed(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    calls = os.open, os.writev, os.replace
    with faulty(tmp_path / "results", kind="read-only"):
        (tmp_path / "elsewhere").write_text("fine")
    assert (os.open, os.writev, os.replace) == calls
    (tmp_path / "results" / "after").write_text("fine")
