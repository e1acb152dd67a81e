"""Frames of the GSV-8 as bytes: requests in, responses and measurements out, with their checks.

It shares no code with the driver. Source and what is UNCONFIRMED: `me_gsv8`.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.instruments.gsv8_converter import OVERRANGE

INT16, INT24, FLOAT32 = 1, 2, 3


class RefusedError(Exception):
    """A request that is answered with an error code."""

    def __init__(self, code: int):
        super().__init__(f"error {code:02X}")
        self.code = code


UNKNOWN, NOT_IMPLEMENTED, BAD_FRAME, BAD_CRC = 0x40, 0x41, 0x42, 0x43
BAD_ADDRESS, BAD_DATA, BAD_BITS, TOO_LARGE, TOO_SMALL = 0x51, 0x52, 0x53, 0x54, 0x55
NO_SUCH_PARAMETER, WRONG_COUNT, RATE_TOO_HIGH, LOCKED = 0x59, 0x5B, 0x64, 0x71
DONE, DONE_CHANGED = 0x00, 0x01


class GsvRequest(NamedTuple):
    """One request frame as it came."""

    number: int
    parameters: bytes
    crc: bool
    by: str

    @property
    def label(self) -> bytes:
        """The request as fault plans name it: ``8B 44 7A 00 00``."""
        return bytes((self.number, *self.parameters)).hex(" ").upper().encode()


def take_request(received: bytearray, by: str) -> GsvRequest | int | None:
    """Take the next request off the bytes received; return it, the error code of a broken one, or
    None until more has come."""
    while True:
        start = received.find(0xAA)
        del received[: len(received) if start < 0 else start]
        if len(received) < 2 or received[1] & 0xF0 in (0x90, 0xB0):
            break
        del received[0]
    if len(received) < 4:
        return None
    count, crc = received[1] & 15, received[1] & 0xF0 == 0xB0
    length = 4 + count + crc
    if len(received) < length:
        return None
    frame = bytes(received[:length])
    if frame[-1] != 0x85:
        del received[0]
        return BAD_FRAME
    del received[:length]
    if crc and _crc8(frame[1:-1]) != 0:
        return BAD_CRC
    return GsvRequest(frame[2], frame[3 : 3 + count], crc, by)


def encoded(
    values: npt.NDArray[np.float64], saturated: npt.NDArray[np.bool_], kind: int, crc16: bool
) -> bytes:
    """Return frames of values (n, k): floats in user units, integers in input ranges."""
    count, width = values.shape
    flat = values.ravel().tolist()
    if kind == FLOAT32:
        data = struct.pack(f">{len(flat)}f", *flat)
    else:
        data = b"".join(offset_binary(value, kind + 1) for value in flat)
    end = 3 + len(data) // count
    frames = np.empty((count, end + 2 * crc16 + 1), np.uint8)
    frames[:, 0], frames[:, -1] = 0xAA, 0x85
    frames[:, 1] = (0x30 if crc16 else 0x10) | width - 1
    frames[:, 2] = saturated | (0x80 | kind << 4)
    frames[:, 3:end] = np.frombuffer(data, np.uint8).reshape(count, -1)
    if crc16:
        frames[:, end:-1] = _crc16(frames[:, 1:end])
    return frames.tobytes()


def offset_binary(ranges: float, width: int) -> bytes:
    """Return a value in input ranges as an integer of `width` bytes: 1.05 ranges are its end."""
    half = 1 << 8 * width - 1
    counts = round(ranges / OVERRANGE * half)
    return (min(max(counts, -half), half - 1) + half).to_bytes(width, "big")


def response(code: int, data: bytes, crc: bool) -> bytes:
    """Return a response frame with an error code and data."""
    assert len(data) < 15, "no command here answers with more"
    body = bytes(((0x70 if crc else 0x50) | len(data), code)) + data
    return b"\xaa" + body + (bytes((_crc8(body),)) if crc else b"") + b"\x85"


def _refusal(reply: bytes, code: int) -> bytes | None:
    """Return a response made into one with an error code; measurements carry none."""
    return response(code, b"", bool(reply[1] & 0x20)) if reply[1] >> 6 == 1 else None


def _wrong_check(reply: bytes) -> bytes | None:
    """Return a response, or the last of some measurements, with a wrong CRC where it has one."""
    if not reply[1] & 0x20:
        return None
    return reply[:-2] + bytes((reply[-2] ^ 0xFF, reply[-1]))


GSV_DIALECT = WireDialect(error=_refusal, checksum=_wrong_check)


def _crc8(data: bytes) -> int:
    """Polynomial x8 + x2 + x + 1, start 0: of a message and its own check it is 0."""
    remainder = 0
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder << 1 ^ 0x107) if remainder & 0x80 else remainder << 1
    return remainder


def _crc16(rows: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the CRC-16 of each row as Modbus has it, (n, 2) with the low byte first: x16 + x15 +
    x2 + 1 reflected, start FFFF. It is the exclusive or of what each byte brings in at its place.
    """
    start, places, brought = _crc16_by_place(rows.shape[1])
    remainders = np.bitwise_xor.reduce(brought[places + rows], axis=1) ^ start
    return np.asarray(remainders, "<u2").view(np.uint8).reshape(-1, 2)


@cache
def _crc16_by_place(
    length: int,
) -> tuple[np.uint16, npt.NDArray[np.intp], npt.NDArray[np.uint16]]:
    """Return the contribution of the start, the index of each place's bytes, and the contributions
    of the bytes."""

    def passed_on(remainders: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
        return np.asarray(remainders >> 8 ^ one_byte[remainders & 0xFF])

    one_byte = np.array(_BYTES, np.uint16)
    start, brought = np.array([0xFFFF], np.uint16), [one_byte]
    for _ in range(length - 1):
        brought.append(passed_on(brought[-1]))
    for _ in range(length):
        start = passed_on(start)
    return start[0], np.arange(length) * 256, np.concatenate(brought[::-1])


_NIBBLES = (
    *(0x0000, 0xCC01, 0xD801, 0x1400, 0xF001, 0x3C00, 0x2800, 0xE401),
    *(0xA001, 0x6C00, 0x7800, 0xB401, 0x5000, 0x9C01, 0x8801, 0x4400),
)
_BYTES = tuple((byte := _NIBBLES[n & 15] ^ n >> 4) >> 4 ^ _NIBBLES[byte & 15] for n in range(256))
"""A byte's two nibbles in one."""
