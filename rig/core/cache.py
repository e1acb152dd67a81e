"""A disk cache for things that are expensive to compute and cheap to check.

An entry is one file under a key that hashes everything it depends on. Content carries its own
checksum: a damaged or foreign file is a miss, never an answer. Losing the cache loses time only.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import tempfile
from functools import cache
from pathlib import Path
from typing import Protocol

from rig.core.atomic import write_bytes

_MAGIC = b"RIGCACHE1\n"
_DIGEST_BYTES = 32


class Cache(Protocol):
    """Bytes by key. An implementation may store nothing: then every `get` returns None."""

    def get(self, key: str) -> bytes | None:
        """Return the bytes stored under `key`, or None."""
        ...

    def put(self, key: str, content: bytes) -> None:
        """Store `content` under `key`; failing to store is not an error."""
        ...


class NoCache:
    """A cache that stores nothing, for when every value has to be computed."""

    def get(self, key: str) -> bytes | None:
        """Return None."""
        return None

    def put(self, key: str, content: bytes) -> None:
        """Do nothing."""


class DiskCache:
    """One file for each entry, in one folder, checked when it is read."""

    def __init__(self, folder: Path):
        self.folder = folder

    def path(self, key: str) -> Path:
        """Return the file for `key`; keys are hashed so that any text is a safe name."""
        return self.folder / (hashlib.sha256(key.encode()).hexdigest()[:40] + ".cache")

    def get(self, key: str) -> bytes | None:
        """Return the bytes stored under `key`, or None if there are none or they are damaged."""
        try:
            raw = self.path(key).read_bytes()
        except OSError:
            return None
        head = len(_MAGIC) + _DIGEST_BYTES
        if len(raw) < head or not raw.startswith(_MAGIC):
            return None
        content = raw[head:]
        if _digest(key, content) != raw[len(_MAGIC) : head]:
            return None
        return content

    def has_entries(self) -> bool:
        """Return whether anything was ever stored, without reading it."""
        return next(self.folder.glob("*.cache"), None) is not None

    def put(self, key: str, content: bytes) -> None:
        """Store `content` under `key`; a full or read-only disk leaves the cache as it was."""
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            entry = _MAGIC + _digest(key, content) + content
            write_bytes(self.path(key), entry, durable=False, shared=True)


def user_cache() -> DiskCache:
    """Return the cache in the user's cache folder; ``RIG_CACHE`` overrides the place."""
    override = os.environ.get("RIG_CACHE")
    return DiskCache(Path(override) if override else _user_cache_folder())


@cache
def place_numba_cache(package: Path) -> None:
    """Give numba a folder for the machine code of a package, before its kernels are imported.

    numba stores it beside the source or in the user's home. A service has neither where the program
    belongs to root and its user has no home; numba then refuses to import the kernels.
    """
    if os.access(package, os.W_OK) or _home_is_usable():
        return
    os.environ.setdefault("NUMBA_CACHE_DIR", str(_user_cache_folder() / "numba"))


def _user_cache_folder() -> Path:
    """Return the user's cache folder; for a user without a home, one of their own in the temporary
    folder."""
    from platformdirs import user_cache_path

    if _home_is_usable() or os.environ.get("XDG_CACHE_HOME"):
        return user_cache_path("tactile-rig")
    folder = Path(tempfile.gettempdir()) / f"tactile-rig-cache-{os.getuid()}"
    with contextlib.suppress(OSError):  # what cannot be stored is computed again
        folder.mkdir(mode=0o700, exist_ok=True)
    try:
        found = folder.lstat()
        if found.st_uid == os.getuid() and stat.S_IMODE(found.st_mode) == 0o700:
            return folder
    except OSError:
        pass
    # A folder of this name that belongs to another user is not trusted: its code would be executed.
    return Path(tempfile.mkdtemp(prefix="tactile-rig-cache-"))


def _home_is_usable() -> bool:
    try:
        return os.access(Path.home(), os.W_OK | os.X_OK)
    except RuntimeError:  # no HOME, and a user whom the computer does not know
        return False


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()
