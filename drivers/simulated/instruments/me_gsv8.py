"""Simulated ME-Messsysteme GSV-8 amplifier with a three-axis force sensor, as a core without I/O.

It may keep its settings, ask the World for the force on the sensor at given instants, and send what
its converter makes of it. It may not wait, and it knows no serial port: bytes come in through
`Gsv8.receive`, responses go out of it, and measurement frames come out of `Gsv8.frames_until`.

The sensor's bridges sit on channels 1 to 3; channels 4 to 8 are open and carry noise. What the
converter makes of them is in `gsv8_converter`, the frames as bytes are in `gsv8_frames`.

Sources: ME-Messsysteme, GSV Communication Protocol Specification (ba-gsvcom_en, 11/2022) and GSV-8
manual (ba-gsv8_en). What they leave open is marked UNCONFIRMED, each in one place.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.instruments.disturbed_converter import KINDS
from drivers.simulated.instruments.force_sensor import ForceSensorCore
from drivers.simulated.instruments.gsv8_converter import (
    BRIDGE_RANGES_MV_V,
    CHANNELS,
    CONVERSIONS_PER_S,
    INPUT_RANGE_MV_V,
    BridgeConverter,
    Sensor,
    input_range,
)
from drivers.simulated.instruments.gsv8_frames import (
    BAD_ADDRESS,
    BAD_BITS,
    BAD_DATA,
    DONE,
    DONE_CHANGED,
    FLOAT32,
    GSV_DIALECT,
    INT16,
    INT24,
    LOCKED,
    NO_SUCH_PARAMETER,
    NOT_IMPLEMENTED,
    RATE_TOO_HIGH,
    TOO_LARGE,
    TOO_SMALL,
    UNKNOWN,
    WRONG_COUNT,
    GsvRequest,
    RefusedError,
    encoded,
    offset_binary,
    response,
    take_request,
)
from drivers.simulated.ports import DigitalInputPort, Exchange, ForcePort, LogPort

MODEL = 0x08
DIVISORS = tuple(d for d in range(1, CONVERSIONS_PER_S + 1) if CONVERSIONS_PER_S % d == 0)
"""Frame rates are the conversion rate by one of these."""
FASTEST_FLOATS_S_s = 12_000.0
FASTEST_S_s, SLOWEST_S_s = 48_000.0, 1.0

MULTI_AXIS, AUTO_FILTER, MIN_MAX, WRITE_LOCK = 0x01, 0x02, 0x04, 0x80
KNOWN_MODE = MULTI_AXIS | AUTO_FILTER | MIN_MAX | WRITE_LOCK

TX_OFF_NOW, TX_OFF_ALWAYS, TX_CRC16 = 0x0001, 0x0002, 0x0020
WRITABLE_TX_FLAGS = 0x002E

DIGITAL_GROUPS, LINES_PER_GROUP = 4, 4

UNSERVED = frozenset(
    {0x00, *range(0x08, 0x0B), *range(0x0F, 0x13), *range(0x17, 0x1F), *range(0x20, 0x23), 0x25}
    | {0x2A, *range(0x32, 0x3A), 0x3C, 0x44, 0x45, 0x47, 0x48, *range(0x4B, 0x63)}
    | {*range(0x64, 0x78), *range(0x7A, 0x80), *range(0x86, 0x8A), *range(0x8C, 0x8E)}
    | {*range(0x90, 0xA2)}
)
"""Commands of the protocol that this simulator answers with "not implemented"."""


@dataclass
class GsvMemory:
    """The settings that survive a power cycle, as they leave the factory."""

    rate_S_s: float = 10.0
    mode: int = AUTO_FILTER
    """UNCONFIRMED; multi-axis is off as delivered."""
    data_type: int = FLOAT32
    tx_flags: int = 0
    values: int = CHANNELS
    user_scale: list[float] = field(default_factory=lambda: [INPUT_RANGE_MV_V] * CHANNELS)
    zero: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    """Zero of each channel in input ranges."""
    input_type: list[int] = field(default_factory=lambda: [0] * CHANNELS)
    output_type: list[int] = field(default_factory=lambda: [1] * CHANNELS)
    output_offset: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    output_scale: list[float] = field(default_factory=lambda: [1.0] * CHANNELS)


Answer = tuple[int, bytes]
"""Error code and data."""


@dataclass(frozen=True)
class SimulatedCommand:
    """One command: what it does, which numbers of parameter bytes it takes, whether it writes."""

    act: Callable[[GsvRequest], Answer | None]
    lengths: tuple[int, ...] = (0,)
    writes: bool = False


class ForceAndInputs(ForcePort, DigitalInputPort, Protocol):
    """The World's side of the sensor and of the digital inputs."""


