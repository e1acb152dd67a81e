"""The interlock contacts of a bench, as its bench file declares them, and what reads them.

A contact is read through an input of an instrument that the bench has anyway: a digital line of
the DAQ, an input of a drive, of the force sensor's amplifier. Nothing here says what follows from
an open contact (`rig.control.interlock`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, Self

from pydantic import Field, model_validator

from rig.core.name_patterns import NAME_WITH_BLANKS
from rig.core.settings import Settings
from rig.instruments.roles import DriverModule


class InterlockSettings(Settings):
    """Settings of one interlock contact."""

    name: str = Field(min_length=1, max_length=40, pattern=NAME_WITH_BLANKS)
    """Name as people at the bench say it, such as ``door``, ``e-stop`` or ``light curtain``."""
    input: str = Field(pattern=r"^[a-z_]+\..+$")
    """Instrument and its input, such as ``daq.501.0`` or ``stage_z.DIN3``."""
    kind: Literal["person", "process"] = Field(alias="class")
    """``person`` if a person may be within reach while it is open: it latches. ``process`` for
    anything else: the run continues by itself once it is closed again."""
    closed_is: Literal["high", "low"] = "high"
    """Level of the input while the contact is closed. Wire it so that this is the level that a
    broken wire cannot give."""
    proof: bool = False
    """True if a run has to see the contact open and close once before anything is armed."""

    @property
    def role(self) -> str:
        """Role of the instrument that reads it."""
        return self.input.partition(".")[0]

    @property
    def line(self) -> str:
        """Name of the input, as the instrument's driver knows it."""
        return self.input.partition(".")[2]

    def is_closed(self, high: bool) -> bool:
        """Return whether the contact is closed, from the level of its input."""
        return high == (self.closed_is == "high")


class Interlocks(Settings):
    """The interlocks of a bench file."""

    interlock: tuple[InterlockSettings, ...] = ()

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        for what in ("name", "input"):
            values = [getattr(one, what) for one in self.interlock]
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"two [[interlock]] tables have the {what} {value!r}")
        return self


def by_role(contacts: Sequence[InterlockSettings]) -> Mapping[str, tuple[InterlockSettings, ...]]:
    """Return the contacts by the role of the instrument that reads them."""
    roles = dict.fromkeys(one.role for one in contacts)
    return {role: tuple(one for one in contacts if one.role == role) for role in roles}


def unreadable(
    contacts: Sequence[InterlockSettings], drivers: Mapping[str, DriverModule]
) -> Iterator[str]:
    """Yield, in words, each contact whose input does not exist on this bench; `drivers` are given
    by role."""
    for one in contacts:
        where = f"interlock {one.name!r}: input = {one.input!r}"
        if one.role not in drivers:
            yield f"{where}: the bench has no {one.role}"
            continue
        inputs: Sequence[str] = getattr(drivers[one.role], "INPUTS", ())
        if not inputs:
            able = [role for role, driver in drivers.items() if getattr(driver, "INPUTS", ())]
            others = f"; the bench has inputs on {', '.join(able)}" if able else ""
            yield f"{where}: the driver of the {one.role} reads no inputs{others}"
        elif one.line not in inputs:
            yield f"{where}: the {one.role} has no such input; it has {inputs[0]} to {inputs[-1]}"
