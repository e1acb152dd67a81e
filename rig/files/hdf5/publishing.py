"""Give an HDF5 file its name once it is complete, checked and on the disk."""

from __future__ import annotations

import contextlib
import stat
from collections.abc import Iterator
from pathlib import Path

from rig.core.atomic import replacing
from rig.files.checksum import sha256_of, write_checksum


@contextlib.contextmanager
def publishing(target: Path, *, shared: bool = False) -> Iterator[Path]:
    """Give the block a temporary path to write to and to check; then publish that file.

    Publishing makes the file read-only where the file system can, puts it on the disk, renames it
    to `target` in place of an earlier one, and writes its SHA-256 beside it. If the block raises,
    nothing of this happens and no file is left behind. `shared` is for targets that several
    processes may write at once.

    Raises the OSError of the step that failed.
    """
    with replacing(target, shared=shared) as part:
        yield part
        sha256 = sha256_of(part)
        _make_read_only(part)
    # Between these two steps the file has the checksum of its predecessor, and verifying it fails.
    # The other order would have a sound file fail for as long as a crash left it so.
    write_checksum(target, sha256)


def _make_read_only(file: Path) -> None:
    """Take the right to write from everybody; who may read remains as the umask has it.

    File systems without owners (vfat, some network shares) refuse any change of rights. The file
    then stays writable: its checksum still shows every change, and to lose it would be worse.
    """
    readable = stat.S_IMODE(file.stat().st_mode) & ~0o222
    with contextlib.suppress(PermissionError, NotImplementedError):
        file.chmod(readable)
