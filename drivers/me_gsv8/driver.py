"""ME-Messsysteme GSV-8 amplifier with a three-axis force sensor as a ForceSensor, serial.

The sensor's bridges sit on channels 1 to 3. The amplifier streams mV/V as floats; calibration
matrix and tare are applied here, so that a file contains both the raw values and the forces.
Nothing is driven: there is nothing to make safe.

A response does not say which request it answers, and measurements come between request and
response. So frames are routed by type, one request is under way at a time, and after a time-out or
a broken answer the link is not trusted until a query whose answer has another length than those
that are missing has been answered: late answers come before it and are dropped.

A measurement frame has neither counter nor time stamp. A lost frame can be noticed only by bench
time (`ForceAmplifier.frames_behind`); bytes that are not a frame are an error at once.

Settings go to the amplifier's EEPROM, so they are read first and written only where they differ.

Sources: ME-Messsysteme, GSV Communication Protocol Specification (ba-gsvcom_en, 11/2022); GSV-8
manual (ba-gsv8_en). Commands 49, 4A, 63, 80, 81, A2: parameters as a public client sends them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from drivers.me_gsv8 import frames as gsv_frames
from drivers.me_gsv8.commands import (
    FIRMWARE_VERSION,
    GET_DIO_DIRECTION,
    GET_DIO_LEVEL,
    GET_INPUT_TYPE,
    GET_INTERFACE,
    GET_MODE,
    GET_SERIAL_NUMBER,
    GET_TX_MAPPING,
    GET_TX_MODE,
    READ_DATA_RATE,
    READ_DATA_RATE_RANGE,
    READ_USER_SCALE,
    SET_DIO_DIRECTION,
    SET_MODE,
    SET_TX_MAPPING,
    SET_TX_MODE,
    START_TRANSMISSION,
    STOP_TRANSMISSION,
    WRITE_DATA_RATE,
    WRITE_USER_SCALE,
    GsvCommand,
)
from drivers.me_gsv8.frames import FrameLayout
from drivers.me_gsv8.link import DEVICE, GsvLink
from drivers.me_gsv8.settings import MeGsv8Settings
from drivers.shared.force_stream import ForceStream
from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import ForceFrames, Identity, Limits

ROLES = ("force_sensor",)

MODEL = "GSV-8"
MODEL_NUMBER = 0x08
CHANNELS = (1, 2, 3)
FIRMWARE_WITH_CRC = (1, 56)
MULTI_AXIS, AUTO_FILTER, MIN_MAX = 0x01, 0x02, 0x04
STREAMING = 0x08
CRC16_ON = b"\x08"
DIGITAL_GROUPS, LINES_PER_GROUP = 4, 4
INPUTS = tuple(
    f"{group}.{line}"
    for group in range(1, DIGITAL_GROUPS + 1)
    for line in range(1, LINES_PER_GROUP + 1)
)
"""Digital lines as the amplifier's connector has them. A whole group is inputs or outputs."""
INPUT = b"\x01"

Settings = MeGsv8Settings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""


