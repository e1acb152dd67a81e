"""The remedy for results that could not be written suits the reason."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from rig.files.errors import not_written

ELSEWHERE = "name another folder with --to; the run file is untouched"


def test_free_space_is_the_remedy_for_a_full_disk_only() -> None:
    full = not_written(Path("to/a.json"), OSError(errno.ENOSPC, "No space left on device"))
    assert full.hint == f"free space there, or {ELSEWHERE}"
    denied = not_written(Path("to/a.json"), PermissionError(errno.EACCES, "Permission denied"))
    assert denied.one_line() == f"to/a.json: cannot be written: Permission denied; {ELSEWHERE}"


@pytest.mark.parametrize("below", ["", "below"])
def test_a_file_in_place_of_the_folder_is_named(tmp_path: Path, below: str) -> None:
    (tmp_path / "notes.txt").touch()
    target = tmp_path / "notes.txt" / below / "a.json"
    with pytest.raises(OSError) as raised:  # noqa: PT011 - which one depends on the place
        target.parent.mkdir(parents=True, exist_ok=True)
    error = not_written(target, raised.value)
    assert "notes.txt" in error.one_line()
    assert f"is not a folder; {ELSEWHERE}" in error.one_line()
