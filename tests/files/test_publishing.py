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
    assert finding.endswith("the one in run 17, torn film.h5.sha256, which is that of run.h5")


def test_a_link_to_a_file_is_checked_against_the_checksum_beside_the_file(tmp_path: Path) -> None:
    file, link = tmp_path / "run.h5", tmp_path / "elsewhere" / "latest.h5"
    file.write_bytes(b"data")
    write_checksum(file, sha256_of(file))
    link.parent.mkdir()
    link.symlink_to(file)
    assert list(checksum_findings(link)) == []
    file.write_bytes(b"Data")
    assert len(list(checksum_findings(link))) == 1
