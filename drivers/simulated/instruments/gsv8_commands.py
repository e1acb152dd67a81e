"""Commands of the GSV-8, by number (`COMMANDS`), and the amplifier that they act on.

Sources and what is UNCONFIRMED: `me_gsv8`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from drivers.simulated.instruments.gsv8_converter import (
    BRIDGE_RANGES_MV_V,
    CHANNELS,
    input_range,
)
from drivers.simulated.instruments.gsv8_digital_lines import GsvDigitalLines
from drivers.simulated.instruments.gsv8_frames import (
    BAD_ADDRESS,
    BAD_BITS,
    BAD_DATA,
    DONE,
    DONE_CHANGED,
    FLOAT32,
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
    offset_binary,
    response,
)
from drivers.simulated.instruments.gsv8_memory import (
    KNOWN_MODE,
    TX_CRC16,
    TX_OFF_NOW,
    WRITABLE_TX_FLAGS,
    WRITE_LOCK,
    FASTEST_FLOATS_S_s,
    FASTEST_S_s,
    GsvMemory,
    SLOWEST_S_s,
)
from drivers.simulated.instruments.gsv8_transmission import GsvTransmission

UNSERVED = frozenset(
    {0x00, *range(0x08, 0x0B), *range(0x0F, 0x13), *range(0x17, 0x1F), *range(0x20, 0x23), 0x25}
    | {0x2A, *range(0x32, 0x3A), 0x3C, 0x44, 0x45, 0x47, 0x48, *range(0x4B, 0x63)}
    | {*range(0x64, 0x78), *range(0x7A, 0x80), *range(0x86, 0x8A), *range(0x8C, 0x8E)}
    | {*range(0x90, 0xA2)}
)
"""Commands of the protocol that this simulator answers with "not implemented"."""


@dataclass
class GsvIdentity:
    """What the amplifier says that it is."""

    model_number: int = 0x08
    serial_number: str = "SIM00001"
    firmware_version: tuple[int, int] = (1, 60)


@dataclass
class GsvAmplifier:
    """One amplifier: the parts that commands act on."""

    identity: GsvIdentity
    memory: GsvMemory
    transmission: GsvTransmission
    lines: GsvDigitalLines
    log_change: Callable[[str, object, str], None]
    """Writes what was changed, its new value and who changed it into the World's log."""
    last_error: int = 0
    """Code of the latest error, for command 42."""


class GsvAnswer(NamedTuple):
    """Data and error code of a response; `DONE_CHANGED` if the value taken differs."""

    data: bytes = b""
    code: int = DONE


Act = Callable[[GsvAmplifier, GsvRequest], GsvAnswer | bytes | None]
"""What a command does. It returns the answer, or bytes to send as they are, or None for silence; it
raises RefusedError, before it changes anything, with the error code to answer."""


@dataclass(frozen=True)
class SimulatedCommand:
    """One command: what it does, which numbers of parameter bytes it takes, whether it writes."""

    act: Act
    lengths: tuple[int, ...] = (0,)
    writes: bool = False


def answered(amplifier: GsvAmplifier, request: GsvRequest) -> bytes | None:
    """Carry out a request; return the bytes to send, None for silence."""
    try:
        answer = _command(amplifier.memory, request).act(amplifier, request)
    except RefusedError as refused:
        amplifier.last_error = refused.code
        answer = GsvAnswer(code=refused.code)
    if isinstance(answer, GsvAnswer):
        return response(answer.code, answer.data, request.crc)
    return answer


def _command(memory: GsvMemory, request: GsvRequest) -> SimulatedCommand:
    """Return the table's entry for a request that may be carried out."""
    command = COMMANDS.get(request.number)
    if command is None:
        raise RefusedError(NOT_IMPLEMENTED if request.number in UNSERVED else UNKNOWN)
    if len(request.parameters) not in command.lengths:
        raise RefusedError(WRONG_COUNT)
    if command.writes and memory.locked:
        raise RefusedError(LOCKED)  # UNCONFIRMED code
    return command


def _channel(request: GsvRequest) -> int:
    """Return the channel that a request names first, from 0."""
    channel = request.parameters[0]
    if not 1 <= channel <= CHANNELS:
        raise RefusedError(BAD_ADDRESS)
    return channel - 1


# --- what it is, and its errors --------------------------------------------------------------


