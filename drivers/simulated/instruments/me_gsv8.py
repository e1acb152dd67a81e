"""Simulated ME-Messsysteme GSV-8 amplifier with a three-axis force sensor, as a core without I/O.

It may keep its settings, ask the World for the force on the sensor at given instants, and send what
its converter makes of it. It may not wait, and it knows no serial port: bytes come in through
`Gsv8.receive`, responses go out of it, and measurement frames come out of `Gsv8.frames_until`.

`gsv8_frames` has the frames as bytes, `gsv8_commands` the table of commands and what they act on:
`gsv8_memory`, the settings; `gsv8_transmission`, the frames that fall due; `gsv8_digital_lines`.
The sensor's bridges sit on channels 1 to 3; channels 4 to 8 are open and carry noise. What the
converter makes of them is in `gsv8_converter`.

Sources: ME-Messsysteme, GSV Communication Protocol Specification (ba-gsvcom_en, 11/2022) and GSV-8
manual (ba-gsv8_en). What they leave open is marked UNCONFIRMED, each in one place.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, Protocol

from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.instruments.disturbed_converter import KINDS
from drivers.simulated.instruments.force_sensor import ForceSensorCore
from drivers.simulated.instruments.gsv8_commands import GsvAmplifier, GsvIdentity, answered
from drivers.simulated.instruments.gsv8_converter import (
    CONVERSIONS_PER_S,
    BridgeConverter,
    Sensor,
)
from drivers.simulated.instruments.gsv8_digital_lines import GsvDigitalLines
from drivers.simulated.instruments.gsv8_frames import (
    GSV_DIALECT,
    GsvRequest,
    response,
    take_request,
)
from drivers.simulated.instruments.gsv8_memory import FASTEST_FLOATS_S_s, GsvMemory
from drivers.simulated.instruments.gsv8_transmission import DIVISORS, GsvTransmission
from drivers.simulated.ports import DigitalInputPort, Exchange, ForcePort, LogPort

_RATES_S_s = sorted(CONVERSIONS_PER_S / divisor for divisor in DIVISORS)


class ForceAndInputs(ForcePort, DigitalInputPort, Protocol):
    """The World's side of the sensor and of the digital inputs."""


class Gsv8(ForceSensorCore):
    """The amplifier's protocol core; ``name`` is its name in the World's log.

    ``memory`` is what an earlier user left in it. Streaming is on when it is switched on.
    """

    title = "ME GSV-8"
    rates = tuple(rate for rate in _RATES_S_s if rate <= FASTEST_FLOATS_S_s)
    alike = (b"A2 ", b"14 ")
    """True: the three channels are set up alike, so faults apply to one of them."""
    disturbances = KINDS
    vendor, model, serial_number = "ME-Messsysteme", "GSV-8", "SIM00001"

    def __init__(
        self,
        port: ForceAndInputs,
        log: LogPort,
        name: str = "force_sensor",
        sensor: Sensor | None = None,
        memory: GsvMemory | None = None,
    ):
        memory = memory or GsvMemory()
        self._converter = BridgeConverter(port, sensor or Sensor())
        self.amplifier = GsvAmplifier(
            GsvIdentity(serial_number=self.serial_number),
            memory,
            GsvTransmission(port, self._converter, memory),
            GsvDigitalLines(port, name),
            partial(log.log, name),
        )
        self._input = bytearray()
        """Bytes received that do not make a request yet."""

    def receive(self, data: bytes, by: str) -> bytes:
        """Take bytes from a client; the responses, and the frame of a single value."""
        return b"".join(exchange.reply or b"" for exchange in self.exchanges(data, by))

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Return the same, request by request."""
        self._input += data
        while (taken := take_request(self._input, by)) is not None:
            if isinstance(taken, GsvRequest):
                yield Exchange(taken.label, answered(self.amplifier, taken))
            else:
                self.amplifier.last_error = taken
                yield Exchange(b"", response(taken, b"", crc=False))

    def frames_until(self, now_us: int) -> bytes:
        """Return the measurement frames that fell due since the last call, up to ``now_us``."""
        return self.amplifier.transmission.frames_until(now_us)

    def wire_dialect(self) -> WireDialect:
        """Return how its responses state errors."""
        return GSV_DIALECT

    def disturb(
        self, kind: str, begin_s: float, axis: str = "z", force_N: float = 0.0, **keys: float
    ) -> None:
        """Take a disturbance of a fault plan from a World time on; `force_N` is what a wrong value
        adds along `axis`."""
        input_types = tuple(self.amplifier.memory.input_type)
        self._converter.disturb(kind, begin_s, self.axes.index(axis), force_N, input_types, **keys)

    def bench_settings(self, where: str) -> dict[str, Any]:
        """Return the keys of a bench file's table for the driver."""
        return {
            "port": where,
            "nominal_force_N": 50.0,
            "max_force_N": 40.0,
            "matrix_N_mV_V": [list(row) for row in self.sensor.matrix],
        }

    @property
    def sensor(self) -> Sensor:
        """The sensor that the bridges belong to."""
        return self._converter.sensor

    @sensor.setter
    def sensor(self, sensor: Sensor) -> None:
        self._converter.sensor = sensor

    @property
    def matrix(self) -> tuple[tuple[float, ...], ...]:
        """The sensor's matrix, force in N by bridge output in mV/V."""
        return self.sensor.matrix

    @property
    def zero(self) -> tuple[float, float, float]:
        """The bridges' output in mV/V without force."""
        return self.sensor.zero_mV_V

    @property
    def streaming(self) -> bool:
        """True if measurement frames are being sent."""
        return self.amplifier.transmission.on

    @property
    def rate(self) -> float:
        """Frame rate in frames per second."""
        return self.amplifier.transmission.rate
