"""Commands of the GSV-8 with the lengths of their answers, and the meanings of its error codes.

Sources: `drivers.me_gsv8.driver`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GsvCommand:
    """A command: its number, its name in messages, and the number of bytes of its answer."""

    number: int
    name: str
    answer_bytes: int = 0


GET_INTERFACE = GsvCommand(0x01, "GetInterface", 4)
READ_USER_SCALE = GsvCommand(0x14, "ReadUserScale", 4)
WRITE_USER_SCALE = GsvCommand(0x15, "WriteUserScale")
GET_SERIAL_NUMBER = GsvCommand(0x1F, "GetSerNo", 8)
STOP_TRANSMISSION = GsvCommand(0x23, "StopTransmission")
START_TRANSMISSION = GsvCommand(0x24, "StartTransmission")
GET_MODE = GsvCommand(0x26, "GetMode", 4)
SET_MODE = GsvCommand(0x27, "SetMode")
FIRMWARE_VERSION = GsvCommand(0x2B, "FirmwareVersion", 4)
GET_TX_MAPPING = GsvCommand(0x49, "GetTxMapping", 2)
SET_TX_MAPPING = GsvCommand(0x4A, "SetTxMapping")
GET_DIO_DIRECTION = GsvCommand(0x59, "GetDIOdirection", 1)
SET_DIO_DIRECTION = GsvCommand(0x5A, "SetDIOdirection")
GET_DIO_LEVEL = GsvCommand(0x5D, "GetDIOlevel", 2)
READ_DATA_RATE_RANGE = GsvCommand(0x63, "ReadDataRateRange", 4)
GET_TX_MODE = GsvCommand(0x80, "GetTXMode", 2)
SET_TX_MODE = GsvCommand(0x81, "SetTXMode")
READ_DATA_RATE = GsvCommand(0x8A, "ReadDataRate", 4)
WRITE_DATA_RATE = GsvCommand(0x8B, "WriteDataRate")
GET_INPUT_TYPE = GsvCommand(0xA2, "GetInputType", 5)

TOKENS = ((GET_SERIAL_NUMBER, b""), (GET_TX_MAPPING, b"\0"), (GET_INPUT_TYPE, b"\x01\xff"))
"""Queries that change nothing and whose answers differ in length."""

ERRORS: dict[int, str] = {
    0x40: "unknown command",
    0x41: "command not implemented",
    0x42: "broken frame",
    0x43: "wrong checksum",
    0x50: "wrong parameter",
    0x51: "wrong parameter address",
    0x52: "wrong parameter value",
    0x53: "wrong parameter bits",
    0x54: "parameter too large",
    0x55: "parameter too small",
    0x56: "wrong combination of parameters",
    0x57: "parameter too large for the other settings",
    0x58: "parameter too small for the other settings",
    0x59: "parameter not implemented",
    0x5A: "parameters came too late",
    0x5B: "wrong number of parameters",
    0x5C: "parameter does not match the settings",
    0x5D: "parameter collides with the hardware",
    0x60: "no data available",
    0x61: "inconsistent data",
    0x62: "wrong state",
    0x63: "function not supported",
    0x64: "data rate too high",
    0x6E: "memory in the wrong condition",
    0x6F: "memory access denied",
    0x70: "access denied",
    0x71: "write access is blocked",
}
