"""The settings of a U2300A or U2500A series DAQ in a bench file. Plain data."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from rig.core.settings import Address, Channels, Settings, Wiring


class KeysightU2300ASettings(Settings):
    """Address and wiring of the DAQ."""

    driver: Literal["keysight-u2300a"] = "keysight-u2300a"
    resource: Address[str]
    """VISA resource, for example USB0::0x0957::0x1518::TW12345678::INSTR."""
    timeout_s: Wiring[float] = Field(default=2.0, gt=0, le=60)
    """Longest wait for an answer."""
    channels: Channels[dict[str, int]] = Field(min_length=1)
    """Terminal by signal name, for example load_cell = 101."""

    @field_validator("channels")
    @classmethod
    def _terminals_differ(cls, channels: dict[str, int]) -> dict[str, int]:
        if len(set(channels.values())) != len(channels):
            raise ValueError("two signals are wired to one terminal; give each its own")
        for name, terminal in channels.items():
            if not 101 <= terminal <= 164:
                raise ValueError(
                    f"{name} = {terminal} is not a terminal; terminals are numbered 101 to 164"
                )
        return channels
