"""An ideal bench for drives: time set by hand, a wall to run into, and a telegram in hand."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any

from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive

from .ideal import IdealBench

ON, TASK, ACK, PLC, HOME = 0, 6, 7, 10, 11
RUN = (1, 2, 3, 4, 5, PLC)


@dataclass
class AxisBench(IdealBench):
    """Everything an axis stands in."""

    wall_mm: float = 1e9
    stiffness_N_mm: float = 100.0
    high: Set[tuple[str, str]] = frozenset()
    """Digital inputs that are high, by instrument and name."""

    def input_high(self, device: str, line: str) -> bool:
        return (device, line) in self.high

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        return -self.stiffness_N_mm * max(0.0, position_mm - self.wall_mm)

    def reported(self, what: str) -> list[Any]:
        """Every value that the log has of something."""
        return [value for _, name, value, _ in self.entries if name == what]


class Controller:
    """A person who writes images to a drive by hand and lets time pass."""

    def __init__(self, bench: AxisBench, drive: CmmtDrive, by: str = "test"):
        self.bench, self.drive, self.by = bench, drive, by

    @classmethod
    def of_a_drive(cls, **settings: Any) -> Controller:
        """A drive of its own on a bench of its own."""
        bench = AxisBench()
        return cls(bench, CmmtDrive(SimulatedCmmtSettings(**settings), bench))

    def wait(self, seconds: float) -> None:
        """Let time pass and keep talking to the drive."""
        for _ in range(round(seconds * 100)):
            self.bench.now_us += 10_000
            self.drive.read(100, 1, self.by)

    def write(
        self,
        *bits: int,
        target: int = 0,
        speed: int = 20_000,
        pos_stw1: int = 0x8100,
        pos_stw2: int = 0xC000,
        stw2: int = 0,
        rate: int = 0x4000,
    ) -> None:
        """One output image; `bits` are STW1's."""
        stw1 = sum(1 << bit for bit in bits)
        halves = [target & 0xFFFF, target >> 16 & 0xFFFF, speed & 0xFFFF, speed >> 16]
        words = [stw1, pos_stw1, pos_stw2, stw2, 0x4000, *halves, rate, rate]
        self.drive.write(0, words + [0] * 17, self.by)

    @property
    def words(self) -> Sequence[int]:
        """The input image."""
        return self.drive.read(100, 28, self.by)

    def zsw1(self, bit: int) -> bool:
        """A bit of status word 1."""
        return bool(self.words[0] >> bit & 1)

    @property
    def position(self) -> int:
        """XIST_A."""
        value = self.words[5] | self.words[6] << 16
        return value - (1 << 32) if value >> 31 else value

    @property
    def fault(self) -> int:
        """FAULT_CODE."""
        return self.words[9]

    def enable(self) -> None:
        """Power on."""
        self.write(*RUN)
        self.write(*RUN, ON)
        self.wait(0.05)
        assert self.zsw1(2)

    def home(self) -> None:
        """Power on and homed."""
        self.enable()
        self.write(*RUN, ON, HOME)
        self.wait(2.0)
        self.write(*RUN, ON)
        assert self.zsw1(11)

    def parameter(self, number: int, elements: int = 1) -> bytes | int:
        """A parameter's bytes, or the mailbox's result code where it is not done."""
        for address, value in ((500, number), (501, 0), (502, elements), (503, 1)):
            self.drive.write(address, [value], self.by)
        (result,) = self.drive.read(503, 1, self.by)
        if result != 0x10:
            return result
        (length,) = self.drive.read(504, 1, self.by)
        words = self.drive.read(510, (length + 1) // 2, self.by)
        return b"".join(word.to_bytes(2, "little") for word in words)[:length]

    def set_parameter(self, number: int, raw: bytes) -> int:
        """Write a parameter; the result code."""
        for address, value in ((500, number), (501, 0), (502, 1), (504, len(raw))):
            self.drive.write(address, [value], self.by)
        words = [int.from_bytes(raw[i : i + 2], "little") for i in range(0, len(raw), 2)]
        self.drive.write(510, words, self.by)
        self.drive.write(503, [2], self.by)
        (result,) = self.drive.read(503, 1, self.by)
        return result
