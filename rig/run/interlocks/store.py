"""The records of interlock contacts that outlive a run: latches, resets and proof tests.

Each contact has a small file for each address of the instrument that reads it, named after address
and input, so that neither another folder of results nor another name in the bench file loses a
latch.
The files are in the folder that all users of the computer share (`rig.run.locks.shared_folder`).

A file that cannot be read counts as a latch: whether a person has been at the bench is not known.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
from dataclasses import asdict, dataclass, replace
from datetime import datetime

from rig.bench.addresses import addresses_of
from rig.bench.interlocks import InterlockSettings
from rig.bench.plan import BenchPlan
from rig.core.errors import RigError, UnsafeError
from rig.run.locks.shared_folder import SharedFolder


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
    """The records of the contacts of one bench. Those that are not `lasting` are in memory only,
    for a simulated bench that ends with the command."""

    def __init__(self, plan: BenchPlan, *, lasting: bool):
        self._bench = plan.settings.name
        self.lasting = lasting
        """Whether the records outlive this program."""
        settings = {part.role: part.settings for part in plan.instruments}
        self._names = {
            one.name: [_file_name(address, one) for address in addresses_of(settings[one.role])]
            for one in plan.settings.interlock
        }
        """Files of each contact, one for each address of its instrument."""
        self._kept: dict[str, ContactRecord] = {}

    def get(self, name: str) -> ContactRecord:
        """Return the record of a contact: one that is latched, if there is one under any of its
        addresses."""
        nothing = ContactRecord(name, self._bench)
        if not self.lasting:
            return self._kept.get(name, nothing)
        records = [record for file in self._names[name] if (record := self._read(name, file))]
        latched = [record for record in records if record.opened is not None]
        return (latched or records or [nothing])[0]

    def _read(self, name: str, file: str) -> ContactRecord | None:
        """Return the record in a file, or None without one. One that cannot be read is a latch."""
        try:
            with SharedFolder() as folder:
                text = folder.read(file)
            return None if text is None else ContactRecord(**json.loads(text))
        except (OSError, ValueError, TypeError, RigError) as error:
            why = f"its record {file} cannot be read ({error}), which is treated as open"
            return ContactRecord(name, self._bench, opened=now(), why=why)

    def check_writable(self) -> None:
        """Write every record as it is. Raises RigError if that fails: a run whose latch could not
        be kept is refused before anything moves."""
        for name in self._names:
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
        if not self.lasting:
            self._kept[name] = record
            return
        with SharedFolder() as folder:
            for file in self._names[name]:
                try:
                    folder.write(file, json.dumps(asdict(record), indent=1) + "\n")
                except OSError as error:
                    raise RigError(
                        f"the record {folder.path / file} of interlock {name!r} cannot be "
                        f"written: {error.strerror}",
                        "free some disk space, or have the folder's owner correct it",
                    ) from error


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
