"""Digital lines of the GSV-8: 16 in four groups, each of which is input or output as a whole."""

from __future__ import annotations

from drivers.simulated.instruments.gsv8_frames import BAD_ADDRESS, BAD_DATA, RefusedError
from drivers.simulated.ports import DigitalInputPort

GROUPS, LINES_PER_GROUP = 4, 4
OUTPUT, INPUT = 0, 1


class GsvDigitalLines:
    """The lines of the amplifier that the World knows as `name`; groups and lines from 1."""

    def __init__(self, port: DigitalInputPort, name: str):
        self._port, self._name = port, name
        self._directions = [INPUT] * GROUPS
        """Direction of each group. UNCONFIRMED: they are inputs when it is switched on."""

    def direction(self, group: int) -> int:
        """Return whether a group is `INPUT` or `OUTPUT`. Raises RefusedError for another group."""
        if not 1 <= group <= GROUPS:
            raise RefusedError(BAD_ADDRESS)
        return self._directions[group - 1]

    def set_direction(self, group: int, direction: int) -> None:
        """Make a group `INPUT` or `OUTPUT`. Raises RefusedError for another group or direction."""
        self.direction(group)
        if direction not in (INPUT, OUTPUT):
            raise RefusedError(BAD_DATA)
        self._directions[group - 1] = direction

    def level(self, line: int) -> int:
        """Return the level of a line, 1 to 16; 0 for an output, whose level is not simulated.
        Raises RefusedError for another line."""
        if not 1 <= line <= GROUPS * LINES_PER_GROUP:
            raise RefusedError(BAD_ADDRESS)
        group, place = divmod(line - 1, LINES_PER_GROUP)
        high = self._port.input_high(self._name, f"{group + 1}.{place + 1}")
        return int(high and self._directions[group])