class Gsv8(ForceSensorCore):
    """The amplifier's protocol core; ``name`` is its name in the World's log.

    ``memory`` is what an earlier user left in it. Streaming is on when it is switched on.
    """

    title = "ME GSV-8"
    rates = tuple(sorted(CONVERSIONS_PER_S / d for d in DIVISORS if CONVERSIONS_PER_S / d <= 12e3))
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
        serial_number: str = "SIM00001",
        firmware: tuple[int, int] = (1, 60),
    ):
        self.memory = memory or GsvMemory()
        self.serial_number = serial_number
        self.firmware_version = firmware
        self.model_number = MODEL
        self._port = port
        self._log = log
        self._name = name
        self._directions = [1] * DIGITAL_GROUPS
        """Directions of the lines. UNCONFIRMED: they are inputs when it is switched on."""
        self._input = bytearray()
        self._origin_us, self._sent = 0, 0
        self._divisor, self._period_s = 1, 0.0
        self._crc16 = self._streaming = False
        self._last_error = 0
        self._converter = BridgeConverter(port, sensor or Sensor())
        self._commands = self._command_table()
        self._switch_on()

    # --- what the servers use ----------------------------------------------------------------

    def receive(self, data: bytes, by: str) -> bytes:
        """Take bytes from a client; the responses, and the frame of a single value."""
        return b"".join(exchange.reply or b"" for exchange in self.exchanges(data, by))

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Return the same, request by request."""
        self._input += data
        while (taken := take_request(self._input, by)) is not None:
            if isinstance(taken, GsvRequest):
                yield Exchange(taken.label, self._answer(taken))
            else:
                self._last_error = taken
                yield Exchange(b"", response(taken, b"", crc=False))

    def frames_until(self, now_us: int) -> bytes:
        """Return the measurement frames that fell due since the last call, up to ``now_us``."""
        if not self.streaming:
            return b""
        due = (now_us - self._origin_us) * CONVERSIONS_PER_S // (self._divisor * 1_000_000)
        first, self._sent = self._sent, max(due, self._sent)
        if first == self._sent:
            return b""
        indices = np.arange(first + 1, self._sent + 1, dtype=np.float64)
        return self._frames(self._origin_us * 1e-6 + indices * self._period_s)

    def wire_dialect(self) -> WireDialect:
        """Return how its responses state errors."""
        return GSV_DIALECT

    def disturb(
        self, kind: str, begin_s: float, axis: str = "z", force_N: float = 0.0, **keys: float
    ) -> None:
        """Take a disturbance of a fault plan from a World time on; `force_N` is what a wrong value
        adds along `axis`."""
        self._converter.disturb(
            kind, begin_s, self.axes.index(axis), force_N, tuple(self.memory.input_type), **keys
        )

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
        return self._streaming

    @property
    def rate(self) -> float:
        """Frame rate in frames per second."""
        return CONVERSIONS_PER_S / self._divisor

    # --- frames in ---------------------------------------------------------------------------

    def _answer(self, request: GsvRequest) -> bytes | None:
        try:
            answer = self._command(request).act(request)
        except RefusedError as refused:
            self._last_error = refused.code
            answer = refused.code, b""
        if answer is None:
            return self._frames(np.array([self._now_s()])) if request.number == 0x3B else None
        return response(*answer, request.crc)

    def _command(self, request: GsvRequest) -> SimulatedCommand:
        """Return the table's entry for a request that may be carried out."""
        command = self._commands.get(request.number)
        if command is None:
            raise RefusedError(NOT_IMPLEMENTED if request.number in UNSERVED else UNKNOWN)
        if len(request.parameters) not in command.lengths:
            raise RefusedError(WRONG_COUNT)
        if command.writes and self.memory.mode & WRITE_LOCK:
            raise RefusedError(LOCKED)  # UNCONFIRMED code
        return command

    # --- the command table -------------------------------------------------------------------

    def _command_table(self) -> dict[int, SimulatedCommand]:
        return {
            0x01: SimulatedCommand(self._get_interface, (0, 1)),
            0x0C: SimulatedCommand(self._set_zero, (1,), writes=True),
            0x1F: SimulatedCommand(lambda _: (DONE, self.serial_number.encode())),
            0x23: SimulatedCommand(self._stop_transmission),
            0x24: SimulatedCommand(self._start_transmission),
            0x26: SimulatedCommand(lambda _: (DONE, struct.pack(">I", self.memory.mode))),
            0x27: SimulatedCommand(self._set_mode, (4,)),
            0x2B: SimulatedCommand(lambda _: (DONE, struct.pack(">HH", *self.firmware_version))),
            0x3A: SimulatedCommand(self._get_raw_value, (1,)),
            0x3B: SimulatedCommand(lambda _: None),
            0x42: SimulatedCommand(lambda _: (DONE, struct.pack(">I", self._last_error)), (0, 1)),
            0x43: SimulatedCommand(lambda _: (DONE, bytes(4)), (0, 1)),
            0x49: SimulatedCommand(self._get_mapping, (1,)),
            0x4A: SimulatedCommand(self._set_mapping, (3,), writes=True),
            0x59: SimulatedCommand(self._get_direction, (1,)),
            0x5A: SimulatedCommand(self._set_direction, (2,), writes=True),
            0x5D: SimulatedCommand(self._get_level, (1,)),
            0x63: SimulatedCommand(self._rate_range, (1,)),
            0x78: SimulatedCommand(self._reset),
            0x80: SimulatedCommand(self._get_tx_mode, (1,)),
            0x81: SimulatedCommand(self._set_tx_mode, (3,), writes=True),
            0x8A: SimulatedCommand(lambda _: (DONE, struct.pack(">f", self.rate))),
            0x8B: SimulatedCommand(self._write_rate, (4,), writes=True),
            0xA2: SimulatedCommand(self._get_input_type, (2,)),
            0xA3: SimulatedCommand(self._set_input_type, (2,), writes=True),
            **self._by_channel(0x14, 0x15, ">f", "user_scale"),
            **self._by_channel(0x0D, 0x0E, ">B", "output_type"),
            **self._by_channel(0x04, 0x05, ">f", "output_offset"),
            **self._by_channel(0x06, 0x07, ">f", "output_scale"),
        }

    def _by_channel(
        self, read: int, write: int, form: str, name: str
    ) -> dict[int, SimulatedCommand]:
        """Return the commands of a setting that every channel has: one reads it, another writes
        it."""

        def get(request: GsvRequest) -> Answer:
            return DONE, struct.pack(form, getattr(self.memory, name)[_channel(request)])

        def put(request: GsvRequest) -> Answer:
            (value,) = struct.unpack(form, request.parameters[1:])
            if not math.isfinite(value) or (form == ">B" and value > 7):
                raise RefusedError(BAD_DATA)
            getattr(self.memory, name)[_channel(request)] = value
            self._log_change(f"{name}.{request.parameters[0]}", value, request.by)
            return DONE, b""

        return {
            read: SimulatedCommand(get, (1,)),
            write: SimulatedCommand(put, (1 + struct.calcsize(form),), writes=True),
        }

    def _get_interface(self, request: GsvRequest) -> Answer:
        """Apply the flags, if there are any: 01 stream off, 10 on; bit 2 fast frames; bit 3 CRC-16.

        That a request without bit 3 switches the CRC off, and the last two bytes of the reply, are
        UNCONFIRMED.
        """
        if request.parameters:
            flags = request.parameters[0]
            if flags & 0xF4:
                raise RefusedError(BAD_BITS)
            if flags & 3 == 3:
                raise RefusedError(BAD_DATA)
            if flags & 3:
                self._stream(flags & 3 == 2, request.by)
            self._crc16 = bool(flags & 8)
        state = self.memory.values - 1 << 4 | self._streaming << 3 | self.memory.data_type
        return DONE, bytes((self.model_number, state, 0, 0))

    def _get_direction(self, request: GsvRequest) -> Answer:
        """Return the direction of a group of digital lines: 1 input, 0 output."""
        return DONE, bytes((self._directions[self._group(request)],))

    def _set_direction(self, request: GsvRequest) -> Answer:
        group, direction = self._group(request), request.parameters[1]
        if direction > 1:
            raise RefusedError(BAD_DATA)
        self._directions[group] = direction
        self._log_change(f"direction.{group + 1}", direction, request.by)
        return DONE, b""

    def _group(self, request: GsvRequest) -> int:
        number = request.parameters[0]
        if not 1 <= number <= DIGITAL_GROUPS:
            raise RefusedError(BAD_ADDRESS)
        return number - 1

    def _get_level(self, request: GsvRequest) -> Answer:
        """Return the level of a digital line, 1 to 16; the level of an output is not simulated."""
        number = request.parameters[0] - 1
        if not 0 <= number < DIGITAL_GROUPS * LINES_PER_GROUP:
            raise RefusedError(BAD_ADDRESS)
        group, line = divmod(number, LINES_PER_GROUP)
        high = self._port.input_high(self._name, f"{group + 1}.{line + 1}")
        return DONE, struct.pack(">H", int(high and self._directions[group]))

    def _set_zero(self, request: GsvRequest) -> Answer:
        """Make the mean since the last frame zero; channel 0 means all."""
        which = request.parameters[0]
        if which > CHANNELS:
            raise RefusedError(BAD_ADDRESS)
        ranges, _ = self._convert(np.array([self._now_s()]))
        for channel in range(CHANNELS) if which == 0 else (which - 1,):
            self.memory.zero[channel] = float(ranges[0, channel])
        self._log_change("zero", which, request.by)
        return DONE, b""

    def _stop_transmission(self, request: GsvRequest) -> Answer:
        self._stream(False, request.by)
        return DONE, b""

    def _start_transmission(self, request: GsvRequest) -> Answer:
        self._stream(True, request.by)
        return DONE, b""

    def _set_mode(self, request: GsvRequest) -> Answer:
        """Set the mode. It is answered although the lock is on, since nothing else could take it
        off (UNCONFIRMED)."""
        (mode,) = struct.unpack(">I", request.parameters)
        if mode & ~KNOWN_MODE:
            raise RefusedError(BAD_BITS)
        if self.memory.mode & mode & WRITE_LOCK:
            raise RefusedError(LOCKED)
        self.memory.mode = mode
        self._log_change("mode", mode, request.by)
        return DONE, b""

    def _get_raw_value(self, request: GsvRequest) -> Answer:
        """Return one channel as 24-bit offset binary (UNCONFIRMED form)."""
        channel = _channel(request)
        ranges, _ = self._convert(np.array([self._now_s()]))
        return DONE, offset_binary(float(ranges[0, channel]), 3)

    def _get_mapping(self, request: GsvRequest) -> Answer:
        if request.parameters[0] != 0:
            raise RefusedError(NO_SUCH_PARAMETER)
        return DONE, struct.pack(">H", self.memory.values)

    def _set_mapping(self, request: GsvRequest) -> Answer:
        """Index 0: the number of values in a frame, channels 1 to that number."""
        index, values = struct.unpack(">BH", request.parameters)
        if index != 0:
            raise RefusedError(NO_SUCH_PARAMETER)
        if not 1 <= values <= CHANNELS:
            raise RefusedError(BAD_DATA)
        self.memory.values = values
        self._log_change("values", values, request.by)
        return DONE, b""

    def _rate_range(self, request: GsvRequest) -> Answer:
        """Index 0: the largest rate as things are set, 1: the smallest."""
        index = request.parameters[0]
        if index > 1:
            raise RefusedError(BAD_ADDRESS)
        return DONE, struct.pack(">f", SLOWEST_S_s if index else self._fastest())

    def _reset(self, request: GsvRequest) -> None:
        self._log_change("reset", None, request.by)
        self._switch_on()

    def _get_tx_mode(self, request: GsvRequest) -> Answer:
        now = 0 if self._streaming else TX_OFF_NOW
        crc = TX_CRC16 if self._crc16 else 0
        values = {0: self.memory.tx_flags & ~TX_CRC16 | now | crc, 1: self.memory.data_type}
        if request.parameters[0] not in values:
            raise RefusedError(NO_SUCH_PARAMETER)  # UNCONFIRMED: index 2, the channel range
        return DONE, struct.pack(">H", values[request.parameters[0]])

    def _set_tx_mode(self, request: GsvRequest) -> Answer:
        index, value = struct.unpack(">BH", request.parameters)
        if index == 0:
            self.memory.tx_flags = value & WRITABLE_TX_FLAGS
            self._crc16 = bool(value & TX_CRC16)
        elif index == 1 and value in (INT16, INT24, FLOAT32):
            if value == FLOAT32 and self.rate > FASTEST_FLOATS_S_s:
                raise RefusedError(RATE_TOO_HIGH)
            self.memory.data_type = value
        else:
            raise RefusedError(BAD_DATA if index == 1 else NO_SUCH_PARAMETER)
        self._log_change(f"tx_mode.{index}", value, request.by)
        return DONE, b""

    def _write_rate(self, request: GsvRequest) -> Answer:
        (asked,) = struct.unpack(">f", request.parameters)
        if not asked >= SLOWEST_S_s:  # NaN too
            raise RefusedError(TOO_SMALL)
        if asked > FASTEST_S_s:
            raise RefusedError(TOO_LARGE)
        if asked > self._fastest():
            raise RefusedError(RATE_TOO_HIGH)
        divisor = min(DIVISORS, key=lambda d: abs(CONVERSIONS_PER_S / d - asked))
        self.memory.rate_S_s = CONVERSIONS_PER_S / divisor
        self._divisor = divisor
        self._begin()
        self._log_change("rate", self.rate, request.by)
        return (DONE if self.rate == asked else DONE_CHANGED), b""

    def _get_input_type(self, request: GsvRequest) -> Answer:
        """Return the type and its input range in hundredths of a mV/V."""
        kind = self.memory.input_type[_channel(request)]
        return DONE, struct.pack(">BI", kind, round(100 * input_range(kind)))

    def _set_input_type(self, request: GsvRequest) -> Answer:
        channel, kind = _channel(request), request.parameters[1]
        if kind >= len(BRIDGE_RANGES_MV_V):
            raise RefusedError(BAD_DATA)
        self.memory.input_type[channel] = kind
        self._log_change(f"input_type.{channel + 1}", kind, request.by)
        return DONE, b""

    # --- state -------------------------------------------------------------------------------

    def _switch_on(self) -> None:
        self._divisor = round(CONVERSIONS_PER_S / self.memory.rate_S_s)
        self._crc16 = bool(self.memory.tx_flags & TX_CRC16)
        self._streaming = not self.memory.tx_flags & TX_OFF_ALWAYS
        self._begin()

    def _begin(self) -> None:
        """Begin to count frames from here."""
        self._origin_us, self._sent = self._port.now_us, 0
        self._period_s = self._divisor / CONVERSIONS_PER_S
        self._converter.begin(self._divisor)

    def _stream(self, on: bool, by: str) -> None:
        if on != self._streaming:
            self._streaming = on
            if on:
                self._begin()
            self._log_change("streaming", on, by)

    def _fastest(self) -> float:
        return FASTEST_FLOATS_S_s if self.memory.data_type == FLOAT32 else FASTEST_S_s

    def _log_change(self, what: str, value: object, by: str) -> None:
        self._log.log(self._name, what, value, by)

    def _now_s(self) -> float:
        return self._port.now_us * 1e-6

    # --- measuring ---------------------------------------------------------------------------

    def _frames(self, ends_s: npt.NDArray[np.float64]) -> bytes:
        """Return the measurement frames whose conversions end at these instants."""
        ranges, saturated = self._convert(ends_s)
        values = ranges - np.array(self.memory.zero)
        if self.memory.mode & MULTI_AXIS:  # the amplifier applies the sensor's matrix itself
            values[:, :3] = values[:, :3] * INPUT_RANGE_MV_V @ np.array(self.sensor.matrix).T
        elif self.memory.data_type == FLOAT32:
            values *= np.array(self.memory.user_scale)
        kept = values[:, : self.memory.values]
        any_saturated = np.asarray(saturated[:, : self.memory.values].any(axis=1))
        return encoded(kept, any_saturated, self.memory.data_type, self._crc16)

    def _convert(
        self, ends_s: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """See `BridgeConverter.input_ranges`."""
        return self._converter.input_ranges(ends_s, tuple(self.memory.input_type))


def _channel(request: GsvRequest) -> int:
    """Return the channel that a request names first, from 0."""
    channel = request.parameters[0]
    if not 1 <= channel <= CHANNELS:
        raise RefusedError(BAD_ADDRESS)
    return channel - 1
