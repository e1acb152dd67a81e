"""The records of interlock contacts that outlive a run: latches, resets and proof tests.

Each contact has one small file, named after the address of the instrument that reads it and the
input, so that neither another folder of results nor another name in the bench file loses a latch.
The files are in /var/lib/tactile-rig where an administrator has made that folder for all users of
the bench; else in ``$XDG_STATE_HOME/tactile-rig`` or ``~/.local/state/tactile-rig`` of each user.

A file that cannot be read counts as a latch: whether a person has been at the bench is not known.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from rig.bench.interlocks import InterlockSettings
from rig.bench.plan import BenchPlan
from rig.core.atomic import write_text
from rig.core.errors import RigError, UnsafeError
from rig.run.lock import address_of

FOLDER = "tactile-rig"
FOR_ALL_USERS = Path("/var/lib") / FOLDER


@dataclass(frozen=True)
class ContactRecord:
    """The stored state of one contact. Times are local, ISO 8601 with the offset from UTC."""

    name: str = ""
    bench: str = ""
    opened: str | None = None
    """Time at which it opened; None if it is not latched."""
    why: str = ""
    """The cause of its opening, in words."""
    reset: str | None = None
    """Time of the latest reset."""
    reset_by: str = ""
    proof: str | None = None
    """Time at which it was last seen to open and to close, in a proof test."""
    proof_by: str = ""


class InterlockStore:
    """The records of the contacts of one bench. Without `folder` they are kept in memory only, for
    a simulated bench that ends with the command."""

    def __init__(self, plan: BenchPlan, folder: Path | None):
        self._bench = plan.settings.name
        self._folder = folder
        settings = {part.role: part.settings for part in plan.instruments}
        self._paths = {
            one.name: _file_name(address_of(settings[one.role].model_dump()), one)
            for one in plan.settings.interlock
        }
        self._kept: dict[str, ContactRecord] = {}

    def path(self, name: str) -> Path | None:
        """Return the file of a contact; None if it has none."""
        return None if self._folder is None else self._folder / self._paths[name]

    def get(self, name: str) -> ContactRecord:
        """Return the record of a contact."""
        path = self.path(name)
        if path is None:
            return self._kept.get(name, ContactRecord(name, self._bench))
        try:
            found: Mapping[str, Any] = json.loads(path.read_text())
            return ContactRecord(**found)
        except FileNotFoundError:
            return ContactRecord(name, self._bench)
        except (OSError, ValueError, TypeError) as error:
            why = f"its record {path} cannot be read ({error}), which counts as open"
            return ContactRecord(name, self._bench, now(), why)

    def check_writable(self) -> None:
        """Write every record as it is. Raises RigError if that fails: a run whose latch could not
        be kept is refused before anything moves."""
        for name in self._paths:
            self._put(name, self.get(name))

    def latch(self, name: str, why: str) -> None:
        """Record that a person's contact has opened; an earlier opening that has not been reset
        stays. Raises UnsafeError if the record cannot be written."""
        record = self.get(name)
        if record.opened is not None:
            return
        try:
            self._put(name, replace(record, opened=now(), why=why))
        except RigError as error:
            raise UnsafeError(error.message, "check the bench before the next run") from error

    def reset(self, name: str) -> None:
        """Record that a person has reset a contact. Raises RigError if that fails."""
        record = replace(self.get(name), opened=None, why="", reset=now(), reset_by=person())
        self._put(name, record)

    def prove(self, name: str) -> None:
        """Record that a contact was seen to open and to close. Raises RigError if that fails."""
        self._put(name, replace(self.get(name), proof=now(), proof_by=person()))

    def _put(self, name: str, record: ContactRecord) -> None:
        path = self.path(name)
        if path is None:
            self._kept[name] = record
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(asdict(record), indent=1) + "\n")
        except OSError as error:
            raise RigError(
                f"the record {path} of interlock {name!r} cannot be written: {error.strerror}",
                "free the disk, or make its folder writable",
            ) from error


def state_folder() -> Path:
    """Return the folder of the records."""
    if os.access(FOR_ALL_USERS, os.W_OK | os.X_OK):
        return FOR_ALL_USERS
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if base else Path.home() / ".local" / "state") / FOLDER


def person() -> str:
    """Return the name of the user at the computer."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"user {os.getuid()}"


def now() -> str:
    """Return the local time."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def _file_name(address: str, contact: InterlockSettings) -> str:
    digest = hashlib.sha256(f"{address} {contact.line}".encode()).hexdigest()[:16]
    return f"interlock-{digest}.json"
