"""The SHA-256 beside a file, ``<file>.sha256``, in the format of ``sha256sum``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from rig.core import atomic
from rig.files.naming import checksum_path

MAX_CHECKSUM_CHARACTERS = 4096
"""Length of the line beside a file: a checksum and a name. More is not read."""


def sha256_of(path: Path) -> str:
    """Return the file's SHA-256 in hexadecimal. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_checksum(path: Path, sha256: str) -> None:
    """Write ``<path>.sha256``, which ``sha256sum -c`` checks in the file's folder.

    It is on the disk when this returns. Raises OSError.
    """
    # `shared`: the same processed file may be made by two processes at once.
    atomic.write_text(checksum_path(path), f"{sha256}  {path.name}\n", shared=True)


def checksum_findings(file: Path) -> Iterator[str]:
    """Yield what is wrong with a file according to the SHA-256 beside it, one sentence each.

    Nothing is yielded if the file is, byte by byte, the one that was written, whatever its name
    was then: a file may be renamed together with its checksum. Beside a symbolic link without a
    checksum of its own that of its target is used. A missing checksum
    is a finding too: the file may be sound, but nothing shows it. Raises OSError for a file that
    cannot be read.
    """
    beside = checksum_path(file)
    if file.is_symlink() and not beside.exists():
        beside = checksum_path(file.resolve())
    if beside.exists() and not beside.is_file():
        yield f"{beside.name}: not a regular file"
        return
    try:
        with beside.open(encoding="utf-8", errors="replace") as opened:
            words = opened.read(MAX_CHECKSUM_CHARACTERS).split()
    except FileNotFoundError:
        yield (
            f"the file cannot be checked for corruption; {beside.name} is missing: copy it along "
            "with the file"
        )
        return
    except OSError as error:
        yield f"{beside.name}: {error.strerror or error}"
        return
    if not words:
        yield f"{beside.name} is empty"
    elif words[0].lower() != sha256_of(file):
        named = " ".join(words[1:]).removeprefix("*")  # sha256sum --binary writes an asterisk
        other = f", which is that of {named}" if named not in ("", file.name) else ""
        yield (
            "the file is not the one that was written: its SHA-256 differs from the one in "
            f"{beside.name}{other}"
        )
