"""Settings of the GSV-8 that survive a power cycle, and the bits of its two words of flags."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.simulated.instruments.gsv8_converter import CHANNELS, INPUT_RANGE_MV_V
from drivers.simulated.instruments.gsv8_frames import FLOAT32

MULTI_AXIS, AUTO_FILTER, MIN_MAX, WRITE_LOCK = 0x01, 0x02, 0x04, 0x80
KNOWN_MODE = MULTI_AXIS | AUTO_FILTER | MIN_MAX | WRITE_LOCK

TX_OFF_NOW, TX_OFF_ALWAYS, TX_CRC16 = 0x0001, 0x0002, 0x0020
WRITABLE_TX_FLAGS = 0x002E

FASTEST_FLOATS_S_s = 12_000.0
FASTEST_S_s, SLOWEST_S_s = 48_000.0, 1.0


@dataclass
class GsvMemory:
    """The settings that survive a power cycle, as they leave the factory."""

    rate_S_s: float = 10.0
    mode: int = AUTO_FILTER
    """UNCONFIRMED; multi-axis is off as delivered."""
    data_type: int = FLOAT32
    tx_flags: int = 0
    values: int = CHANNELS
    """Number of values in a frame: channels 1 to this one."""
    user_scale: list[float] = field(default_factory=lambda: [INPUT_RANGE_MV_V] * CHANNELS)
    zero: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    """Zero of each channel in input ranges."""
    input_type: list[int] = field(default_factory=lambda: [0] * CHANNELS)
    output_type: list[int] = field(default_factory=lambda: [1] * CHANNELS)
    output_offset: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    output_scale: list[float] = field(default_factory=lambda: [1.0] * CHANNELS)

    @property
    def fastest_rate(self) -> float:
        """The largest frame rate, in frames/s, with the data type that is set."""
        return FASTEST_FLOATS_S_s if self.data_type == FLOAT32 else FASTEST_S_s

    @property
    def locked(self) -> bool:
        """True if commands that write are refused."""
        return bool(self.mode & WRITE_LOCK)
