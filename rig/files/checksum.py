"""The SHA-256 beside a file, ``<file>.sha256``, in the format of ``sha256sum``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path, PurePath

from rig.core import atomic
from rig.core.errors import shortened
from rig.files.naming import CHECKSUM_SUFFIX, checksum_path

MAX_CHECKSUM_CHARACTERS = 1 << 20
"""Largest length of what is beside a file: a line with a checksum and a name, or the lines of many
files. More is not read."""
_SHA256 = re.compile(r"[0-9a-f]{64}", re.IGNORECASE)


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


def stated_sha256(file: Path) -> str | None:
    """Return the SHA-256 that is written beside a file; None where none is, or not that of one
    file. The file itself is not read."""
    try:
        with checksum_path(file).open(encoding="utf-8", errors="replace") as opened:
            lines = opened.read(MAX_CHECKSUM_CHARACTERS).strip().splitlines()
    except OSError:
        return None
    sha256 = lines[0].split()[0].lower() if len(lines) == 1 else ""
    return sha256 if _SHA256.fullmatch(sha256) else None


def checksum_findings(file: Path) -> Iterator[str]:
    """Yield what is wrong with a file according to the SHA-256 beside it, one sentence each.

    Nothing is yielded if the file is, byte by byte, the one that was written, whatever its name
    was then: a file may be renamed together with its checksum. Of the checksums of several files
    the one that has this file's name is used; beside a symbolic link without a checksum of its own,
    that of its target. A missing checksum is a finding too: the file may be sound, but nothing
    shows it. Raises OSError for a file that cannot be read.
    """
    beside = checksum_path(file)
    if file.is_symlink() and not beside.exists():
        beside = checksum_path(file.resolve())
    if beside.exists() and not beside.is_file():
        yield f"{beside.name}: not a regular file"
        return
    try:
        with beside.open(encoding="utf-8", errors="replace") as opened:
            written = opened.read(MAX_CHECKSUM_CHARACTERS)
    except FileNotFoundError:
        yield (
            f"the file cannot be checked for corruption; {beside.name} is missing: copy it along "
            "with the file"
        )
        return
    except OSError as error:
        yield f"{beside.name}: {error.strerror or error}"
        return
    sums = [(line.split()[0], _name_in(line)) for line in written.splitlines() if line.strip()]
    own = [one for one in sums if one[1] in (file.name, beside.name.removesuffix(CHECKSUM_SUFFIX))]
    if not sums:
        yield f"{beside.name} is empty"
        return
    if not own and len(sums) > 1:
        yield f"{beside.name} has checksums of {len(sums)} files, but not that of {file.name}"
        return
    sha256, named = (own or sums)[0]
    if _SHA256.fullmatch(sha256) is None:
        yield f"{beside.name}: {shortened(sha256)!r} is not a SHA-256"
    elif sha256.lower() == sha256_of(file):
        return
    elif own or not named:
        yield (
            "the file is not the one that was written: its SHA-256 differs from the one in "
            f"{beside.name}"
        )
    else:
        yield (
            f"its SHA-256 differs from the one in {beside.name}, which is of a file named "
            f"{shortened(named)}: it has changed, or {beside.name} belongs to another file"
        )


def _name_in(line: str) -> str:
    """Return the file that a line of ``sha256sum`` names, without its folder; empty if none."""
    _, _, named = line.strip().partition(" ")
    return PurePath(named.strip().removeprefix("*")).name  # --binary writes an asterisk
