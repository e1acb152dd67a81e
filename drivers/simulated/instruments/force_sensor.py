"""The interface of a simulated force sensor to the simulated bench: the base class of every such
core.

A laboratory's own simulator is a subclass, registered in the entry-point group ``rig.simulators``
under the name of its driver. The bench builds it over the World, puts it behind a serial or TCP
server as its `link` says, and writes its table into the bench file. docs/add-a-driver.md has one.

A core holds the instrument's state and speaks its protocol. It never waits, reads no wall clock and
opens nothing: bytes of a client come in through `exchanges`, and what falls due on its own goes out
through `frames_until`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, Literal

from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.ports import Exchange, ForcePort, LogPort

__all__ = ["Exchange", "ForcePort", "ForceSensorCore", "LogPort"]


class ForceSensorCore(ABC):
    """One simulated force sensor in a World.

    It is made with the `ForcePort` that says when it is and which force acts on it, the log of the
    World, and the name under which it is logged.
    """

    title: ClassVar[str] = ""
    """Maker and model, for messages."""
    link: ClassVar[Literal["serial", "tcp"]] = "serial"
    """Kind of the instrument's connection: a serial port, or a TCP port with the same bytes."""
    axes: ClassVar[str] = "xyz"
    """The axes that the sensor has, such as "z"."""
    rates: ClassVar[tuple[float, ...]] = ()
    """All frame rates that it has, in frames/s; empty where any rate within a range can be set."""
    alike: ClassVar[tuple[bytes, ...]] = (b"STREAM",)
    """Beginnings of requests that are like one another: of each, the contract's walk of faults
    visits the first in a step. STREAM is what the sensor sends without being asked."""
    disturbances: ClassVar[tuple[str, ...]] = ()
    """Kinds of a fault plan that `disturb` takes."""
    vendor: str = ""
    model: str = ""
    serial_number: str = ""
    """Begins with SIM; empty where the instrument states none."""
    firmware: str = ""

    @abstractmethod
    def __init__(self, port: ForcePort, log: LogPort, name: str = "force_sensor"):
        """Switch the instrument on."""

    @abstractmethod
    def bench_settings(self, where: str) -> dict[str, Any]:
        """Return the keys of a bench file's table for the driver, in addition to ``driver`` and
        ``timeout_s``. `where` is the path of a serial port or ``socket://127.0.0.1:4001``."""

    @abstractmethod
    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Take bytes of a client; return the requests that they complete, with their replies."""

    @abstractmethod
    def frames_until(self, now_us: int) -> bytes:
        """Return the frames that fell due since the last call, up to the World time `now_us`; no
        bytes while the sensor does not stream. A frame falls due at the end of its period."""

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

    def wire_dialect(self) -> WireDialect:
        """Return how its protocol states errors, for fault plans."""
        return WireDialect()

    def disturb(self, kind: Any, begin_s: float, **keys: Any) -> None:
        """Take a disturbance of a fault plan from a World time on; `disturbances` names those that
        it can take. `keys` are those of the kind in docs/fault-plans.md, such as ``for_s``."""
        raise NotImplementedError(f"{self.title} cannot be {kind}")
