"""Settings of a U2300A: its analogue inputs, and the scan of them that an acquisition repeats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from drivers.simulated.instruments.u2300a_models import SimulatedDaqModel
from drivers.simulated.transports.scpi import ScpiError, ScpiQuantity

LOWEST_RATE_S_s = 3
SMALLEST_BLOCK = 1
"""Points per channel of the smallest continuous block (UNCONFIRMED)."""
DEFAULT_RATE_S_s = 1000
DEFAULT_POINTS = 500
FIRST_CHANNEL = 101


@dataclass(frozen=True)
class SimulatedInput:
    """Settings of one channel."""

    range_V: float = 10.0
    polarity: str = "BIP"
    signal_type: str = "SING"


class AnalogueInputs:
    """The unit's analogue channels, from 101, with the settings of each."""

    def __init__(self, model: SimulatedDaqModel, report: Callable[[ScpiError], None]):
        self._model = model
        self._report = report
        """Queues an error although the command is carried out."""
        self.reset()

    def reset(self) -> None:
        """Make all of them 10 V, bipolar, single-ended."""
        channels = range(FIRST_CHANNEL, FIRST_CHANNEL + self._model.channels)
        self._inputs = dict.fromkeys(channels, SimulatedInput())

    def of(self, channels: tuple[int, ...]) -> tuple[SimulatedInput, ...]:
        """Return the settings of some channels. Raises ScpiError if one does not exist."""
        return tuple([self._inputs[channel] for channel in self.known(channels)])

    def known(self, channels: tuple[int, ...]) -> tuple[int, ...]:
        """Return the channels. Raises ScpiError if one of them does not exist."""
        if not all(channel in self._inputs for channel in channels):
            raise ScpiError(-222, "no such channel")
        return channels

    def change(self, channels: tuple[int, ...], **settings: Any) -> None:
        """Change settings, fields of `SimulatedInput`, of some channels. Raises ScpiError, before
        it changes one, if a channel does not exist."""
        for channel in self.known(channels):
            self._inputs[channel] = replace(self._inputs[channel], **settings)

    def set_range(self, channels: tuple[int, ...], asked: ScpiQuantity) -> None:
        """Take the smallest range that is not below what is asked for, or the largest, and report
        it if it differs."""
        ranges = self._model.ranges_V
        keywords = {"MIN": ranges[-1], "MAX": ranges[0], "DEF": ranges[0]}
        asked_V = keywords.get(asked.keyword, asked.value)
        chosen = min((r for r in ranges if r >= asked_V), default=ranges[0])
        known = self.known(channels)
        if chosen != asked_V:
            self._report(ScpiError(-222, "no such range; the next one was taken"))  # UNCONFIRMED
        for channel in known:
            self._inputs[channel] = replace(self._inputs[channel], range_V=chosen)


class ScanSettings:
    """The channels of a scan, how often it is made, and how many scans make an acquisition.

    The scan list is never one whose rate the model does not reach or whose points the buffer does
    not hold: such a list is refused, and rate and points are set within the bounds given here.
    """

    def __init__(self, model: SimulatedDaqModel, buffer_samples: int):
        self._model, self._buffer_samples = model, buffer_samples
        self.reset()

    def reset(self) -> None:
        """Set the defaults of the unit: channel 101, 500 times, at 1 kS/s."""
        self.channels: tuple[int, ...] = (FIRST_CHANNEL,)
        self.rate_S_s = DEFAULT_RATE_S_s
        self.points = DEFAULT_POINTS
        """Points per channel of a single shot."""
        self.block_points = DEFAULT_POINTS
        """Points per channel of a block of a continuous acquisition."""
        self.burst = False
        """True if the channels of a scan follow each other as fast as the model can."""

    def rate_bounds(self) -> tuple[int, int]:
        """Return the lowest and the highest rate per channel, in S/s, for the scan list."""
        return LOWEST_RATE_S_s, self._model.highest_rate(len(self.channels))

    def points_bounds(self) -> tuple[int, int]:
        """Return the fewest and the most points per channel of a single shot."""
        return 1, self._buffer_samples // len(self.channels)

    def block_bounds(self) -> tuple[int, int]:
        """Return the same of a block."""
        return SMALLEST_BLOCK, self._buffer_samples // len(self.channels)

    def choose(self, channels: tuple[int, ...]) -> None:
        """Take a scan list. Raises ScpiError while rate or points would be too many for it
        (UNCONFIRMED how)."""
        if not channels or len(set(channels)) != len(channels):
            raise ScpiError(-224, "a scan names each channel once, and one at least")
        if self.rate_S_s > self._model.highest_rate(len(channels)):
            raise ScpiError(-221, "sampling rate too high for the scan list")
        if max(self.points, self.block_points) * len(channels) > self._buffer_samples:
            raise ScpiError(-221, "too many points for the scan list")
        self.channels = channels

    def skew_s(self) -> tuple[float, ...]:
        """Return the delay of each channel of a scan after the first, in s."""
        return self._model.skew_s(len(self.channels), self.rate_S_s, self.burst)
