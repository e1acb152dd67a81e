"""The folder for what all users of this computer have to know about its benches: locks, marks and
the references with which presses are compared.

It is the same for every user, folder of results and temporary folder:

    /var/lib/tactile-rig    if an administrator has made it, for a group of users; else
    /var/tmp/tactile-rig    for one user, who makes it with the first run on a bench of a bench file

Both outlive a restart of the computer. No one outside the group, or other than the one user, can
write there: a folder that everybody may write to, or that belongs to another user, is refused, and
no link is followed. The files are readable and writable for the group where the folder is writable
for it (0660), else for their owner alone (0600). The environment variable `VARIABLE` names another
folder, for tests.
"""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
import stat
from pathlib import Path
from typing import Self

from rig.core.errors import ConfigurationError

VARIABLE = "RIG_SHARED_FOLDER"
OF_A_GROUP = Path("/var/lib/tactile-rig")
OF_ONE_USER = Path("/var/tmp/tactile-rig")
MAKE_ONE = f"have an administrator run: install -d -g GROUP -m 2770 {OF_A_GROUP}"
MOST_BYTES = 65536
"""Largest size of a file in the folder that is read."""


class SharedFolder:
    """The opened folder; a context manager that closes it.

    Raises ConfigurationError if it cannot be made or opened, or if another user could write there.
    """

    def __init__(self) -> None:
        self.path = _path()
        self._folder = _open_checked(self.path)
        shared = os.fstat(self._folder).st_mode & stat.S_IWGRP
        self._mode = 0o660 if shared else 0o600

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._folder)

    def open_file(self, name: str, *, create: bool) -> int:
        """Return a file descriptor for reading and writing. Raises OSError, for anything but a
        regular file, too."""
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        while True:
            try:
                file = os.open(name, flags, dir_fd=self._folder)
                break
            except FileNotFoundError:
                if not create:
                    raise
            with contextlib.suppress(FileExistsError):
                return self._create(name)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(errno.EINVAL, "not a regular file")
        return file

    def holds(self, name: str, file: int) -> bool:
        """Return whether `name` is still the file that was opened, and has not been removed or
        replaced since."""
        try:
            there = os.stat(name, dir_fd=self._folder, follow_symlinks=False)
        except OSError:
            return False
        return os.path.samestat(there, os.fstat(file))

    def read(self, name: str, most_bytes: int = MOST_BYTES) -> str | None:
        """Return the text of a file, or its first `most_bytes`; None if there is none. Raises
        OSError, or ValueError if it is not UTF-8."""
        try:
            file = self.open_file(name, create=False)
        except FileNotFoundError:
            return None
        try:
            return os.pread(file, most_bytes, 0).decode()
        finally:
            os.close(file)

    def write(self, name: str, text: str) -> None:
        """Write a file, in place of an earlier one. When this returns it is on the disk; when it
        raises OSError, the earlier one is as it was."""
        part = f".{name}.part"
        self.remove(part)
        file = self._create(part)
        try:
            try:
                content = text.encode()
                while content:
                    content = content[os.write(file, content) :]
                os.fsync(file)
            finally:
                os.close(file)
            os.rename(part, name, src_dir_fd=self._folder, dst_dir_fd=self._folder)
            os.fsync(self._folder)
        except OSError:
            with contextlib.suppress(OSError):
                self.remove(part)
            raise

    def remove(self, name: str) -> None:
        """Remove a file, if it is there, from the disk. Raises OSError."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._folder)
            os.fsync(self._folder)

    def _create(self, name: str) -> int:
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        file = os.open(name, flags, 0o600, dir_fd=self._folder)
        os.fchmod(file, self._mode)  # whatever the umask is
        return file


def user_name(uid: int) -> str:
    """Return the name of a user, or the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _path() -> Path:
    if given := os.environ.get(VARIABLE):
        return Path(given)
    return OF_A_GROUP if os.path.lexists(OF_A_GROUP) else OF_ONE_USER


def _open_checked(path: Path) -> int:
    what = f"the folder {path} for the locks and marks of benches"
    try:
        if path != OF_A_GROUP:
            with contextlib.suppress(FileExistsError):
                path.mkdir(0o700)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        hint = "become a member of its group" if path == OF_A_GROUP else MAKE_ONE
        raise ConfigurationError(f"{what} cannot be opened: {error.strerror}", hint) from error
    found = os.fstat(folder)
    # Only an administrator can have made the group's folder, whoever it was given to.
    own = path == OF_A_GROUP or found.st_uid in (0, os.geteuid())
    if own and not found.st_mode & stat.S_IWOTH:
        return folder
    os.close(folder)
    if not own:
        raise ConfigurationError(
            f"{what} belongs to {user_name(found.st_uid)}",
            f"for benches that several users share, {MAKE_ONE}",
        )
    raise ConfigurationError(f"{what} can be written by everybody", f"chmod o-w {path}")
