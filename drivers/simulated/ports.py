"""Ports between the parts of a simulated bench: protocols and values, no implementation.

What the instruments ask of the World they stand in: a simulated instrument knows its own terminals
and the World's time, never what is wired to those terminals. The World implements these protocols;
a test may implement them with a few lines of ideal physics.

What a transport asks of an instrument on a serial line (`SerialInstrument`): it stands here so that
the World may watch such a line without knowing any transport.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.simulated.task_log import TaskLog


@dataclass(frozen=True)
class Excitation:
    """The signal at a generator channel's terminals: volts into an open circuit."""

    on: bool
    function: str
    """SCPI short name: ``SIN``, ``SQU``, ``DC``, ..."""
    frequency_Hz: float
    amplitude_V: float
    """Peak amplitude."""
    offset_V: float
    phase_rad: float


class TimePort(Protocol):
    """The World's time."""

    @property
    def now_us(self) -> int:
        """World time in integer microseconds; it never runs backwards."""
        ...


class GeneratorPort(TimePort, Protocol):
    """The World's side of a signal generator's output terminals."""

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """Put ``excitation`` on a channel's terminals from now on."""
        ...


class AnalogueInputPort(TimePort, Protocol):
    """The World's side of a data acquisition unit's input terminals."""

    def begin_acquisition(self) -> int:
        """Return a new acquisition number, which seeds the noise of that acquisition."""
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
        """Return volts at the terminals, shape ``(count, len(terminals))``.

        Sample ``i`` of terminal ``k`` is taken at
        ``start_us * 1e-6 + (first + i) / rate_S_s + skew_s[k]`` seconds of World time. Random
        access: the same acquisition and indices always give the same volts.
        """
        ...


class DigitalInputPort(Protocol):
    """The World's side of an instrument's digital inputs."""

    def input_high(self, device: str, line: str) -> bool:
        """Return the present level of input `line` of the instrument called `device`."""
        ...


class ForcePort(TimePort, Protocol):
    """The World's side of a force sensor: the force on it."""

    @property
    def noise_key(self) -> tuple[int, ...]:
        """Seeds of the amplifier's noise from now on: seed, run and point, for instance."""
        ...

    def force_N(  # noqa: N802 - the unit keeps its capital
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the true force on the sensor along its x, y, z in N, shape (n, 3), at past or
        present World times (n,) in seconds. What presses on the sensor is positive along z."""
        ...


class TaskLogPort(Protocol):
    """The log in which an instrument records that one of its tasks begins."""

    @property
    def tasks(self) -> TaskLog:
        """The bench's log of tasks and acquisitions."""
        ...


class LogPort(Protocol):
    """The World's record of who commanded what."""

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write down that ``by`` changed ``what`` of ``device`` to ``value``, now."""
        ...


class DrivePort(TimePort, LogPort, TaskLogPort, Protocol):
    """The World's side of a simulated drive."""


class AxisPort(DrivePort, Protocol):
    """The World's side of a drive with a linear axis: something may push against its carriage."""

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N along the axis's positive direction on its carriage, standing at
        `position_mm` at a World time that is not in the future."""
        ...


@dataclass(frozen=True)
class Exchange:
    """One request, as a fault plan names it, and its reply; None where there is none."""

    request: bytes
    reply: bytes | None
    device: str = ""
    """Name of the device on the line that replies."""
    delay_s: float = 0.0
    """Delay in s of the reply in real time, wire time included. In slaved time there is none: a
    client that models the line's time waits for it."""


class SerialInstrument(Protocol):
    """A simulated instrument on a serial line."""

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Take bytes from the line; returns the requests that they complete, with their replies."""
        ...

    def frames_until(self, now_us: int) -> bytes:
        """Return the bytes that the instrument has sent without a request since the last call;
        empty for most."""
        ...
