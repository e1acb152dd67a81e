"""Transmission of the GSV-8: which measurement frames fall due, and which values they carry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.simulated.instruments.gsv8_converter import (
    CONVERSIONS_PER_S,
    INPUT_RANGE_MV_V,
    BridgeConverter,
)
from drivers.simulated.instruments.gsv8_frames import FLOAT32, encoded
from drivers.simulated.instruments.gsv8_memory import (
    MULTI_AXIS,
    TX_CRC16,
    TX_OFF_ALWAYS,
    GsvMemory,
)
from drivers.simulated.ports import TimePort

DIVISORS = tuple(d for d in range(1, CONVERSIONS_PER_S + 1) if CONVERSIONS_PER_S % d == 0)
"""Frame rates are the conversion rate by one of these."""


class GsvTransmission:
    """The measurement frames: while it is on, one falls due at the end of each period since it
    began, and each is sent once.

    The memory says at which rate, which channels, in which form, and what is taken off a value.
    """

    def __init__(self, port: TimePort, converter: BridgeConverter, memory: GsvMemory):
        self.converter = converter
        self.crc16 = False
        """True if frames end in a CRC-16."""
        self._port = port
        self._memory = memory
        self._on = False
        self._divisor = 1
        self._begun_us, self._sent = 0, 0
        """World time from which periods are counted, and the number of frames sent since."""
        self.switch_on()

    def switch_on(self) -> None:
        """Begin as after power-up, with what the memory says."""
        self._divisor = round(CONVERSIONS_PER_S / self._memory.rate_S_s)
        self.crc16 = bool(self._memory.tx_flags & TX_CRC16)
        self._on = not self._memory.tx_flags & TX_OFF_ALWAYS
        self._begin()

    @property
    def on(self) -> bool:
        """True if measurement frames are being sent."""
        return self._on

    def start(self) -> bool:
        """Begin to send frames; return False if it did already."""
        if self._on:
            return False
        self._on = True
        self._begin()
        return True

    def stop(self) -> bool:
        """Send no more frames; return False if it sent none."""
        was_on, self._on = self._on, False
        return was_on

    @property
    def rate(self) -> float:
        """Frame rate in frames/s."""
        return CONVERSIONS_PER_S / self._divisor

    def set_rate(self, asked_S_s: float) -> None:
        """Take the frame rate nearest to this, in frames/s, keep it in memory, and begin again."""
        self._divisor = min(DIVISORS, key=lambda d: abs(CONVERSIONS_PER_S / d - asked_S_s))
        self._memory.rate_S_s = self.rate
        self._begin()

    def frames_until(self, now_us: int) -> bytes:
        """Return the frames that fell due since the last call, up to the World time `now_us`."""
        if not self._on:
            return b""
        due = (now_us - self._begun_us) * CONVERSIONS_PER_S // (self._divisor * 1_000_000)
        first, self._sent = self._sent, max(due, self._sent)
        if first == self._sent:
            return b""
        indices = np.arange(first + 1, self._sent + 1, dtype=np.float64)
        return self._frames(self._begun_us * 1e-6 + indices * (self._divisor / CONVERSIONS_PER_S))

    def frame_now(self) -> bytes:
        """Return one frame whose period ends now."""
        return self._frames(np.array([self._port.now_us * 1e-6]))

    def input_ranges_now(self) -> npt.NDArray[np.float64]:
        """Return each channel's mean over the period that ends now, in input ranges, (8,)."""
        ranges, _ = self._convert(np.array([self._port.now_us * 1e-6]))
        return np.asarray(ranges[0])

    def _begin(self) -> None:
        """Count periods and frames from here."""
        self._begun_us, self._sent = self._port.now_us, 0
        self.converter.begin(self._divisor)

    def _frames(self, ends_s: npt.NDArray[np.float64]) -> bytes:
        """Return the frames whose periods end at these instants."""
        memory, matrix = self._memory, self.converter.sensor.matrix
        ranges, saturated = self._convert(ends_s)
        values = ranges - np.array(memory.zero)
        if memory.mode & MULTI_AXIS:  # the amplifier applies the sensor's matrix itself
            values[:, :3] = values[:, :3] * INPUT_RANGE_MV_V @ np.array(matrix).T
        elif memory.data_type == FLOAT32:
            values *= np.array(memory.user_scale)
        kept = values[:, : memory.values]
        any_saturated = np.asarray(saturated[:, : memory.values].any(axis=1))
        return encoded(kept, any_saturated, memory.data_type, self.crc16)

    def _convert(
        self, ends_s: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        return self.converter.input_ranges(ends_s, tuple(self._memory.input_type))
