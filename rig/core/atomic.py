"""Write files so that a reader, a kill or a power cut never leaves half of one.

A new file is written under a temporary name in the target's folder and then renamed over the
target. A rename within one folder is atomic: whoever opens the target sees the earlier file or the
new one. After a power cut this holds only if the content was on the disk before the rename and the
folder after it, which is what ``durable`` is about.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(target: Path, *, durable: bool = True, shared: bool = False) -> Iterator[Path]:
    """Give the block a temporary path; when it ends without an error, that file becomes `target`.

    The block creates the file, which does not exist before, and has closed it when it ends. If the
    block raises, the temporary file is deleted and `target` is as it was.

    `durable` puts content and name on the disk before this returns (fsync of the file, rename,
    fsync of the folder); without it a power cut may leave the earlier file, or an empty one. Use
    ``durable=False`` only for what is cheap to make again: a figure, a cache entry, a heartbeat.

    `shared` gives every call a temporary name of its own, for targets that several processes may
    write at once. Otherwise the name is always the same, so that what a killed process has left is
    overwritten by the next one instead of filling the folder.

    Raises the OSError of the step that failed.
    """
    own = f".{os.getpid()}-{secrets.token_hex(4)}" if shared else ""
    part = target.with_name(f".{target.name}{own}.part")
    part.unlink(missing_ok=True)
    try:
        yield part
        if durable:
            sync_file(part)
        part.replace(target)
        if durable:
            sync_folder(target.parent)
    finally:
        part.unlink(missing_ok=True)


def write_text(target: Path, text: str, *, durable: bool = True, shared: bool = False) -> None:
    """Write UTF-8 text to `target`, in place of an earlier file (see `replacing`)."""
    with replacing(target, durable=durable, shared=shared) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(
    target: Path, content: bytes, *, durable: bool = True, shared: bool = False
) -> None:
    """Write bytes to `target`, in place of an earlier file (see `replacing`)."""
    with replacing(target, durable=durable, shared=shared) as part:
        part.write_bytes(content)


def sync_file(path: Path) -> None:
    """Return when the content of a closed file is on the disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)  # enough for fsync, and allowed on a read-only file
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Return when the folder's entries are on the disk: a new file, a rename, a deletion.

    A file's own fsync does not cover its name. Raises OSError.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
