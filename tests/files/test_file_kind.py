"""Files of other kinds: what they are, and which command or file helps."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from rig.batch.folder import QUEUE
from rig.core.errors import ExitCode
from rig.files.errors import RunFileError
from rig.files.file_kind import BATCH_QUEUE, described, kind_of, require_hdf5
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify


def refused(path: Path) -> RunFileError:
    with pytest.raises(RunFileError) as caught:
        require_hdf5(path)
    return caught.value


def test_a_batch_is_recognised_by_the_name_of_its_queue() -> None:
    assert BATCH_QUEUE == QUEUE


def test_the_folder_and_the_queue_of_a_batch_name_the_command_that_shows_them(
    tmp_path: Path,
) -> None:
    queue = tmp_path / QUEUE
    queue.write_bytes(b"SQLite format 3\0")
    hint = f"`rig batch status {tmp_path}` shows the batch"
    folder, file = refused(tmp_path), refused(queue)
    assert (folder.reason, folder.hint) == ("the folder of a batch, not a file", hint)
    assert (file.reason, file.hint) == ("the queue of a batch", hint)


def test_a_folder_that_may_not_be_looked_into_is_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def locked(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", locked)
    assert described(tmp_path, "folder") == ("a folder, not a file", None)


def test_a_checksum_names_its_file(tmp_path: Path) -> None:
    path = tmp_path / "x.h5.sha256"
    path.write_text("0" * 64 + "  x.h5\n")
    error = refused(path)
    assert (error.reason, error.hint) == ("a checksum, not the file itself", "name x.h5")


def test_verify_says_of_a_file_of_another_kind_what_show_says(tmp_path: Path) -> None:
    path = tmp_path / "x.h5.sha256"
    path.write_text("0" * 64 + "  x.h5\n")
    assert verify(path) == ["a checksum, not the file itself; name x.h5"]


def test_a_file_that_another_program_writes_to_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as held:
        held["entry/title"] = "x"
    writer = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", writer, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(RunFileError) as caught:
            RunFile.open(path)
        other.communicate(b"\n")
    assert caught.value.reason.endswith("another program has it open for writing; close it there")
    assert caught.value.hint is None


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.ENOLCK, "its file system does not lock files"), (errno.EMFILE, "too many files")],
)
def test_a_sound_file_that_cannot_be_opened_here_is_not_called_damaged(
    number: int, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a share without its lock service."""
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as held:
        held["entry/title"] = "x"

    def refuse(*_: object) -> None:
        raise OSError(number, "Unable to synchronously open file")

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(RunFileError, match=reason) as caught:
        RunFile.open(path)
    assert caught.value.hint is None, "nothing is to be recovered"


def test_a_folder_of_runs_says_how_to_name_them(tmp_path: Path) -> None:
    assert refused(tmp_path).hint is None
    (tmp_path / "x.h5").touch()
    assert refused(tmp_path).hint == f"name the files in it: {tmp_path}/*.h5"


def test_only_a_path_without_a_file_is_a_usage_error(tmp_path: Path) -> None:
    (tmp_path / "empty.h5").touch()
    assert refused(tmp_path / "none.h5").code is ExitCode.USAGE
    assert refused(tmp_path).code is ExitCode.USAGE
    assert refused(tmp_path / "empty.h5").code is ExitCode.FOUND_WRONG


def test_a_file_that_cannot_be_opened_says_why(tmp_path: Path) -> None:
    loop = tmp_path / "loop.h5"
    loop.symlink_to("loop.h5")
    assert kind_of(loop) == "unreadable"
    assert described(loop, "unreadable") == (
        "it cannot be read (Too many levels of symbolic links)",
        None,
    )
