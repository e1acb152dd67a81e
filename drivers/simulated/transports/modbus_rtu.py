"""Modbus RTU as the slaves of one serial line speak it: bytes in, frames out, no I/O.

The protocol core knows frames, checksums, gaps and how long bytes take on the wire; what is behind
the registers is a `LineDevice`. One line has several of them, and each hears every frame: a valid
one to any drive, `heard` by all, resets the communication time-outs of all.

Functions: 3 (read registers), 6 and 16 (write), 8/0 (echo), 23 (write, then read). Source: Modbus
over Serial Line V1.02; Modbus Application Protocol Specification V1.1b3.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.ports import Exchange, TimePort
from drivers.simulated.transports import modbus_tcp as modbus
from drivers.simulated.transports.modbus_tcp import ILLEGAL_FUNCTION, ModbusError, Registers

BROADCAST = 0
SHORTEST_FRAME, LONGEST_FRAME = 4, 256
BITS_A_BYTE = 11
"""Start, eight data, parity or a second stop, stop."""


class LineDevice(Registers, Protocol):
    """One slave of the line."""

    @property
    def name(self) -> str:
        """Name of the device in fault plans."""
        ...

    @property
    def unit_id(self) -> int:
        """Address of the device on the line."""
        ...

    def heard(self) -> None:
        """Take note of a valid frame on the line, to any device."""
        ...


def crc16(data: bytes) -> int:
    """Return the checksum of a frame, low byte first on the wire."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def frame(unit: int, pdu: bytes) -> bytes:
    """Return a PDU with its address and checksum."""
    body = bytes([unit]) + pdu
    return body + struct.pack("<H", crc16(body))


def _echo(pdu: bytes, device: Registers, by: str) -> bytes:
    """Answer function 8: the only diagnosis there is sends back what it was given."""
    if len(pdu) != 5 or pdu[1:3] != b"\0\0":
        raise ModbusError(ILLEGAL_FUNCTION)
    return pdu[1:]


_FUNCTIONS: Mapping[int, Callable[[bytes, Registers, str], bytes]] = {
    3: modbus.read_registers,
    6: modbus.write_register,
    8: _echo,
    16: modbus.write_registers,
    23: modbus.read_write_registers,
}


def _exception(reply: bytes, code: int) -> bytes:
    return frame(reply[0], bytes((reply[1] | 0x80, code)))


def _wrong_checksum(reply: bytes) -> bytes:
    return reply[:-1] + bytes([reply[-1] ^ 0xFF])


RTU_DIALECT = WireDialect(error=_exception, checksum=_wrong_checksum)


class RtuLine:
    """Slaves on one line; a `SerialInstrument` for `PtyServer`.

    What comes in is cut into frames by length and checksum. Bytes that are not a frame are dropped
    up to the next pause, which is the end of what came at once, or `gap_us` without a byte.
    """

    def __init__(
        self,
        devices: Sequence[LineDevice],
        timeline: TimePort,
        baudrate: int = 230_400,
        response_wait_us: int = 3000,
        gap_us: int = 2500,
    ):
        self._devices = {device.unit_id: device for device in devices}
        self._timeline = timeline
        self._baudrate, self._wait_us, self._gap_us = baudrate, response_wait_us, gap_us
        self._buffer = b""
        self._last_us = 0

    def exchanges(self, data: bytes, by: str) -> Iterator[Exchange]:
        """Yield every request that the bytes complete, with its reply and how long both take."""
        now_us = self._timeline.now_us
        if now_us - self._last_us > self._gap_us:
            self._buffer = b""
        self._last_us = now_us
        self._buffer += data
        while (whole := self._next_frame()) is not None:
            for device in self._devices.values():
                device.heard()
            exchange = self._answer(whole[0], whole[1:-2], by)
            if exchange is not None:
                yield exchange

    def frames_until(self, now_us: int) -> bytes:
        """Return nothing: a slave sends only answers."""
        return b""

    def _next_frame(self) -> bytes | None:
        """Return the frame at the front; None if there is none or not yet a whole one."""
        length = _length(self._buffer)
        if length is not None and len(self._buffer) < length:
            return None
        if length is None or crc16(self._buffer[:length]):  # over a whole frame it is 0
            self._buffer = b""
            return None
        whole, self._buffer = self._buffer[:length], self._buffer[length:]
        return whole

    def _answer(self, unit: int, pdu: bytes, by: str) -> Exchange | None:
        if unit == BROADCAST:
            for device in self._devices.values():
                modbus.answer_of(pdu, device, by, _FUNCTIONS)
            return None
        addressed = self._devices.get(unit)
        if addressed is None:
            return None
        reply = frame(unit, modbus.answer_of(pdu, addressed, by, _FUNCTIONS))
        on_the_wire = (len(pdu) + 3 + len(reply)) * BITS_A_BYTE / self._baudrate
        delay_s = self._wait_us * 1e-6 + on_the_wire
        return Exchange(modbus.describe(pdu), reply, addressed.name, delay_s)


def _length(begun: bytes) -> int | None:
    """Return the length of the request at the front, as far as known; None for what is not a
    request."""
    if len(begun) < 2:
        return SHORTEST_FRAME
    code = begun[1]
    if code in (3, 6, 8):
        return 8
    at = {16: 6, 23: 10}.get(code)  # of the byte count
    if at is None:
        return None if code not in range(1, 128) else max(len(begun), SHORTEST_FRAME)
    if len(begun) <= at:
        return at + 3
    length = at + 3 + begun[at]
    return length if length <= LONGEST_FRAME else None
