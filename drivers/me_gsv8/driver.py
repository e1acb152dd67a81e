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

import contextlib
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from drivers.me_gsv8 import frames as gsv_frames
from drivers.me_gsv8.frames import FrameLayout, GsvResponse, Measurements
from rig.core.clock import Clock
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError
from rig.core.settings import Settings as BaseSettings
from rig.core.settings import Wiring
from rig.instruments.roles import ForceFrames, Identity, Reach

ROLES = ("force_sensor",)

DEVICE = "force_sensor"
MODEL = "GSV-8"
MODEL_NUMBER = 0x08
CHANNELS = (1, 2, 3)
FIRMWARE_WITH_CRC = (1, 56)
INPUT_RANGE_MV_V = 3.5
"""Input range of the factory setting; with a user scale as large, floats are in mV/V."""
MULTI_AXIS, AUTO_FILTER, MIN_MAX = 0x01, 0x02, 0x04
READ_WAIT_S = 0.02
"""Longest wait for bytes in one read, which is how long the reader may delay a request."""
WAITS = 2
"""Longest wait of a request in time-outs: it may have to synchronise the link before it waits for
its answer."""
STREAMING = 0x08
CRC16_ON = b"\x08"

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class MeGsv8Settings(BaseSettings):
    """Settings of the amplifier and its sensor."""

    driver: Literal["me-gsv8"] = "me-gsv8"
    port: Wiring[str] = Field(min_length=1)
    """Serial port, for example /dev/ttyACM0 or COM5."""
    baudrate: int = Field(default=230_400, ge=19_200, le=3_500_000)
    """Bits per second; without meaning over USB."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=60)
    """Longest wait for an answer."""
    rate_S_s: float = Field(default=1000.0, ge=1, le=12_000)
    """Frames per second that `connect` sets; `start` may set another rate."""
    nominal_force_N: float = Field(default=50.0, gt=0)
    """The sensor's nominal force on each axis."""
    rated_output_mV_V: float = Field(default=0.6, gt=0)
    """Bridge output at the nominal force; 0.6 is typical of a K3D40 [unconfirmed for 50 N]."""
    matrix_N_mV_V: Wiring[Matrix | None] = None
    """The calibration sheet's matrix, force in N by bridge output in mV/V; without one, nominal
    force by rated output on the diagonal, which neglects 0.4 to 2 % of crosstalk."""
    max_force_N: float | None = Field(default=None, gt=0)
    """Largest force along any axis; the nominal force if it is not given."""
    user_scale_mV_V: float = Field(default=INPUT_RANGE_MV_V, gt=0)
    """The amplifier's user scale and the input range that it stands for."""

    @model_validator(mode="after")
    def _plausible(self) -> MeGsv8Settings:
        if abs(np.linalg.det(np.array(self.matrix))) < 1e-9:
            raise ValueError("matrix_N_mV_V cannot be inverted: two axes would be one")
        if self.max_force_N is not None and self.max_force_N > 1.5 * self.nominal_force_N:
            raise ValueError(
                f"max_force_N = {self.max_force_N:g} is beyond 1.5 times nominal_force_N"
            )
        return self

    @property
    def matrix(self) -> Matrix:
        """Force in N by bridge output in mV/V."""
        if self.matrix_N_mV_V is not None:
            return self.matrix_N_mV_V
        gain = self.nominal_force_N / self.rated_output_mV_V
        return ((gain, 0.0, 0.0), (0.0, gain, 0.0), (0.0, 0.0, gain))

    @property
    def force_limit(self) -> float:
        """The largest force allowed along an axis, in N."""
        return self.max_force_N if self.max_force_N is not None else self.nominal_force_N


Settings = MeGsv8Settings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""


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

DIGITAL_GROUPS, LINES_PER_GROUP = 4, 4
INPUTS = tuple(
    f"{group}.{line}"
    for group in range(1, DIGITAL_GROUPS + 1)
    for line in range(1, LINES_PER_GROUP + 1)
)
"""Digital lines as the amplifier's connector has them. A whole group is inputs or outputs."""
INPUT = b"\x01"

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


