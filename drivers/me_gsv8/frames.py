"""The GSV-6/GSV-8 serial protocol as frames: bytes in, frames out, no I/O and no instrument.

    AA | header | control | data | [crc] | 85          big-endian

    header   bits 7-6: 00 measurement, 01 response, 10 request; bits 5-4: 01 serial, 11 serial with
             CRC; bits 3-0: length of the data, or for a measurement the number of values less one
    control  request: command number; response: error code; measurement: bit 7 set, bits 6-4 data
             type, bit 1 multi-axis error, bit 0 converter saturated

A request or response ends with CRC-8 (polynomial 07, start 0), a measurement with CRC-16/Modbus
(low byte first), both over header to data. A response of 15 bytes or more has 15 in its header and
its length less 15 where the error code would stand.

AA and 85 occur inside data, so a lost byte makes frames out of the middle of others. The decoder
therefore drops one byte at a time until a whole frame fits, and reports every byte that it dropped.
Frames of measurements come in runs of one layout: a run is checked and decoded as one array.

Source: ME-Messsysteme, GSV Communication Protocol Specification (ba-gsvcom_en, 11/2022), p. 9-15.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt

SYNC, END = 0xAA, 0x85
SMALLEST_FRAME = 4
LONGEST_PARAMETERS = 15
LONG_RESPONSE = 15

MEASUREMENT, RESPONSE, REQUEST = 0, 1, 2
SERIAL, SERIAL_WITH_CRC = 1, 3

INT16, INT24, FLOAT32 = 1, 2, 3
VALUE_BYTES = {INT16: 2, INT24: 3, FLOAT32: 4}
INTEGER_FULL_SCALE = 1.05
"""Value of the largest integer in input ranges; times the user scale in user units."""

SATURATED, MULTI_AXIS_ERROR = 0x01, 0x02

REJECTED_KEPT = 64
"""Number of dropped bytes that are recorded for an error message."""

_MORE, _NO_FRAME = -1, 0
_STATUS = np.uint8(0x0F)


@dataclass(frozen=True)
class FrameLayout:
    """The layout of a stream's measurement frames."""

    values: int
    """Values in a frame, 1 to 16."""
    data_type: int = FLOAT32
    crc: bool = False

    @cached_property
    def header(self) -> int:
        """The frames' second byte."""
        interface = SERIAL_WITH_CRC if self.crc else SERIAL
        return MEASUREMENT << 6 | interface << 4 | self.values - 1

    @cached_property
    def size(self) -> int:
        """Bytes in a frame."""
        return SMALLEST_FRAME + self.values * VALUE_BYTES[self.data_type] + 2 * self.crc


@dataclass(frozen=True)
class GsvResponse:
    """The amplifier's answer to a request."""

    code: int
    """0 done, 1 done with another value changed, else an error."""
    data: bytes
    crc: bool


@dataclass(frozen=True)
class Measurements:
    """A run of measurement frames that came one after the other."""

    layout: FrameLayout
    values: npt.NDArray[np.float32]
    """Values, (n, values): floats in user units, integers in input ranges before scaling."""
    status: npt.NDArray[np.uint8]
    """Status of each frame, (n,). Bit 0: the converter was saturated; bit 1: multi-axis error."""

    def __len__(self) -> int:
        return len(self.values)

    @property
    def size(self) -> int:
        """Bytes that the run took on the link."""
        return len(self.values) * self.layout.size


Frame = GsvResponse | Measurements


def request(command: int, parameters: bytes = b"", crc: bool = False) -> bytes:
    """Return a request as bytes. Raises ValueError for more than 15 bytes of parameters."""
    if len(parameters) > LONGEST_PARAMETERS:
        raise ValueError(f"{len(parameters)} parameter bytes are more than {LONGEST_PARAMETERS}")
    interface = SERIAL_WITH_CRC if crc else SERIAL
    body = bytes((REQUEST << 6 | interface << 4 | len(parameters), command)) + parameters
    check = bytes((crc8(body),)) if crc else b""
    return bytes((SYNC,)) + body + check + bytes((END,))


