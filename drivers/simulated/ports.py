"""What the simulated instruments ask of the World they stand in: ports, no implementation.

A simulated instrument knows its own terminals and the World's time; it never knows what is wired to
those terminals. The World implements these protocols; a test may implement them with a few lines of
ideal physics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.simulated.task_log import Beginnings


@dataclass(frozen=True)
class Excitation:
    """What a generator channel's terminals carry: volts into an open circuit."""

    on: bool
    function: str
    """SCPI short name: ``SIN``, ``SQU``, ``DC``, ..."""
    frequency_Hz: float
    amplitude_V: float
    """Peak."""
    offset_V: float
    phase_rad: float


class Timeline(Protocol):
    """The World's time."""

    @property
    def now_us(self) -> int:
        """World time in integer microseconds; it never runs backwards."""
        ...


class GeneratorPort(Timeline, Protocol):
    """Where a signal generator's output terminals end."""

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """Put ``excitation`` on a channel's terminals from now on."""
        ...


class AnalogueInputPort(Timeline, Protocol):
    """What a data acquisition unit's input terminals see."""

    def begin_acquisition(self) -> int:
        """A fresh acquisition number; it keys the noise of that acquisition."""
        ...

    def volts(
        self,
        acquisition: int,
        terminals: tuple[int, ...],
        start_us: int,
        rate_S_s: float,
        first: int,
        count: int,
        skew_s: tuple[float, ...],
    ) -> npt.NDArray[np.float64]:
        """Volts at the terminals, shape ``(count, len(terminals))``.

        Sample ``i`` of terminal ``k`` is taken at
        ``start_us * 1e-6 + (first + i) / rate_S_s + skew_s[k]`` seconds of World time. Random
        access: the same acquisition and indices always give the same volts.
        """
        ...


class BeginningsPort(Protocol):
    """Where it is told what begins."""

    @property
    def beginnings(self) -> Beginnings:
        """Of tasks and acquisitions."""
        ...


class LogPort(Protocol):
    """The World's record of who commanded what."""

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write down that ``by`` changed ``what`` of ``device`` to ``value``, now."""
        ...


class DrivePort(Timeline, LogPort, BeginningsPort, Protocol):
    """What a simulated drive stands in."""


class AxisPort(DrivePort, Protocol):
    """What a drive with a linear axis stands in: something may push against its carriage."""

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Force in N along the axis's positive direction on its carriage, standing at
        `position_mm` at a World time that is not in the future."""
        ...