class GsvLink:
    """A serial port with frames: one request at a time, while measurements may come in between.

    Any number of threads may call; each lock is held for one read or one request.
    """

    def __init__(self, settings: MeGsv8Settings, clock: Clock):
        self.crc = False
        """True if requests carry a CRC; set once the amplifier is known to support it."""
        self._settings = settings
        self._clock = clock
        self._port: Any = None
        self._decoder = gsv_frames.Decoder()
        self._responses: deque[GsvResponse] = deque()
        self._frames: list[Measurements] = []
        self._frame_bytes = 0
        self._taken = 0
        self._unanswered: set[int] = set()
        self._reading = threading.Lock()
        self._asking = threading.RLock()

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link, less those of measurements not yet collected."""
        with self._reading:
            return self._taken - self._frame_bytes

    def expect(self, layout: FrameLayout | None) -> None:
        """Treat measurements of another layout as an error from now on; with None accept all."""
        with self._reading:
            self._decoder.expected = layout
            self._decoder.crc_only = layout is not None and layout.crc

    def greet(self) -> None:
        """End the stream that may be running, and drop all that was under way before."""
        self.expect(None)
        self.crc = False
        with self._failing(STOP_TRANSMISSION), self._asking:
            self._open_port()
            self._write(STOP_TRANSMISSION, b"")
            self._synchronise()
        self.discard()

    def request(self, command: GsvCommand, parameters: bytes = b"") -> bytes:
        """Send a request and return the data of its answer. Raises InstrumentError for an error
        code, a broken answer or none."""
        with self._failing(command), self._asking:
            self._open_port()
            if self._unanswered or self._responses:
                self._synchronise()
            return self._ask(command, parameters)

    def collect(self) -> list[Measurements]:
        """Return the measurements since the last call; waits for a few milliseconds if none has
        come. Raises InstrumentError for bytes that are not a frame."""
        with self._failing(None):
            if not self._frames:
                self._receive()
            with self._reading:
                frames, self._frames, self._frame_bytes = self._frames, [], 0
            self._refuse_rejected("stream")
            return frames

    def discard(self) -> None:
        """Drop the measurements that were not collected."""
        with self._reading:
            self._frames, self._frame_bytes = [], 0

    def close(self) -> None:
        """Close the port."""
        with self._reading:
            port, self._port = self._port, None
            self._decoder.reset()
            self._responses.clear()
            self._frames, self._frame_bytes = [], 0
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    # --- one request -------------------------------------------------------------------------

    def _ask(self, command: GsvCommand, parameters: bytes) -> bytes:
        self._write(command, parameters)
        response = self._await(command, strict=True)
        if len(response.data) != (command.answer_bytes if response.code <= 1 else 0):
            raise self._error(
                command.name,
                f"the answer holds {len(response.data)} bytes, not {command.answer_bytes}: "
                f"{response.data.hex(' ')}",
            )
        self._unanswered.clear()
        if response.code > 1:
            raise self._refused(command, parameters, response.code)
        return response.data

    def _synchronise(self) -> None:
        """Make sure that the next answer belongs to the next request.

        What came late is dropped until a query is answered whose answer cannot be taken for one
        of those that are missing.
        """
        for command, parameters in TOKENS:
            if command.answer_bytes in self._unanswered:
                continue
            self._drain()
            self._write(command, parameters)
            while True:
                response = self._await(command, strict=False)
                if response.code == 0 and len(response.data) == command.answer_bytes:
                    break
            with self._reading:
                self._decoder.take_rejected()
            self._unanswered.clear()
            return
        self._unanswered.clear()
        raise self._error(
            "synchronise", "too many answers are missing", "switch the amplifier off and on"
        )

    def _drain(self) -> None:
        """Drop what has come until nothing comes for a moment."""
        deadline = time.monotonic() + self._settings.timeout_s
        while self._receive() and time.monotonic() < deadline:
            pass
        with self._reading:
            self._decoder.reset()
            self._responses.clear()

    def _write(self, command: GsvCommand, parameters: bytes) -> None:
        self._unanswered.add(command.answer_bytes)
        port = self._port
        try:
            port.write(gsv_frames.request(command.number, parameters, self.crc))
        except (TypeError, AttributeError) as error:
            if port is not None and self._port is port:
                raise
            # The reader has closed it meanwhile: pyserial then trips over what is no longer there.
            raise OSError("the port was closed while it was written to") from error

    def _await(self, command: GsvCommand, strict: bool) -> GsvResponse:
        """Return the next response; with `strict`, bytes that are not a frame are an error."""
        deadline = time.monotonic() + self._settings.timeout_s
        while not self._responses:
            if time.monotonic() > deadline:
                raise InstrumentTimeoutError(
                    DEVICE,
                    command.name,
                    f"no answer within {self._settings.timeout_s:g} s",
                    f"check that the amplifier is switched on and connected to "
                    f"{self._settings.port}",
                )
            self._receive()
            if strict and not self._responses:  # after the response they are the stream's affair
                self._refuse_rejected(command.name)
        return self._responses.popleft()

    def _receive(self) -> int:
        """Read the bytes that have come to the port, with a short wait, and route their frames;
        return the number of bytes. If another thread is reading, that one routes the frame that
        this one waits for."""
        if not self._reading.acquire(timeout=READ_WAIT_S):
            return 0
        try:
            if self._port is None:
                raise self._error("read", "the port is closed")
            waiting = self._port.in_waiting
            data: bytes = self._port.read(waiting or 1)
            if not data:
                return 0
            if not waiting:  # the first byte has come: take the others with it
                data += self._port.read(self._port.in_waiting)
            for frame in self._decoder.feed(data):
                if isinstance(frame, GsvResponse):
                    self._responses.append(frame)
                else:
                    self._frames.append(frame)
                    self._frame_bytes += frame.size
            self._taken += len(data)
            return len(data)
        finally:
            self._reading.release()

    # --- what goes wrong ---------------------------------------------------------------------

    @contextlib.contextmanager
    def _failing(self, command: GsvCommand | None) -> Iterator[None]:
        """Turn failures into InstrumentErrors; a port that failed is closed and opened anew."""
        name = command.name if command is not None else "stream"
        try:
            with self._clock.answer_within(WAITS * self._settings.timeout_s, DEVICE):
                yield
        except InstrumentTimeoutError:
            with contextlib.suppress(InstrumentError):  # the time-out itself is the news
                self._clock.charge(self._settings.timeout_s)
            raise
        except RigError:
            raise
        except Exception as error:  # pyserial and termios raise what they like where it breaks
            self.close()
            raise self._error(name, f"the connection failed ({error})") from error

    def _open_port(self) -> None:
        """Open the port where it is closed; what comes from it is not trusted yet."""
        import serial

        if self._port is not None:
            return
        port = serial.Serial(
            self._settings.port,
            self._settings.baudrate,
            timeout=READ_WAIT_S,
            write_timeout=self._settings.timeout_s,
            exclusive=True,
        )
        with self._reading:
            self._port = port
            self._unanswered = {STOP_TRANSMISSION.answer_bytes}

    def _refuse_rejected(self, command: str) -> None:
        with self._reading:
            rejected = self._decoder.take_rejected()
        if rejected:
            raise self._error(
                command, f"{len(rejected)} bytes came that are not a frame: {rejected.hex(' ')}"
            )

    def _refused(self, command: GsvCommand, parameters: bytes, code: int) -> InstrumentError:
        sent = f" {parameters.hex(' ')}" if parameters else ""
        reason = ERRORS.get(code, "an error without a name")
        hint = "check the value against the amplifier's manual"
        if code == 0x71:
            hint = "take the write lock off with the maker's program"
        return InstrumentError(
            DEVICE, f"{command.name}{sent}", f"refused with error {code:02X}: {reason}", hint
        )

    def _error(self, command: str, cause: str, hint: str | None = None) -> InstrumentError:
        usual = f"check the cable and that nothing else talks to {self._settings.port}"
        return InstrumentError(DEVICE, command, cause, hint or usual)


class ForceAmplifier:
    """A GSV-8 with a three-axis sensor on its first three channels.

    One thread reads; other threads may call the other methods meanwhile.
    """

    axes = "xyz"
    """The axes that the sensor has: each is watched by itself."""

    def __init__(self, settings: MeGsv8Settings, clock: Clock):
        self._settings = settings
        self._clock = clock
        self._link = GsvLink(settings, clock)
        self._identity: Identity | None = None
        self._matrix = np.array(settings.matrix)
        self._zero = np.zeros(3)
        self._layout = FrameLayout(len(CHANNELS))
        self._rates = (0.0, 0.0)
        self._rate = 0.0
        self._started_s: float | None = None
        self._next = 0
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

    @property
    def frames_behind(self) -> float:
        """Number of frames that are due since `start` by bench time and that `read` has not
        returned. A few on the way are normal; a lost one remains. The amplifier's own clock makes
        it drift by some 50 parts in a million. 0 while no stream runs."""
        if self._started_s is None:
            return 0.0
        return (self._clock.now() - self._started_s) * self._rate - self._next

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

    def reach(self) -> Mapping[str, Reach]:
        """Return the frame rates of the amplifier, and the force that the bench file allows on an
        axis."""
        owner = f"{DEVICE} {self.identity.model}"
        limit = self._settings.force_limit
        return {
            "rate": Reach(*self._rates, "1/s", owner),
            "force": Reach(-limit, limit, "N", owner),
        }

    def start(self, rate_S_s: float) -> float:
        """Begin to stream at the nearest rate that the amplifier has; that rate in frames/s."""
        self._set_rate(rate_S_s)
        self._link.discard()
        self._link.expect(self._layout)
        self._broken = None
        self._next = 0
        self._link.request(START_TRANSMISSION)
        self._started_s = self._clock.now()
        return self._rate

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
        first, self._next = self._next, self._next + len(raw)
        force = (raw.astype(np.float64) - self._zero) @ self._matrix.T
        return ForceFrames(first, raw, force, status & gsv_frames.SATURATED != 0)

    def stop(self) -> None:
        """End the stream; frames that were not read are dropped."""
        self._started_s = None
        self._link.request(STOP_TRANSMISSION)
        self._link.discard()

    def calibrate(self, matrix_N_mV_V: Sequence[Sequence[float]]) -> None:
        """Use this matrix, force in N by bridge output in mV/V, from the next `read` on."""
        self._matrix = np.array(matrix_N_mV_V, dtype=np.float64)

    def tare(self, zero_mV_V: tuple[float, float, float]) -> tuple[float, float, float]:
        """Take this reading in mV/V as no force, from the next `read` on; what it is in N."""
        self._zero = np.array(zero_mV_V, dtype=np.float64)
        x, y, z = (float(force) for force in self._matrix @ self._zero)
        return x, y, z

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
        self._started_s = None
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

    def _set_rate(self, rate_S_s: float) -> None:
        """Set the nearest rate that the amplifier has, and read it back."""
        if self._read_rate() != rate_S_s:
            self._link.request(WRITE_DATA_RATE, struct.pack(">f", rate_S_s))
            got = self._read_rate()
            if not 0.5 * rate_S_s <= got <= 2 * rate_S_s:  # NaN too
                raise InstrumentError(
                    DEVICE,
                    WRITE_DATA_RATE.name,
                    f"set to {rate_S_s:g} frames/s but reads back {got:g}",
                    "something else controls the amplifier",
                )

    def _read_rate(self) -> float:
        (self._rate,) = struct.unpack(">f", self._link.request(READ_DATA_RATE))
        return self._rate

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