def _get_interface(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Apply the flags, if there are any: 01 stream off, 10 on; bit 2 fast frames; bit 3 CRC-16.

    That a request without bit 3 switches the CRC off, and the last two bytes of the reply, are
    UNCONFIRMED.
    """
    transmission, memory = amplifier.transmission, amplifier.memory
    if request.parameters:
        flags = request.parameters[0]
        if flags & 0xF4:
            raise RefusedError(BAD_BITS)
        if flags & 3 == 3:
            raise RefusedError(BAD_DATA)
        if flags & 3:
            (_start_transmission if flags & 3 == 2 else _stop_transmission)(amplifier, request)
        transmission.crc16 = bool(flags & 8)
    state = memory.values - 1 << 4 | transmission.on << 3 | memory.data_type
    return GsvAnswer(bytes((amplifier.identity.model_number, state, 0, 0)))


def _get_serial_number(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(amplifier.identity.serial_number.encode())


def _get_firmware_version(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(struct.pack(">HH", *amplifier.identity.firmware_version))


def _get_last_error(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(struct.pack(">I", amplifier.last_error))


def _four_zero_bytes(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(bytes(4))


# --- transmission ----------------------------------------------------------------------------


def _stop_transmission(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    if amplifier.transmission.stop():
        amplifier.log_change("streaming", False, request.by)
    return GsvAnswer()


def _start_transmission(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    if amplifier.transmission.start():
        amplifier.log_change("streaming", True, request.by)
    return GsvAnswer()


def _get_value(amplifier: GsvAmplifier, request: GsvRequest) -> bytes:
    """Send one measurement frame instead of a response."""
    return amplifier.transmission.frame_now()


def _get_mapping(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    if request.parameters[0] != 0:
        raise RefusedError(NO_SUCH_PARAMETER)
    return GsvAnswer(struct.pack(">H", amplifier.memory.values))


def _set_mapping(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Set, at index 0, the number of values in a frame: channels 1 to that number."""
    index, values = struct.unpack(">BH", request.parameters)
    if index != 0:
        raise RefusedError(NO_SUCH_PARAMETER)
    if not 1 <= values <= CHANNELS:
        raise RefusedError(BAD_DATA)
    amplifier.memory.values = values
    amplifier.log_change("values", values, request.by)
    return GsvAnswer()


def _get_rate_range(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Return, at index 0, the largest rate with the present settings; at 1 the smallest."""
    index = request.parameters[0]
    if index > 1:
        raise RefusedError(BAD_ADDRESS)
    return GsvAnswer(struct.pack(">f", SLOWEST_S_s if index else amplifier.memory.fastest_rate))


def _get_tx_mode(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Return the flags at index 0, the data type at 1."""
    memory, transmission = amplifier.memory, amplifier.transmission
    now = 0 if transmission.on else TX_OFF_NOW
    crc = TX_CRC16 if transmission.crc16 else 0
    values = {0: memory.tx_flags & ~TX_CRC16 | now | crc, 1: memory.data_type}
    if request.parameters[0] not in values:
        raise RefusedError(NO_SUCH_PARAMETER)  # UNCONFIRMED: index 2, the channel range
    return GsvAnswer(struct.pack(">H", values[request.parameters[0]]))


def _set_tx_mode(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    index, value = struct.unpack(">BH", request.parameters)
    if index == 0:
        amplifier.memory.tx_flags = value & WRITABLE_TX_FLAGS
        amplifier.transmission.crc16 = bool(value & TX_CRC16)
    elif index == 1 and value in (INT16, INT24, FLOAT32):
        if value == FLOAT32 and amplifier.transmission.rate > FASTEST_FLOATS_S_s:
            raise RefusedError(RATE_TOO_HIGH)
        amplifier.memory.data_type = value
    else:
        raise RefusedError(BAD_DATA if index == 1 else NO_SUCH_PARAMETER)
    amplifier.log_change(f"tx_mode.{index}", value, request.by)
    return GsvAnswer()


def _get_rate(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(struct.pack(">f", amplifier.transmission.rate))


def _set_rate(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    (asked_S_s,) = struct.unpack(">f", request.parameters)
    if not asked_S_s >= SLOWEST_S_s:  # NaN too
        raise RefusedError(TOO_SMALL)
    if asked_S_s > FASTEST_S_s:
        raise RefusedError(TOO_LARGE)
    if asked_S_s > amplifier.memory.fastest_rate:
        raise RefusedError(RATE_TOO_HIGH)
    transmission = amplifier.transmission
    transmission.set_rate(asked_S_s)
    amplifier.log_change("rate", transmission.rate, request.by)
    return GsvAnswer(code=DONE if transmission.rate == asked_S_s else DONE_CHANGED)


# --- the amplifier as a whole ----------------------------------------------------------------


def _get_mode(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(struct.pack(">I", amplifier.memory.mode))


def _set_mode(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Set the mode. It is answered although the lock is on, since nothing else could take it off
    (UNCONFIRMED)."""
    (mode,) = struct.unpack(">I", request.parameters)
    if mode & ~KNOWN_MODE:
        raise RefusedError(BAD_BITS)
    if amplifier.memory.mode & mode & WRITE_LOCK:
        raise RefusedError(LOCKED)
    amplifier.memory.mode = mode
    amplifier.log_change("mode", mode, request.by)
    return GsvAnswer()


def _reset(amplifier: GsvAmplifier, request: GsvRequest) -> None:
    """Start again, as after power-up, without an answer."""
    amplifier.log_change("reset", None, request.by)
    amplifier.transmission.switch_on()


# --- channels --------------------------------------------------------------------------------


def _set_zero(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Make the mean since the last frame zero; channel 0 means all."""
    which = request.parameters[0]
    if which > CHANNELS:
        raise RefusedError(BAD_ADDRESS)
    ranges = amplifier.transmission.input_ranges_now()
    for channel in range(CHANNELS) if which == 0 else (which - 1,):
        amplifier.memory.zero[channel] = float(ranges[channel])
    amplifier.log_change("zero", which, request.by)
    return GsvAnswer()


def _get_raw_value(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Return one channel as 24-bit offset binary (UNCONFIRMED form)."""
    channel = _channel(request)
    ranges = amplifier.transmission.input_ranges_now()
    return GsvAnswer(offset_binary(float(ranges[channel]), 3))


def _get_input_type(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    """Return the type and its input range in hundredths of a mV/V."""
    kind = amplifier.memory.input_type[_channel(request)]
    return GsvAnswer(struct.pack(">BI", kind, round(100 * input_range(kind))))


def _set_input_type(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    channel, kind = _channel(request), request.parameters[1]
    if kind >= len(BRIDGE_RANGES_MV_V):
        raise RefusedError(BAD_DATA)
    amplifier.memory.input_type[channel] = kind
    amplifier.log_change(f"input_type.{channel + 1}", kind, request.by)
    return GsvAnswer()


def _of_each_channel(read: int, write: int, form: str, name: str) -> dict[int, SimulatedCommand]:
    """Return the commands of a setting that each channel has: one reads it, another writes it."""

    def get(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
        return GsvAnswer(struct.pack(form, getattr(amplifier.memory, name)[_channel(request)]))

    def put(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
        (value,) = struct.unpack(form, request.parameters[1:])
        if not math.isfinite(value) or (form == ">B" and value > 7):
            raise RefusedError(BAD_DATA)
        getattr(amplifier.memory, name)[_channel(request)] = value
        amplifier.log_change(f"{name}.{request.parameters[0]}", value, request.by)
        return GsvAnswer()

    return {
        read: SimulatedCommand(get, (1,)),
        write: SimulatedCommand(put, (1 + struct.calcsize(form),), writes=True),
    }


# --- digital lines ---------------------------------------------------------------------------


def _get_direction(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(bytes((amplifier.lines.direction(request.parameters[0]),)))


def _set_direction(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    group, direction = request.parameters
    amplifier.lines.set_direction(group, direction)
    amplifier.log_change(f"direction.{group}", direction, request.by)
    return GsvAnswer()


def _get_level(amplifier: GsvAmplifier, request: GsvRequest) -> GsvAnswer:
    return GsvAnswer(struct.pack(">H", amplifier.lines.level(request.parameters[0])))


COMMANDS: dict[int, SimulatedCommand] = {
    0x01: SimulatedCommand(_get_interface, (0, 1)),
    **_of_each_channel(0x04, 0x05, ">f", "output_offset"),
    **_of_each_channel(0x06, 0x07, ">f", "output_scale"),
    0x0C: SimulatedCommand(_set_zero, (1,), writes=True),
    **_of_each_channel(0x0D, 0x0E, ">B", "output_type"),
    **_of_each_channel(0x14, 0x15, ">f", "user_scale"),
    0x1F: SimulatedCommand(_get_serial_number),
    0x23: SimulatedCommand(_stop_transmission),
    0x24: SimulatedCommand(_start_transmission),
    0x26: SimulatedCommand(_get_mode),
    0x27: SimulatedCommand(_set_mode, (4,)),
    0x2B: SimulatedCommand(_get_firmware_version),
    0x3A: SimulatedCommand(_get_raw_value, (1,)),
    0x3B: SimulatedCommand(_get_value),
    0x42: SimulatedCommand(_get_last_error, (0, 1)),
    0x43: SimulatedCommand(_four_zero_bytes, (0, 1)),
    0x49: SimulatedCommand(_get_mapping, (1,)),
    0x4A: SimulatedCommand(_set_mapping, (3,), writes=True),
    0x59: SimulatedCommand(_get_direction, (1,)),
    0x5A: SimulatedCommand(_set_direction, (2,), writes=True),
    0x5D: SimulatedCommand(_get_level, (1,)),
    0x63: SimulatedCommand(_get_rate_range, (1,)),
    0x78: SimulatedCommand(_reset),
    0x80: SimulatedCommand(_get_tx_mode, (1,)),
    0x81: SimulatedCommand(_set_tx_mode, (3,), writes=True),
    0x8A: SimulatedCommand(_get_rate),
    0x8B: SimulatedCommand(_set_rate, (4,), writes=True),
    0xA2: SimulatedCommand(_get_input_type, (2,)),
    0xA3: SimulatedCommand(_set_input_type, (2,), writes=True),
}
"""The commands that are simulated, by number."""
