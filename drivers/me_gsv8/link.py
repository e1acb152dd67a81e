"""A serial conversation with a GSV-8: one request at a time, measurements in between.

What is asked and answered, nothing about forces. A response does not say which request it answers,
so frames are routed by type, and after a time-out or a broken answer the link is not trusted until
a query whose answer has another length than those that are missing has been answered: late answers
come before it and are dropped.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from drivers.me_gsv8 import frames as gsv_frames
from drivers.me_gsv8.commands import ERRORS, STOP_TRANSMISSION, TOKENS, GsvCommand
from drivers.me_gsv8.frames import FrameLayout, GsvResponse, Measurements
from drivers.me_gsv8.settings import MeGsv8Settings
from rig.core.clock import Clock
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError

DEVICE = "force_sensor"
READ_WAIT_S = 0.02
"""Longest wait for bytes in one read, which is how long the reader may delay a request."""
TIMEOUTS_PER_ANSWER = 2
"""Longest wait of a request in time-outs: it may have to synchronise the link before it waits for
its answer."""


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
            first = self._synchronise()
            # A connection before this one may have left a stop and this same query unanswered,
            # and their late answers look like those of this one. A second query, whose answer has
            # another length, is answered after all of them.
            self._unanswered.add(first.answer_bytes)
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

    def _synchronise(self) -> GsvCommand:
        """Make sure that the next answer belongs to the next request; return the query that was
        answered for that.

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
            return command
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
        """Turn failures into InstrumentErrors; a port that failed is closed and opened again."""
        name = command.name if command is not None else "stream"
        try:
            with self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._settings.timeout_s, DEVICE):
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