class Decoder:
    """Takes bytes as they arrive and gives responses and runs of measurements, in order.

    `expected` narrows measurements to one layout and `crc_only` refuses frames without a CRC:
    refused bytes are treated as bytes that are not a frame.
    """

    def __init__(self) -> None:
        self.expected: FrameLayout | None = None
        self.crc_only = False
        self.dropped = 0
        """Total number of bytes that were not part of a frame."""
        self._rejected = bytearray()
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that are complete with these bytes."""
        buffer = self._rest + data
        at, found = 0, list[Frame]()
        while at < len(buffer):
            at = self._seek(buffer, at)
            size = self._size(buffer, at)
            if size == _MORE or (size != _NO_FRAME and at + size > len(buffer)):
                break
            frame = self._frame(buffer, at, size) if size != _NO_FRAME else None
            if frame is None:
                self._drop(buffer[at : at + 1])
                at += 1
                continue
            found.append(frame)
            at += frame.size if isinstance(frame, Measurements) else size
        self._rest = buffer[at:]
        return found

    def reset(self) -> None:
        """Forget an unfinished frame and what was dropped."""
        self._rest = b""
        self._rejected.clear()

    def take_rejected(self) -> bytes:
        """Return the first bytes that were not part of a frame since the last call."""
        rejected = bytes(self._rejected)
        self._rejected.clear()
        return rejected

    def _seek(self, buffer: bytes, at: int) -> int:
        """Return the next place where a frame may begin."""
        begin = buffer.find(SYNC, at)
        begin = len(buffer) if begin < 0 else begin
        if begin > at:
            self._drop(buffer[at:begin])
        return begin

    def _drop(self, data: bytes) -> None:
        self.dropped += len(data)
        self._rejected += data[: REJECTED_KEPT - len(self._rejected)]

    def _size(self, buffer: bytes, at: int) -> int:
        """Return bytes of the frame that begins here, `_MORE` if they are too few, or
        `_NO_FRAME`."""
        if len(buffer) < at + 2:
            return _MORE
        header = buffer[at + 1]
        kind, interface, length = header >> 6, header >> 4 & 3, header & 15
        if interface != SERIAL_WITH_CRC and (interface != SERIAL or self.crc_only):
            return _NO_FRAME
        crc = interface == SERIAL_WITH_CRC
        if kind not in (MEASUREMENT, RESPONSE) or self._unexpected(kind, header):
            return _NO_FRAME
        if len(buffer) < at + 3:
            return _MORE
        control = buffer[at + 2]
        if kind == MEASUREMENT:
            layout = self._layout(header, control)
            return layout.size if layout else _NO_FRAME
        extra = control if length == LONG_RESPONSE else 0
        return SMALLEST_FRAME + length + extra + crc

    def _unexpected(self, kind: int, header: int) -> bool:
        return kind == MEASUREMENT and self.expected is not None and header != self.expected.header

    def _layout(self, header: int, control: int) -> FrameLayout | None:
        layout = _layout(header, control >> 4)
        if layout is not None and self.expected is not None:
            return layout if layout.data_type == self.expected.data_type else None
        return layout

    def _frame(self, buffer: bytes, at: int, size: int) -> Frame | None:
        if buffer[at + size - 1] != END:
            return None
        if buffer[at + 1] >> 6 == RESPONSE:
            return _response(buffer[at : at + size])
        layout = self._layout(buffer[at + 1], buffer[at + 2])
        assert layout is not None
        return _measurements(buffer, at, layout)


@cache
def _layout(header: int, indicator: int) -> FrameLayout | None:
    """Return the layout that a measurement's header and the upper half of its control byte
    state."""
    data_type = indicator & 7
    if not indicator & 8 or data_type not in VALUE_BYTES:
        return None
    return FrameLayout((header & 15) + 1, data_type, header >> 4 & 3 == SERIAL_WITH_CRC)


def _response(frame: bytes) -> GsvResponse | None:
    crc = frame[1] >> 4 & 3 == SERIAL_WITH_CRC
    end = len(frame) - 1 - crc
    if crc and crc8(frame[1:end]) != frame[end]:
        return None
    long = frame[1] & 15 == LONG_RESPONSE
    return GsvResponse(0 if long else frame[2], frame[3:end], crc)


def _measurements(buffer: bytes, at: int, layout: FrameLayout) -> Measurements | None:
    """Return the run of frames of one layout that begins here, or None if not even one is whole."""
    size = layout.size
    count = (len(buffer) - at) // size
    rows = np.frombuffer(buffer, np.uint8, count * size, at).reshape(count, size)
    run = _whole_alone(buffer, at, layout) if count == 1 else _whole_rows(rows, layout)
    if run == 0:
        return None
    rows = rows[:run]
    data = rows[:, 3 : 3 + layout.values * VALUE_BYTES[layout.data_type]]
    return Measurements(layout, _values(data, layout.data_type), rows[:, 2] & _STATUS)


def _whole_alone(buffer: bytes, at: int, layout: FrameLayout) -> bool:
    """Return whether a last frame is whole: a reader that keeps up gets one at a time, and for one
    frame this is several times faster than an array."""
    frame = buffer[at : at + layout.size]
    known = frame[1] == layout.header and frame[2] >> 4 == 8 | layout.data_type
    return known and frame[-1] == END and not (layout.crc and crc16(frame[1:-1]))


def _whole_rows(rows: npt.NDArray[np.uint8], layout: FrameLayout) -> int:
    """Return how many of the rows, from the first, are whole frames of a layout."""
    whole, places, tables = _checks_by_place(layout)
    wrong = np.bitwise_xor.reduce(tables[places + rows], axis=1) != whole
    first = wrong.tobytes().find(True)
    return first if first >= 0 else len(rows)


@cache
def _checks_by_place(
    layout: FrameLayout,
) -> tuple[np.uint32, npt.NDArray[np.intp], npt.NDArray[np.uint32]]:
    """Return what the bytes of a whole frame come to, combined by exclusive or; where each place's
    table begins; the tables, one after the other.

    The lower half is the CRC-16/Modbus, where the layout has one: a CRC is linear, so each byte
    contributes by value and place alone. Above it each place whose bits all frames of a layout
    share has a bit of its own, which is set where they differ.
    """
    whole, tables = np.uint32(0), np.zeros((layout.size, 256), np.uint32)
    if layout.crc:
        start, tables[1:-1] = crc16_by_place(layout.size - 2)
        whole = np.uint32(start)  # over a message and its own CRC it is 0
    control = 0x80 | layout.data_type << 4
    shared = (0, SYNC, 0xFF), (1, layout.header, 0xFF), (2, control, 0xF0), (-1, END, 0xFF)
    for bit, (place, pattern, mask) in enumerate(shared, 16):
        differs = (np.arange(256) ^ pattern) & mask != 0
        tables[place] |= differs.astype(np.uint32) << bit
    return whole, np.arange(layout.size) * 256, tables.ravel()


def _values(data: npt.NDArray[np.uint8], data_type: int) -> npt.NDArray[np.float32]:
    """Return values of big-endian bytes (n, width); integers are offset binary."""
    if data_type == FLOAT32:
        return np.ascontiguousarray(data).view(">f4").astype(np.float32)
    bits = 8 * VALUE_BYTES[data_type]
    digits = data.reshape(len(data), -1, VALUE_BYTES[data_type]).astype(np.int64)
    weights = 256 ** np.arange(VALUE_BYTES[data_type] - 1, -1, -1)
    offset = (digits * weights).sum(axis=2) - (1 << bits - 1)
    return np.asarray(offset * (INTEGER_FULL_SCALE / (1 << bits - 1)), dtype=np.float32)


# --- checksums -------------------------------------------------------------------------------


def _crc8_table() -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ (0x07 if value & 0x80 else 0)) & 0xFF
        table.append(value)
    return bytes(table)


def _crc16_table() -> npt.NDArray[np.uint16]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0xA001, table >> 1).astype(np.uint16)
    return table


_CRC8 = _crc8_table()
_CRC16 = _crc16_table()
_CRC16_LIST: list[int] = _CRC16.tolist()


def crc8(data: bytes) -> int:
    """Return the CRC-8 of requests and responses: polynomial 07, start 0."""
    crc = 0
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc


def crc16(data: bytes) -> int:
    """Return CRC-16/Modbus, of which a frame carries the low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = _CRC16_LIST[(crc ^ byte) & 0xFF] ^ crc >> 8
    return crc


def crc16_by_place(length: int) -> tuple[np.uint16, npt.NDArray[np.uint16]]:
    """Return what the start value FFFF leaves after `length` bytes, and what each value of a byte
    at each place contributes, (length, 256)."""
    start = np.array([0xFFFF], np.uint16)
    for _ in range(length):
        start = _CRC16[start & 0xFF] ^ start >> 8
    tables = np.empty((length, 256), np.uint16)
    column = _CRC16
    for place in range(length - 1, -1, -1):
        tables[place] = column
        column = _CRC16[column & 0xFF] ^ column >> 8
    return start[0], tables
