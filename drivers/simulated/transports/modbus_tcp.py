"""Modbus TCP as a server speaks it: frames in, frames out, and a small TCP server around that.

The protocol core knows function codes and exceptions and nothing about a drive; the drive is a
`RegisterDevice` and knows nothing about frames. pymodbus's own server is not used because its
device identification belongs to the process, not to a device, and because it answers for units
that do not exist; here every device answers for itself, and `WireFaults` reaches every reply.

Functions: 3 and 4 (read registers, one address space), 6, 16, 23, 43/14 (device identification).
Source: Modbus Application Protocol Specification V1.1b3; Modbus Messaging on TCP/IP V1.0b.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from drivers.simulated.faults.wire import WireDialect, WireFaults
from drivers.simulated.transports.tcp import TcpPeer, TcpServer

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
MOST_READ, MOST_WRITTEN, MOST_WRITTEN_WITH_READ = 125, 123, 121
LONGEST_REPLY_PDU = 253
UNITS = (0, 1, 255)
"""Unit identifiers that are answered: that of the only device here, and the one for any device."""

D = TypeVar("D", bound="Registers")

_HEADER = struct.Struct(">HHHB")


class ModbusError(Exception):
    """An exception reply with this code; nothing was changed."""

    def __init__(self, code: int):
        super().__init__(f"exception {code}")
        self.code = code


class Registers(Protocol):
    """The device behind the registers. `by` names the connection. Calls return without waiting."""

    def read(self, address: int, count: int, by: str) -> Sequence[int]:
        """Return the registers, or ModbusError."""
        ...

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        """Take the values, or ModbusError with nothing stored."""
        ...


class RegisterDevice(Registers, Protocol):
    """A device with an identification."""

    def identification(self) -> Mapping[int, str]:
        """Return the device identification objects by number."""
        ...


# --- one request -----------------------------------------------------------------------------


def describe(pdu: bytes) -> bytes:
    """Return a request in words that a fault plan can name: ``FC3 100``, ``FC16 0``, ``FC43``."""
    code = pdu[0]
    if code in (3, 4, 6, 8, 16, 23) and len(pdu) >= 3:
        return b"FC%d %d" % (code, int.from_bytes(pdu[1:3], "big"))
    return b"FC%d" % code


def reply_to(pdu: bytes, device: RegisterDevice, by: str) -> bytes:
    """Return the reply PDU to a request PDU over TCP."""
    return answer_of(pdu, device, by, _FUNCTIONS)


def answer_of(
    pdu: bytes, device: D, by: str, functions: Mapping[int, Callable[[bytes, D, str], bytes]]
) -> bytes:
    """Return the reply PDU to a request PDU; `functions` gives what follows the function code.

    A ModbusError of a function becomes the reply of an exception.
    """
    try:
        if pdu[0] not in functions:
            raise ModbusError(ILLEGAL_FUNCTION)
        return bytes([pdu[0]]) + functions[pdu[0]](pdu, device, by)
    except ModbusError as error:
        return bytes([pdu[0] | 0x80, error.code])


def read_registers(pdu: bytes, device: Registers, by: str) -> bytes:
    """Answer functions 3 and 4, read registers."""
    address, count = _unpack(">HH", pdu[1:])
    return _registers(device, address, count, by)


def write_register(pdu: bytes, device: Registers, by: str) -> bytes:
    """Answer function 6, write one register."""
    address, value = _unpack(">HH", pdu[1:])
    device.write(address, [value], by)
    return pdu[1:]


def write_registers(pdu: bytes, device: Registers, by: str) -> bytes:
    """Answer function 16, write several registers."""
    address, count = _unpack(">HH", pdu[1:5])
    device.write(address, _values(pdu[5:], count, MOST_WRITTEN), by)
    return pdu[1:5]


def read_write_registers(pdu: bytes, device: Registers, by: str) -> bytes:
    """Answer function 23: write registers, then read registers.

    Raises ModbusError for a wrong count.
    """
    read_address, read_count, address, count = _unpack(">HHHH", pdu[1:9])
    values = _values(pdu[9:], count, MOST_WRITTEN_WITH_READ)
    if not 1 <= read_count <= MOST_READ:
        raise ModbusError(ILLEGAL_VALUE)
    device.write(address, values, by)
    return _registers(device, read_address, read_count, by)


def _identify(pdu: bytes, device: RegisterDevice, by: str) -> bytes:
    """Answer function 43, MEI type 14: codes 1 to 3 stream, 4 asks for one object."""
    kind, code, first = _unpack(">BBB", pdu[1:])
    if kind != 14:
        raise ModbusError(ILLEGAL_FUNCTION)
    objects = device.identification()
    last = {1: 2, 2: 127, 3: 255}.get(code)
    if code == 4:
        if first not in objects:
            raise ModbusError(ILLEGAL_ADDRESS)
        last = first
    if last is None:
        raise ModbusError(ILLEGAL_VALUE)
    if first > last or first not in objects:
        first = 0  # an unknown object to begin with means from the beginning
    body, included, more, following = b"", 0, 0, 0
    for number in sorted(n for n in objects if first <= n <= last):
        text = objects[number].encode("ascii", "replace")
        entry = bytes([number, len(text)]) + text
        if len(body) + len(entry) > LONGEST_REPLY_PDU - 7:
            more, following = 0xFF, number
            break
        body += entry
        included += 1
    conformity = 0x82  # regular identification, stream and single access
    return bytes([14, code, conformity, more, following, included]) + body


_FUNCTIONS: Mapping[int, Callable[[bytes, RegisterDevice, str], bytes]] = {
    3: read_registers,
    4: read_registers,
    6: write_register,
    16: write_registers,
    23: read_write_registers,
    43: _identify,
}


def _registers(device: Registers, address: int, count: int, by: str) -> bytes:
    if not 1 <= count <= MOST_READ:
        raise ModbusError(ILLEGAL_VALUE)
    if address + count > 0x10000:
        raise ModbusError(ILLEGAL_ADDRESS)
    return struct.pack(f">B{count}H", 2 * count, *device.read(address, count, by))


def _values(data: bytes, count: int, most: int) -> list[int]:
    """Return the register values behind a byte count."""
    if not 1 <= count <= most or len(data) != 1 + 2 * count or data[0] != 2 * count:
        raise ModbusError(ILLEGAL_VALUE)
    return list(struct.unpack(f">{count}H", data[1:]))


def _unpack(layout: str, data: bytes) -> tuple[int, ...]:
    if len(data) != struct.calcsize(layout):
        raise ModbusError(ILLEGAL_VALUE)
    return struct.unpack(layout, data)


# --- frames ----------------------------------------------------------------------------------


class ModbusFrameError(Exception):
    """Bytes that are not a Modbus TCP frame: the rest of the connection cannot be read."""


class FrameSplitter:
    """Cuts a byte stream into (transaction, unit, PDU)."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[tuple[int, int, bytes]]:
        """Return the complete frames so far. Raises ModbusFrameError if there can be none."""
        self._buffer += data
        frames = []
        while len(self._buffer) >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack(self._buffer[: _HEADER.size])
            if protocol != 0 or not 2 <= length <= LONGEST_REPLY_PDU + 1:
                raise ModbusFrameError(f"protocol {protocol}, length {length}")
            end = 6 + length
            if len(self._buffer) < end:
                break
            frames.append((transaction, unit, self._buffer[_HEADER.size : end]))
            self._buffer = self._buffer[end:]
        return frames


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return a PDU with its header."""
    return _HEADER.pack(transaction, 0, len(pdu) + 1, unit) + pdu


def _exception(reply: bytes, code: int) -> bytes:
    transaction, _, _, unit = _HEADER.unpack(reply[: _HEADER.size])
    return frame(transaction, unit, bytes((reply[_HEADER.size] | 0x80, code)))


MODBUS_DIALECT = WireDialect(error=_exception)
"""Modbus TCP has no checksum of its own: TCP's is enough."""


# --- the server ------------------------------------------------------------------------------


class ModbusTcpServer(TcpServer):
    """A device on Modbus TCP; commands are logged as ``modbus#n``."""

    def __init__(
        self,
        device: RegisterDevice,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: WireFaults | None = None,
    ):
        super().__init__(host, port, faults)
        self.device = device

    def _accept(self) -> TcpPeer:
        return _ModbusPeer(self)


class _ModbusPeer(TcpPeer):
    def __init__(self, server: ModbusTcpServer):
        super().__init__(server)
        self._device = server.device
        self._link = server.faults.link()
        self._splitter = FrameSplitter()
        self._by = f"modbus#{server.next_number()}"

    def data_received(self, data: bytes) -> None:
        try:
            frames = self._splitter.feed(data)
        except ModbusFrameError:
            self.abort()
            return
        for transaction, unit, pdu in frames:
            if unit not in UNITS or self._link.half_open:
                continue  # nothing behind it any more: silence
            reply = frame(transaction, unit, reply_to(pdu, self._device, self._by))
            delivery = self._link.exchange(describe(pdu), reply, transaction)
            self.deliver(delivery)
            if delivery.close:
                return
