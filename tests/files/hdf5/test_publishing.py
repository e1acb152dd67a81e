"""Files that are published are read-only where the file system can have it so."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from rig.files.checksum import checksum_findings, sha256_of, write_checksum
from rig.files.hdf5.publishing import publishing


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o444), (0o077, 0o400), (0o027, 0o440)])
def test_no_user_may_write_and_the_umask_decides_who_may_read(
    tmp_path: Path, umask: int, mode: int
) -> None:
    before = os.umask(umask)
    try:
        with publishing(tmp_path / "run.h5") as part:
            part.write_bytes(b"data")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "run.h5").stat().st_mode) == mode


def test_where_rights_cannot_be_changed_the_file_is_published_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, mode: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "chmod", refuse)
    with publishing(tmp_path / "run.h5") as part:
        part.write_bytes(b"data")
    assert (tmp_path / "run.h5").read_bytes() == b"data"
    assert list(checksum_findings(tmp_path / "run.h5")) == []


def test_a_file_that_was_renamed_together_with_its_checksum_is_the_one_that_was_written(
    tmp_path: Path,
) -> None:
    file, renamed = tmp_path / "run.h5", tmp_path / "run 17, torn film.h5"
    file.write_bytes(b"data")
    write_checksum(file, sha256_of(file))
    file.rename(renamed)
    (tmp_path / "run.h5.sha256").rename(tmp_path / "run 17, torn film.h5.sha256")
    assert list(checksum_findings(renamed)) == []
    renamed.write_bytes(b"Data")
    (finding,) = checksum_findings(renamed)
    beside = "run 17, torn film.h5.sha256"
    assert finding == (
        f"its SHA-256 differs from the one in {beside}, which is of a file named run.h5: it has "
        f"changed, or {beside} belongs to another file"
    )


OTHER = "0" * 64


@pytest.mark.parametrize(
    ("lines", "finding"),
    [
        (["{sha256}"], None),
        (["{upper} *run.h5"], None),
        ([f"{OTHER}  a.h5", "{sha256}  run.h5"], None),
        ([f"{OTHER}  a.h5", "{sha256}  ./night/run.h5", ""], None),
        ([f"{OTHER}  a.h5", f"{OTHER}  run.h5"], "the file is not the one that was written: "),
        ([f"{OTHER}"], "the file is not the one that was written: "),
        (["{sha256}  a.h5", "{sha256}  b.h5"], "run.h5.sha256 has checksums of 2 files, but not"),
        (["e80b5017098950fc58aad83c8c14978e  run.h5"], "is not a SHA-256"),
        (["<html>"], "run.h5.sha256: '<html>' is not a SHA-256"),
        (["", " "], "run.h5.sha256 is empty"),
    ],
)
def test_a_checksum_that_is_not_of_this_file_is_said_to_be_just_that(
    tmp_path: Path, lines: list[str], finding: str | None
) -> None:
    file = tmp_path / "run.h5"
    file.write_bytes(b"data")
    sha256 = sha256_of(file)
    text = "\n".join(lines).format(sha256=sha256, upper=sha256.upper())
    (tmp_path / "run.h5.sha256").write_text(text)
    found = list(checksum_findings(file))
    assert len(found) == (finding is not None)
    assert all(str(finding) in one for one in found)


def test_a_link_to_a_file_is_checked_against_the_checksum_beside_the_file(tmp_path: Path) -> None:
    file, link = tmp_path / "run.h5", tmp_path / "elsewhere" / "latest.h5"
    file.write_bytes(b"data")
    write_checksum(file, sha256_of(file))
    link.parent.mkdir()
    link.symlink_to(file)
    assert list(checksum_findings(link)) == []
    file.write_bytes(b"Data")
    assert len(list(checksum_findings(link))) == 1
