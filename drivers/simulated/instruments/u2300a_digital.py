"""Digital channels of a U2300A, as ``MEAS:DIG`` and ``CONF:DIG:DIR`` have them."""

from __future__ import annotations

from drivers.simulated.ports import DigitalInputPort
from drivers.simulated.transports.scpi import ScpiError

DIGITAL_BITS = {501: 8, 502: 8, 503: 4, 504: 4}
"""Bits of each digital channel. They are inputs when the unit is switched on (UNCONFIRMED), and may
be read while an acquisition runs (UNCONFIRMED)."""


class DigitalChannels:
    """The channels of the unit that the World knows as `name`; each is input or output as a
    whole."""

    def __init__(self, port: DigitalInputPort, name: str):
        self._port, self._name = port, name
        self.reset()

    def reset(self) -> None:
        """Make all of them inputs."""
        self._directions = dict.fromkeys(DIGITAL_BITS, "INP")

    def set_direction(self, channels: tuple[int, ...], direction: str) -> None:
        """Make channels inputs (INP) or outputs (OUTP). Raises ScpiError if one does not exist."""
        for channel in _known(channels):
            self._directions[channel] = direction

    def directions(self, channels: tuple[int, ...]) -> list[str]:
        """Return INP or OUTP of each channel. Raises ScpiError if one does not exist."""
        return [self._directions[channel] for channel in _known(channels)]

    def values(self, channels: tuple[int, ...]) -> list[int]:
        """Return the bits of each channel as one number; what an output reads back as is
        UNCONFIRMED. Raises ScpiError if a channel does not exist."""
        return [
            sum(self._bit(channel, bit) << bit for bit in range(DIGITAL_BITS[channel]))
            for channel in _known(channels)
        ]

    def _bit(self, channel: int, bit: int) -> bool:
        if self._directions[channel] != "INP":
            return False
        return self._port.input_high(self._name, f"{channel}.{bit}")


def _known(channels: tuple[int, ...]) -> tuple[int, ...]:
    if not all(channel in DIGITAL_BITS for channel in channels):
        raise ScpiError(-222, "no such channel")
    return channels