class ForceAmplifier(ForceStream):
    """A GSV-8 with a three-axis sensor on its first three channels.

    One thread reads; other threads may call the other methods meanwhile.
    """

    axes = "xyz"
    """The axes that the sensor has: each is watched by itself."""

    def __init__(self, settings: MeGsv8Settings, clock: Clock):
        super().__init__(clock, settings.matrix)
        self._settings = settings
        self._link = GsvLink(settings, clock)
        self._identity: Identity | None = None
        self._layout = FrameLayout(len(CHANNELS))
        self._rates = (0.0, 0.0)
        self._broken: InstrumentError | None = None
        self._input_groups: set[int] = set()
        """Groups of digital lines that are known to be inputs."""

    @property
    def identity(self) -> Identity:
        """Identity of the amplifier as read when it was connected."""
        assert self._identity is not None, "connect() identifies before anything else"
        return self._identity

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link since it was opened, less those that `read` has not returned
        yet."""
        return self._link.bytes_consumed

    def prepare(self) -> None:
        """End any stream, identify, and set what a stream of bridge outputs needs, read back."""
        link = self._link
        link.greet()
        number = link.request(GET_SERIAL_NUMBER).decode("ascii", "replace").strip("\0 ")
        major, minor = struct.unpack(">HH", link.request(FIRMWARE_VERSION))
        link.crc = (major, minor) >= FIRMWARE_WITH_CRC
        self._check_interface(link.request(GET_INTERFACE, CRC16_ON if link.crc else b""), number)
        self._identity = Identity("ME-Messsysteme", MODEL, number, f"{major}.{minor}")
        self._layout = FrameLayout(len(CHANNELS), gsv_frames.FLOAT32, link.crc)
        self._set_rate(self._settings.rate_S_s)  # first: floats are refused at the fastest rates
        self._prepare_values()
        self._rates = self._read_rate_range()

    def limits(self) -> Mapping[str, Limits]:
        """Return the frame rates of the amplifier, and the force that the bench file allows on an
        axis."""
        limited_by = f"{DEVICE} {self.identity.model}"
        limit_N = self._settings.force_limit_N
        return {
            "rate": Limits(*self._rates, "1/s", limited_by),
            "force": Limits(-limit_N, limit_N, "N", limited_by),
        }

    def start(self, rate_S_s: float) -> float:
        """Begin to stream at the nearest rate that the amplifier has; return that rate in
        frames/s."""
        nearest_S_s = self._set_rate(rate_S_s)
        self._link.discard()
        self._link.expect(self._layout)
        self._broken = None
        self._begins()
        self._link.request(START_TRANSMISSION)
        self._begun(nearest_S_s)
        return nearest_S_s

    def read(self) -> ForceFrames | None:
        """Return the frames that have arrived, or None; waits a few milliseconds at most.

        Raises InstrumentError for bytes that are not a frame, now and until the stream is started
        again.
        """
        if self._broken is not None:
            raise self._broken
        try:
            runs = self._link.collect()
        except InstrumentError as error:
            self._broken = error if self._started_s is not None else None
            raise
        if not runs:
            return None
        raw, status = runs[0].values, runs[0].status
        if len(runs) > 1:
            raw = np.concatenate([run.values for run in runs])
            status = np.concatenate([run.status for run in runs])
        return self._frames(raw, status & gsv_frames.SATURATED != 0, "mV/V")

    def stop(self) -> None:
        """End the stream; frames that were not read are dropped."""
        self._ended()
        self._link.request(STOP_TRANSMISSION)
        self._link.discard()

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the levels of digital lines, such as "1.1": True for high. Each is one request;
        their groups are made inputs first. The commands' numbers are those of the maker's library
        gsv86lib."""
        return {name: self._is_high(*map(int, name.split("."))) for name in names}

    def _is_high(self, group: int, line: int) -> bool:
        if group not in self._input_groups:
            self._agree(GET_DIO_DIRECTION, SET_DIO_DIRECTION, bytes((group,)), INPUT)
            self._input_groups.add(group)
        number = (group - 1) * LINES_PER_GROUP + line
        (level,) = struct.unpack(">H", self._link.request(GET_DIO_LEVEL, bytes((number,))))
        return bool(level)

    def make_safe(self) -> None:
        """Do nothing: a sensor drives nothing, and its stream guards the rest of the bench."""

    def close(self) -> None:
        """Close the port; a stream continues unread until the next connect ends it."""
        self._ended()
        self._link.close()

    # --- settings of the amplifier -----------------------------------------------------------

    def _check_interface(self, state: bytes, serial_number: str) -> None:
        """Check that this is a GSV-8 and that it does not stream."""
        port = self._settings.port
        if (model := state[0] & 0x3F) != MODEL_NUMBER:
            raise InstrumentError(
                DEVICE,
                GET_INTERFACE.name,
                f"{port} is an amplifier of model number {model:02X}, serial {serial_number}",
                f"a {MODEL} ({MODEL_NUMBER:02X}) is expected; correct [force_sensor] in the "
                "bench file",
            )
        if state[1] & STREAMING:
            raise InstrumentError(
                DEVICE,
                STOP_TRANSMISSION.name,
                "the amplifier continues to stream",
                f"check that nothing else talks to {port}",
            )

    def _prepare_values(self) -> None:
        """Set three floats per frame, in mV/V, without matrix, minima and maxima."""
        scale = self._settings.user_scale_mV_V
        for channel in CHANNELS:
            _, hundredths = struct.unpack(
                ">BI", self._link.request(GET_INPUT_TYPE, bytes((channel, 0xFF)))
            )
            if not abs(hundredths / 100 - scale) < 0.005:
                raise InstrumentError(
                    DEVICE,
                    GET_INPUT_TYPE.name,
                    f"channel {channel} has an input range of {hundredths / 100:g} mV/V, "
                    f"the bench file says {scale:g} mV/V",
                    "set the input type with the maker's program, or correct user_scale_mV_V",
                )
            self._agree(
                READ_USER_SCALE, WRITE_USER_SCALE, bytes((channel,)), struct.pack(">f", scale)
            )
        found = self._link.request(GET_MODE)
        (mode,) = struct.unpack(">I", found)
        wanted = mode & ~(MULTI_AXIS | MIN_MAX) | AUTO_FILTER
        self._agree(GET_MODE, SET_MODE, b"", struct.pack(">I", wanted), found)
        self._agree(GET_TX_MODE, SET_TX_MODE, b"\x01", struct.pack(">H", gsv_frames.FLOAT32))
        count = struct.pack(">H", len(CHANNELS))
        self._agree(GET_TX_MAPPING, SET_TX_MAPPING, b"\0", count)

    def _agree(
        self,
        read: GsvCommand,
        write: GsvCommand,
        index: bytes,
        wanted: bytes,
        found: bytes | None = None,
    ) -> None:
        """Bring one setting to `wanted`, writing only where it differs from what is read or was
        `found`, and read it back."""
        if (self._link.request(read, index) if found is None else found) == wanted:
            return
        self._link.request(write, index + wanted)
        got = self._link.request(read, index)
        if got != wanted:
            raise InstrumentError(
                DEVICE,
                write.name,
                f"set to {wanted.hex(' ')} but reads back {got.hex(' ')}",
                "something else controls the amplifier, or the value is outside its range",
            )

    def _set_rate(self, rate_S_s: float) -> float:
        """Set the nearest rate that the amplifier has; return that rate as read back, in
        frames/s."""
        if (now_S_s := self._read_rate()) == rate_S_s:
            return now_S_s
        self._link.request(WRITE_DATA_RATE, struct.pack(">f", rate_S_s))
        got_S_s = self._read_rate()
        if not 0.5 * rate_S_s <= got_S_s <= 2 * rate_S_s:  # NaN too
            raise InstrumentError(
                DEVICE,
                WRITE_DATA_RATE.name,
                f"set to {rate_S_s:g} frames/s but reads back {got_S_s:g}",
                "something else controls the amplifier",
            )
        return got_S_s

    def _read_rate(self) -> float:
        (rate_S_s,) = struct.unpack(">f", self._link.request(READ_DATA_RATE))
        return float(rate_S_s)

    def _read_rate_range(self) -> tuple[float, float]:
        """Return the slowest and fastest rate as the amplifier is set."""
        (fastest,) = struct.unpack(">f", self._link.request(READ_DATA_RATE_RANGE, b"\0"))
        (slowest,) = struct.unpack(">f", self._link.request(READ_DATA_RATE_RANGE, b"\x01"))
        return float(slowest), float(fastest)


def connect(settings: MeGsv8Settings, clock: Clock) -> ForceAmplifier:
    """Connect to the amplifier, leaving it silent and ready to stream three floats a frame."""
    amplifier = ForceAmplifier(settings, clock)
    try:
        amplifier.prepare()
    except BaseException:
        amplifier.close()
        raise
    return amplifier


def make_safe(settings: MeGsv8Settings) -> None:
    """Do nothing: a sensor drives nothing, and a program that still reads it may need it."""
