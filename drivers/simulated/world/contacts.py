"""The interlock contacts of a simulated bench: doors and switches, and the inputs that they drive.

A contact is where a person has left it, unless a fault holds it: welded shut, broken, or bouncing.
An instrument asks for the level of an input by its own name and the input's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from drivers.simulated.faults.plan import ContactFault
from rig.core.errors import ConfigurationError
from rig.core.settings import Settings

BOUNCE_us = 7_000
"""A bouncing contact changes this often: not a multiple of any program's interval (assumed)."""


class SimulatedContactSettings(Settings):
    """A contact of a simulated bench, with what its bench file says of it."""

    name: str = Field(min_length=1)
    """Name of the contact in the bench file and in fault plans."""
    input: str = "daq.501.0"
    """Instrument and input."""
    kind: Literal["person", "process"] = Field(default="person", alias="class")
    """Class of the contact in the bench file."""
    closed_is: Literal["high", "low"] = "high"
    """Level of the input while it is closed."""
    proof: bool = False
    """True if a run has to see it open and close first."""
    closed: bool = True
    """True if it is closed when the World begins."""


class ContactsSettings(Settings):
    """The contacts of a simulated bench."""

    interlock: tuple[SimulatedContactSettings, ...] = ()

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        names = [one.name for one in self.interlock]
        if len(set(names)) < len(names):
            raise ValueError("two interlocks have the same name")
        return self


@dataclass
class _Contact:
    settings: SimulatedContactSettings
    closed: bool
    held: bool | None = None
    """State in which a fault holds it; None if none does."""
    bounces_until_us: int = 0

    def is_closed(self, now_us: int) -> bool:
        if self.held is not None:
            return self.held
        if now_us < self.bounces_until_us:
            return now_us // BOUNCE_us % 2 == 0
        return self.closed


class Contacts:
    """The contacts of one bench; `log` writes to the World's log."""

    def __init__(self, settings: Sequence[SimulatedContactSettings], log: Callable[[object], None]):
        self._contacts = {one.name: _Contact(one, one.closed) for one in settings}
        self._log = log

    def require(self, faults: Sequence[ContactFault]) -> None:
        """Raise ConfigurationError for a fault of a contact that the bench does not have."""
        for fault in faults:
            if fault.name not in self._contacts:
                known = ", ".join(self._contacts) or "none"
                raise ConfigurationError(
                    f"the fault plan has a fault of the interlock {fault.name!r}, which this bench "
                    f"does not have (it has: {known})",
                    "declare it as [[interlock]] in the file of World settings",
                )

    def disturb(self, fault: ContactFault, t_us: int) -> None:
        """Begin a fault, or let a person open or close what the contact is on."""
        contact = self._contacts[fault.name]
        if fault.kind in ("stuck-closed", "stuck-open"):
            contact.held = fault.kind == "stuck-closed"
        elif fault.kind == "bouncing":
            contact.bounces_until_us = t_us + round(fault.for_s * 1e6)
        else:
            contact.closed = fault.kind == "closed"
        self._log({"name": fault.name, "closed": contact.is_closed(t_us)})

    def high(self, device: str, line: str, now_us: int) -> bool:
        """Return the level of an input; low where no contact is wired to it."""
        for contact in self._contacts.values():
            own = contact.settings
            if own.input == f"{device}.{line}":
                return contact.is_closed(now_us) == (own.closed_is == "high")
        return False

    def tables(self) -> list[dict[str, Any]]:
        """Return the ``[[interlock]]`` tables of the bench file."""
        return [
            {
                "name": own.name,
                "input": own.input,
                "class": own.kind,
                "closed_is": own.closed_is,
                "proof": own.proof,
            }
            for own in (contact.settings for contact in self._contacts.values())
        ]
