"""The interface of a simulated force sensor to the simulated bench: see `core` beside it for the
others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from drivers.simulated.instruments.core import InstrumentCore
from drivers.simulated.ports import Exchange, ForcePort, LogPort

__all__ = ["Exchange", "ForcePort", "ForceSensorCore", "LogPort"]


class ForceSensorCore(InstrumentCore, ABC):
    """One simulated force sensor in a World.

    It is made with the `ForcePort` that says when it is and which force acts on it, the log of the
    World, and the name under which it is logged. A frame falls due at the end of its period:
    `frames_until` gives those that did since the last call, none while the sensor does not stream.
    """

    roles = ("force_sensor",)
    alike: ClassVar[tuple[bytes, ...]] = (b"STREAM",)
    """STREAM is what the sensor sends without being asked."""
    axes: ClassVar[str] = "xyz"
    """The axes that the sensor has, such as "z"."""
    rates: ClassVar[tuple[float, ...]] = ()
    """All frame rates that it has, in frames/s; empty where any rate within a range can be set."""

    @abstractmethod
    def __init__(self, port: ForcePort, log: LogPort, name: str = "force_sensor"):
        """Switch the instrument on."""

    @abstractmethod
    def frames_until(self, now_us: int) -> bytes:
        """Return the frames that fell due since the last call, up to the World time `now_us`."""

    @property
    @abstractmethod
    def streaming(self) -> bool:
        """True if it is sending frames."""

    @property
    @abstractmethod
    def rate(self) -> float:
        """The frame rate that is set, in frames/s."""

    @property
    def matrix(self) -> tuple[tuple[float, ...], ...]:
        """The true calibration: force in N is this matrix times the raw value less `zero`."""
        return (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

    @property
    def zero(self) -> tuple[float, float, float]:
        """The raw values without force."""
        return 0.0, 0.0, 0.0
