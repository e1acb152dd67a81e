"""Telegram 111 of a CMMT drive: the output image that a client writes, and words for the input one.

The output image begins with the control words STW1, POS_STW1, POS_STW2, STW2, then override,
target, speed, acceleration and deceleration; the input image with ZSW1, POS_ZSW1, POS_ZSW2, ZSW2
and MELDW, then position, speed, fault and warning.
"""

from __future__ import annotations

from dataclasses import dataclass

IMAGE_WORDS = 28
FULL_SCALE = 0x4000
"""Override, acceleration or deceleration of 100 %."""


@dataclass(frozen=True)
class OutputImage:
    """The output image, taken apart word by word."""

    words: tuple[int, ...] = (0,) * IMAGE_WORDS

    def bit(self, word: int, bit: int) -> bool:
        """Return the bit of STW1 (0), POS_STW1 (1), POS_STW2 (2) or STW2 (3)."""
        return bool(self.words[word] >> bit & 1)

    def bits(self, *bits: int) -> bool:
        """Return whether all these bits of STW1 are set."""
        return all(self.bit(0, bit) for bit in bits)

    @property
    def controlled(self) -> bool:
        """True if the client has the control of the drive."""
        return self.bit(0, 10)

    @property
    def target(self) -> int:
        """The target position, in the drive's units of position, with its sign."""
        low, high = self.words[5:7]
        value = low | high << 16
        return value - (1 << 32) if value >> 31 else value

    @property
    def motion(self) -> tuple[int, ...]:
        """The values of a task: override, target, speed, acceleration, deceleration."""
        return self.words[4:11]

    @property
    def speed(self) -> float:
        """The requested speed in the drive's units of speed, override included."""
        return (self.words[7] | self.words[8] << 16) * min(self.words[4] / FULL_SCALE, 1.0)

    @property
    def acceleration(self) -> float:
        """The requested acceleration as a share of the full one."""
        return min(max(self.words[9], 1) / FULL_SCALE, 1.0)

    @property
    def deceleration(self) -> float:
        """The requested deceleration as a share of the full one, which it is without a request."""
        return min(self.words[10] / FULL_SCALE, 1.0) if self.words[10] else 1.0


def word(*bits: bool) -> int:
    """Return bits from bit 0 up."""
    return sum(bit << index for index, bit in enumerate(bits))


def halves(value: int) -> tuple[int, int]:
    """Return a 32-bit value, low word first."""
    return value & 0xFFFF, value >> 16 & 0xFFFF
